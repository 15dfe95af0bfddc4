"""Virtual video of several people as a detector would list them, with the person that each row really is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras.virtual_video import PERSON_HEIGHT_M, annotate, look_at_camera, sample_views
from pasdedeux.projections.retarget import mid_hip

__all__ = ["Detections", "film", "people_of"]

Array = npt.NDArray[np.float64]

_PERSON_SHARE = 600.0 / 1080.0
"""Part of the image's height that a person takes."""

_DISTANCE_M = 4.0


@dataclass(frozen=True)
class Detections:
    """Rows of a video with the person each really is.

    Args:
        frame: (row,).
        true_id: (row,).
        keypoints_px: (row, 14, 2), y down.
        confidence: (row, 14).
        rate_hz: Frames per second.
    """

    frame: npt.NDArray[np.int64]
    true_id: npt.NDArray[np.int64]
    keypoints_px: Array
    confidence: Array
    rate_hz: float

    def rows(self, chosen: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> Detections:
        """Return some of the rows."""
        return Detections(
            self.frame[chosen], self.true_id[chosen], self.keypoints_px[chosen], self.confidence[chosen], self.rate_hz
        )


def film(
    rng: np.random.Generator,
    couple: Array,
    *,
    rate_hz: float = 30.0,
    noise_px: float = 0.0,
    lines: int = 1080,
    yaw_rad: float | None = None,
) -> Detections:
    """Film people (frame, person, 14, 3) from a random view 4 m away, people in random order in every frame.

    A person is about 600 of 1080 lines tall, and the noise is in pixels of that image.
    """
    angles = sample_views(rng, 1)
    camera = look_at_camera(
        mid_hip(couple).mean(axis=(0, 1)),
        distance_m=_DISTANCE_M,
        yaw_rad=float(angles.yaw_rad[0]) if yaw_rad is None else yaw_rad,
        pitch_rad=float(angles.pitch_rad[0]),
        focal_px=_PERSON_SHARE * lines * _DISTANCE_M / PERSON_HEIGHT_M,
        image_size_px=(lines * 16 // 9, lines),
    )
    frames, people = couple.shape[:2]
    seen = annotate(rng, camera.project(couple).px, noise_px=noise_px)
    order = np.argsort(rng.random((frames, people)), axis=1)
    at = np.arange(frames)[:, None]
    return Detections(
        frame=np.repeat(np.arange(frames), people),
        true_id=order.reshape(-1),
        keypoints_px=seen.px[at, order].reshape(-1, 14, 2),
        confidence=seen.confidence[at, order].reshape(-1, 14),
        rate_hz=rate_hz,
    )


def people_of(seen: Detections) -> tuple[Array, Array]:
    """Return keypoints (person, frame, 14, 2) and confidences in true order."""
    order = np.lexsort([seen.frame, seen.true_id])
    people = int(seen.true_id.max()) + 1
    return seen.keypoints_px[order].reshape(people, -1, 14, 2), seen.confidence[order].reshape(people, -1, 14)
