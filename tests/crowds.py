"""Virtual video of couples for tests: what a detector would list, people of a frame in random order."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras.virtual_video import PERSON_HEIGHT_M, annotate, look_at_camera, sample_views
from pasdedeux.choreography import make_duet
from pasdedeux.formats import derive_working_poses, read_bvh
from pasdedeux.kinematics import Motion
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.skeletons.layouts import LAYOUTS

__all__ = ["SALSA_TAKES", "Detections", "duet_couple", "film", "salsa_couple"]

Array = npt.NDArray[np.float64]

SALSA_TAKES = ("01", "02", "03", "04", "05", "06", "07", "09", "10", "11", "12")
_METRES_PER_UNIT = {"60": 1.263, "61": 1.191}
_SALSA_HZ = 60.0  # the headers say 120
_PERSON_SHARE = 600.0 / 1080.0


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
        """Give some of the rows."""
        return Detections(
            self.frame[chosen], self.true_id[chosen], self.keypoints_px[chosen], self.confidence[chosen], self.rate_hz
        )


def _couple(motions: list[Motion], layout: str, rate_hz: float) -> Array:
    poses = [derive_working_poses(motion.resample(rate_hz), LAYOUTS[layout]).op14_m for motion in motions]
    count = min(map(len, poses))
    return np.stack([pose[:count] for pose in poses], axis=1)


def duet_couple(name: str, *, duration_s: float = 10.0, rate_hz: float = 30.0, variation: int = 0) -> Array:
    """Positions (frame, 2, 14, 3) of a built-in duet."""
    duet = make_duet(name, duration_s=duration_s, rate_hz=rate_hz, variation=variation)
    return _couple(list(duet.motions), "body22", rate_hz)


def salsa_couple(data_dir: Path, take: str, *, rate_hz: float = 30.0) -> Array:
    """Positions (frame, 2, 14, 3) of a real salsa take."""
    motions = []
    for subject, unit in _METRES_PER_UNIT.items():
        source = read_bvh((data_dir / "cmu_salsa_bvh" / f"{subject}_{take}.bvh").read_bytes())
        motions.append(source.to_motion(metres_per_unit=unit, rate_hz=_SALSA_HZ))
    return _couple(motions, "cmu_daz", rate_hz)


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
        distance_m=4.0,
        yaw_rad=float(angles.yaw_rad[0]) if yaw_rad is None else yaw_rad,
        pitch_rad=float(angles.pitch_rad[0]),
        focal_px=_PERSON_SHARE * lines * 4.0 / PERSON_HEIGHT_M,
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
