"""People on virtual video as a detector lists them, with who each row really is, and faults of detectors put in."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras.virtual_video import PERSON_HEIGHT_M, annotate_pixels, look_at_camera, sample_views
from pasdedeux.people.faults import RepairedCrowd
from pasdedeux.people.identity import body_size_px
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.skeletons import OP14

Array = npt.NDArray[np.float64]

KINDS = ("body", "arms", "legs", "exchanged", "stolen", "merged")
"""Sides of the whole body, of arms, of legs swapped; a limb exchanged with the partner's; a limb found on the partner
only; a person whose every joint is now and then the partner's."""

_MIRROR = np.array(OP14.mirror)
_ARMS, _LEGS = np.array(OP14.arms).ravel(), np.array(OP14.legs).ravel()
_LIMBS = [np.array(limb[1:]) for side in zip(OP14.arms, OP14.legs, strict=True) for limb in side]
_VISIBLE = 0.06
"""A fault that moves a joint by less than this share of the body's height cannot be seen, and does no harm."""
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


def joined(*parts: Detections) -> Detections:
    """Return the rows of all parts, one after the other."""
    names = ("frame", "true_id", "keypoints_px", "confidence")
    return Detections(*(np.concatenate([getattr(part, name) for part in parts]) for name in names), parts[0].rate_hz)


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
    yaws, pitches = sample_views(rng, 1)
    camera = look_at_camera(
        mid_hip(couple).mean(axis=(0, 1)),
        distance_m=_DISTANCE_M,
        yaw_rad=float(yaws[0]) if yaw_rad is None else yaw_rad,
        pitch_rad=float(pitches[0]),
        focal_px=_PERSON_SHARE * lines * _DISTANCE_M / PERSON_HEIGHT_M,
        image_size_px=(lines * 16 // 9, lines),
    )
    frames, people = couple.shape[:2]
    seen = annotate_pixels(rng, camera.project(couple).px, noise_px=noise_px)
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


@dataclass(frozen=True)
class Faulty:
    """Keypoints (person, frame, 14, 2), confidences, and which joints are visibly wrong (person, frame, 14)."""

    keypoints_px: Array
    confidence: Array
    is_wrong: npt.NDArray[np.bool_]


def inject(
    rng: np.random.Generator, keypoints_px: Array, confidence: Array, kind: str, *, every: int = 40, longest: int = 6
) -> Faulty:
    """Put a fault of 1 to `longest` frames into every stretch of `every` frames, of one of the people."""
    points, people = keypoints_px.copy(), len(keypoints_px)
    for start in range(5, keypoints_px.shape[1] - longest - 5, every):
        first = start + int(rng.integers(0, every - longest - 5))
        frames = slice(first, first + int(rng.integers(1, longest + 1)))
        person = int(rng.integers(people))
        theirs, partners = points[person, frames], points[1 - person, frames].copy()
        limb = _LIMBS[int(rng.integers(4))]
        if kind in {"body", "arms", "legs"}:
            joints = {"body": np.concatenate([_ARMS, _LEGS]), "arms": _ARMS, "legs": _LEGS}[kind]
            theirs[:, joints] = theirs[:, _MIRROR[joints]]
        elif kind == "exchanged":
            points[1 - person, frames][:, limb] = theirs[:, limb]
            theirs[:, limb] = partners[:, limb]
        elif kind == "stolen":
            theirs[:, limb] = partners[:, limb]
        else:
            joints = np.flatnonzero(rng.random(14) < 0.5)
            theirs[:, joints] = partners[:, joints]
    moved = np.linalg.norm(points - keypoints_px, axis=-1)
    return Faulty(points, confidence, moved > _VISIBLE * np.nanmedian(body_size_px(keypoints_px, confidence)))


@dataclass(frozen=True)
class JointCounts:
    """What a repair did, in joints over people and frames; counts of several videos add up.

    Args:
        wrong: Visibly wrong before.
        found: Of these, changed or masked.
        changed: Changed or masked at all, by more than can be missed.
        repaired: Of the wrong ones, right afterwards.
        left: Of the wrong ones, still wrong and not masked.
    """

    wrong: int = 0
    found: int = 0
    changed: int = 0
    repaired: int = 0
    left: int = 0

    def __add__(self, other: JointCounts) -> JointCounts:
        """Add up."""
        return JointCounts(*(mine + others for mine, others in zip(astuple(self), astuple(other), strict=True)))

    @property
    def shares(self) -> dict[str, float]:
        """Shares of the wrong joints found, put right, and still wrong and believed, and of the changed ones wrong.

        NaN where none is wrong, or none was changed.
        """
        return {
            "share_of_wrong_joints_found": _share(self.found, self.wrong),
            "share_of_changed_joints_that_were_wrong": _share(self.found, self.changed),
            "share_of_wrong_joints_put_right": _share(self.repaired, self.wrong),
            "share_of_wrong_joints_left": _share(self.left, self.wrong),
        }


def _share(count: int, among: int) -> float:
    return count / among if among else float("nan")


def count_joints(faulty: Faulty, true_px: Array, repaired: RepairedCrowd) -> JointCounts:
    """Count what a repair of injected faults did, against the true keypoints (person, frame, 14, 2)."""
    is_changed = repaired.is_touched.copy()
    # Joints that a repair moved by less than can be seen are neither repaired nor falsely accused.
    moved = np.linalg.norm(repaired.keypoints_px - faulty.keypoints_px, axis=-1)
    size = np.nanmedian(body_size_px(true_px, np.ones(true_px.shape[:-1])))
    is_changed &= repaired.is_masked | (moved > _VISIBLE * size)
    off = np.linalg.norm(repaired.keypoints_px - true_px, axis=-1)
    is_right = off < 0.5 * _VISIBLE * size
    wrong = faulty.is_wrong
    counts = [wrong, wrong & is_changed, is_changed, wrong & is_right, wrong & ~is_right & ~repaired.is_masked]
    return JointCounts(*(int(np.count_nonzero(joints)) for joints in counts))
