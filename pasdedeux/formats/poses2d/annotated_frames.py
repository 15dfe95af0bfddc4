"""2D annotations as read from a file, and checks that they look like people."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from itertools import pairwise
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.errors import FormatError, InputError, NobodyError
from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from pasdedeux.skeletons import PAIR17
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, USUAL_LAYOUTS, KeypointLayout

# Maximum length of a segment as a share of the diagonal of a person's box.  Large enough for people who crouch, bend or
# are cut off at the waist; far too small for a keypoint that belongs to another part of the body.
_LEFT_SEGMENTS = {
    ("nose", "left_eye"): 0.35,
    ("left_eye", "left_ear"): 0.35,
    ("left_shoulder", "left_elbow"): 0.6,
    ("left_elbow", "left_wrist"): 0.6,
    ("left_hip", "left_knee"): 0.55,
    ("left_knee", "left_ankle"): 0.55,
    ("neck", "left_shoulder"): 0.5,
    ("left_ankle", "left_big_toe"): 0.35,
    ("left_ankle", "left_heel"): 0.35,
    ("mid_hip", "left_hip"): 0.35,
    ("pelvis", "left_hip"): 0.35,
}
_SEGMENTS = {
    ("left_shoulder", "right_shoulder"): 0.7,
    ("left_hip", "right_hip"): 0.45,
    ("head", "neck"): 0.45,
    **_LEFT_SEGMENTS,
    **{(a.replace("left", "right"), b.replace("left", "right")): share for (a, b), share in _LEFT_SEGMENTS.items()},
}
MIN_CONFIDENCE = 0.2
"""Keypoints of a lower confidence are doubtful, in the usual scale, where 1 is clearly visible."""
USUAL_SCALE = (MIN_CONFIDENCE, 1.5)
"""Range of the 95th percentile of confidences in which the scale of a source is kept.  A bad video reaches only 0.3;
below the first value no keypoint would be left."""
MAX_SHARE = 2.0
MAX_NEGATIVE = 0.2
"""Maximum coordinate, in image sizes, and maximum share of negative coordinates (about half of 3D ones are)."""
MAX_HIPS_AT_ORIGIN = 0.02
"""Maximum distance of the hips from the origin for coordinates to be 3D landmarks, whose origin is there."""
MAX_OTHER_SHAPE = 0.02
"""Maximum difference of the aspect ratios of two sizes of one video, whose sides are rounded to pixels."""
MARGIN, DOUBTED_OUTSIDE, MAX_OUTSIDE = 0.05, 0.05, 0.2
"""Margin around the image, in image sizes; shares of sure keypoints beyond it that cause a doubt, and a refusal."""
_SURE_SHARE, _ENDS, _HALF = 0.5, 99, 0.5
"""Minimum confidence of a sure keypoint, a share of the 95th percentile; percentile of coordinates that counts as their
end; share of the image that this end must exceed."""
SURE_STRETCH, MAX_STRETCH = 0.36, 0.6
"""Stretch below which a layout is right and above which it is wrong; between them another layout may be better.
Measured for dancers: 0.20 to 0.31 in the right layout, also with noise and junk, 0.39 to 0.8 in wrong ones."""
CLEARLY_SHORTER = 0.75
"""Another layout is right if its segments are shorter by this factor."""
MAX_OFF_MIDDLE = 0.1
"""Maximum distance of a mid-hip from the middle of the hips, a share of the diagonal; a thigh is about 0.25."""
MIN_CHECKED_ROWS = 5
"""Segments seen in fewer rows are not used."""


RATE_HZ = (1e-3, 1e5)
FOCAL_PX = (1e-3, 1e6)
MAX_IMAGE_PX = 100_000
"""Allowed ranges of frame rate and focal length, and the largest image side, in a file."""
_SEQUENCE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,200}")
"""Names of sequences become names of files and partitions."""


_ROWS = ("frame", "person_id", "keypoints_px", "confidence")
"""Arrays of `AnnotatedFrames` with a row for each person in a frame."""


class KeypointStatus(IntEnum):
    """Origin of a keypoint; `DETECTED` or more if it is from a person or a detector."""

    MISSING = 0
    INTERPOLATED = 1
    TRACKED = 2
    DETECTED = 3
    ANNOTATED = 4


@dataclass(frozen=True)
class AnnotatedFrames:
    """2D keypoints, a row per sequence, frame and person, sorted so.

    Args:
        layout: Name of the keypoint layout.
        sequence_id: (row,) names of sequences.
        frame: (row,) frame numbers.
        person_id: (row,) numbers of people in the source, else their order in the frame.
        keypoints_px: (row, K, 2), NaN where missing; x right, y down.
        confidence: (row, K), 0 where missing.
        image_size_px: Width and height of the images by sequence, where known.
        rate_hz: Frames per second, None when unknown.
        focal_px: Focal length of the camera by sequence, pixels, where known.
        skipped: Names of files that could not be read.
        has_identities: Whether a person has the same number in every frame; false for a detector that does not follow
            people.
        status: (row, K) of `KeypointStatus`, the origin of keypoints; None if the source does not state it.
        remarks: Notes for the user on how it was read.
        doubts: Possible faults, in words.
        camera_motion: Motion of the camera, by sequence, for film whose camera moves; keypoints stay those of the
            images.
    """

    layout: str
    sequence_id: tuple[str, ...]
    frame: Integers
    person_id: Integers
    keypoints_px: Array
    confidence: Array
    image_size_px: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    rate_hz: float | None = None
    focal_px: Mapping[str, float] = field(default_factory=dict)
    skipped: tuple[str, ...] = ()
    has_identities: bool = True
    status: Integers | None = None
    remarks: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    camera_motion: Mapping[str, CameraMotion] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        layout: KeypointLayout,
        *,
        keypoints_px: Array,
        confidence: Array,
        status: Integers | None = None,
        **others: Any,
    ) -> AnnotatedFrames:
        """Return annotations in a known layout; keypoints of a user's layout are converted to pair17."""
        if KEYPOINT_LAYOUTS.get(layout.name) is not layout:
            joints = layout.derive(PAIR17.name, keypoints_px, confidence)
            if status is not None:
                status = layout.derive_status(PAIR17.name, status)
            layout, keypoints_px, confidence = KEYPOINT_LAYOUTS[PAIR17.name], joints.positions, joints.confidence
        return cls(layout=layout.name, keypoints_px=keypoints_px, confidence=confidence, status=status, **others)

    def __post_init__(self) -> None:
        """Check and sort the rows; set missing keypoints to NaN with confidence 0."""
        rows, count = len(self.frame), get_keypoint_layout(self.layout).num_keypoints
        assert self.keypoints_px.shape == (rows, count, 2)
        assert self.confidence.shape == (rows, count)
        assert len(self.sequence_id) == len(self.person_id) == rows
        for name in set(self.sequence_id):
            if not _SEQUENCE_NAME.fullmatch(name):
                raise FormatError(f"sequence '{name[:40]}': names have letters, digits, '.', '-' and '_', at most 200")
        keys = sorted(zip(self.sequence_id, self.frame.tolist(), self.person_id.tolist(), range(rows), strict=True))
        order = [row for *_, row in keys]
        for before, (name, frame, person, _) in pairwise(keys):
            if before[:3] == (name, frame, person):
                raise FormatError(f"sequence '{name}', frame {frame}: person {person} appears twice")
        is_seen = np.isfinite(self.keypoints_px).all(axis=-1) & (self.confidence > 0)
        fields = {
            "sequence_id": tuple(self.sequence_id[i] for i in order),
            "frame": np.asarray(self.frame)[order],
            "person_id": np.asarray(self.person_id)[order],
            "keypoints_px": np.where(is_seen[..., None], self.keypoints_px, np.nan)[order],
            "confidence": np.where(is_seen, self.confidence, 0.0)[order],
            "status": None if self.status is None else np.where(is_seen, self.status, 0)[order],
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def remark(self, words: str) -> AnnotatedFrames:
        """Return the same annotations with one more remark, unless it is there already."""
        return replace(self, remarks=tuple(dict.fromkeys((*self.remarks, words))))

    def rows(self, chosen: Flags) -> AnnotatedFrames:
        """Return the rows selected by a mask (row,)."""
        return replace(
            self,
            sequence_id=tuple(name for name, kept in zip(self.sequence_id, chosen, strict=True) if kept),
            status=None if self.status is None else self.status[chosen],
            **{name: getattr(self, name)[chosen] for name in _ROWS},
        )

    @property
    def is_given(self) -> Flags:
        """Keypoints (row, K) from a person or a detector, not tracked or interpolated."""
        return np.asarray(self.confidence > 0 if self.status is None else self.status >= KeypointStatus.DETECTED)

    def given(self) -> AnnotatedFrames:
        """Return rows with at least one keypoint from a person or a detector; their other keypoints stay."""
        return self.rows(np.asarray(self.is_given.any(axis=1)))

    def start_of_each(self, num_frames: int) -> AnnotatedFrames:
        """Return the rows of the first `num_frames` frames of each sequence."""
        first: dict[str, int] = {}
        for name, frame in zip(self.sequence_id, self.frame.tolist(), strict=True):
            first.setdefault(name, frame)
        return self.rows(self.frame < np.array([first[name] + num_frames for name in self.sequence_id]))

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return len(self.frame)


def join_frames(parts: Sequence[AnnotatedFrames]) -> AnnotatedFrames:
    """Join the rows of several sequences of one source, which have one layout and one rate."""
    statuses = [part.status for part in parts if part.status is not None]
    rows: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ROWS}
    return replace(
        parts[0],
        sequence_id=tuple(name for part in parts for name in part.sequence_id),
        **rows,
        status=np.concatenate(statuses) if len(statuses) == len(parts) else None,
        image_size_px={name: size for part in parts for name, size in part.image_size_px.items()},
        focal_px={name: focal for part in parts for name, focal in part.focal_px.items()},
        camera_motion={name: motion for part in reversed(parts) for name, motion in part.camera_motion.items()},
    )


def get_keypoint_layout(name: str | KeypointLayout) -> KeypointLayout:
    """Return the keypoint layout of this name, or a given layout itself; an InputError lists the known names."""
    if isinstance(name, KeypointLayout):
        return name
    if name not in KEYPOINT_LAYOUTS:
        raise InputError(f"keypoint layout '{name}' is not known; known layouts: {', '.join(KEYPOINT_LAYOUTS)}")
    return KEYPOINT_LAYOUTS[name]


def without_doubtful(frames: AnnotatedFrames, min_confidence: float | None) -> AnnotatedFrames:
    """Remove keypoints of low confidence, and people who have no keypoints left.

    The scale of confidences differs between detectors: for a clearly visible joint, old AlphaPose gives up to 5, heat
    maps that sum to 1 give 0.1.  If the 95th percentile of a source is outside `USUAL_SCALE`, confidences are divided
    by it.  Within, low confidences are kept: a bad video cannot be distinguished from a slightly smaller scale.

    Args:
        frames: Annotations.
        min_confidence: Keypoints of a lower confidence, in the scale of the source, are missing; None for
            `MIN_CONFIDENCE` in the usual scale.
    """
    known = frames.confidence[frames.confidence > 0]
    scale = float(np.percentile(known, 95)) if len(known) else 1.0
    confidence = frames.confidence / (1.0 if USUAL_SCALE[0] <= scale <= USUAL_SCALE[1] else scale)
    is_sure = confidence >= MIN_CONFIDENCE if min_confidence is None else frames.confidence >= min_confidence
    confidence = np.where(is_sure, confidence, 0.0)
    is_somebody = np.asarray((confidence > 0).any(axis=1))
    if not is_somebody.any():
        least = MIN_CONFIDENCE if min_confidence is None else min_confidence
        raise NobodyError(f"nobody is seen: no keypoint has a confidence of {least:g} (min_confidence) or more")
    return replace(frames, confidence=confidence).rows(is_somebody)


def in_pixels(frames: AnnotatedFrames) -> AnnotatedFrames:
    """Return annotations in pixels: relative coordinates (0 to 1 or -1 to 1) are multiplied by the image size.

    Coordinates are relative if nearly all lie in that range, or a little outside where people leave the image.

    Raises:
        InputError: The coordinates are relative and the size is unknown, or they look like 3D coordinates around 0.
    """
    points = frames.keypoints_px
    if not np.isfinite(points).any() or np.nanpercentile(np.abs(points), 90) > MAX_SHARE:
        return frames
    is_centred = bool(np.nanmean(points < 0) > MAX_NEGATIVE)
    if is_centred and (np.nanpercentile(np.abs(points), 90) > 1 or _has_hips_at_origin(frames)):
        raise InputError(
            "the coordinates lie around 0, within 2: they are not in pixels, but may be MediaPipe's world landmarks; "
            "give pixels, or coordinates from 0 to 1 or from -1 to 1 across the image"
        )
    sizes = [frames.image_size_px.get(name) for name in frames.sequence_id]
    known = [size for size in sizes if size is not None]
    if len(known) < len(sizes):
        raise InputError(
            "nearly all coordinates lie within 2; they seem to be shares of the image, not pixels: say the size of the "
            "image (image_size_px), or have the detector write pixels (OpenPose: --keypoint_scale 0)"
        )
    points = (points + 1) / 2 if is_centred else points
    sides = " and ".join(f"{width} x {height}" for width, height in sorted(set(known)))
    frames = frames.remark(f"coordinates from {-1 if is_centred else 0} to 1 across an image of {sides}")
    return replace(frames, keypoints_px=points * np.array(known, dtype=np.float64).reshape(-1, 1, 2))


def _has_hips_at_origin(frames: AnnotatedFrames) -> bool:
    """Return whether the middle of the hips is always at the origin, as in 3D landmarks."""
    names = get_keypoint_layout(frames.layout).keypoint_names
    hips = [names.index(name) for name in ("left_hip", "right_hip")]
    middle = np.abs(frames.keypoints_px[:, hips].mean(axis=1))
    return not np.isfinite(middle).any() or bool(np.nanpercentile(middle, 90) < MAX_HIPS_AT_ORIGIN)


def in_size(frames: AnnotatedFrames, stated_px: tuple[int, int] | None) -> AnnotatedFrames:
    """Scale annotations to images of the stated size if the file states another size.

    Raises:
        InputError: The image size in the file has another aspect ratio.
    """
    other_sizes = {name: size for name, size in frames.image_size_px.items() if stated_px and size != stated_px}
    if not other_sizes or not stated_px:
        return frames
    scale = {}
    for name, (width, height) in other_sizes.items():
        sides = f"{width} x {height}", f"{stated_px[0]} x {stated_px[1]}"
        if abs(stated_px[0] * height / (width * stated_px[1]) - 1) > MAX_OTHER_SHAPE:
            raise InputError(
                f"its keypoints are of images of {sides[0]}, but the film has {sides[1]} pixels, which is another "
                "shape; give the keypoints of this film"
            )
        scale[name] = stated_px[0] / width
        frames = frames.remark(f"keypoints of images of {sides[0]} scaled to {sides[1]}")
    factors = np.array([scale.get(name, 1.0) for name in frames.sequence_id])
    return replace(
        frames,
        keypoints_px=frames.keypoints_px * factors[:, None, None],
        focal_px={name: focal * scale.get(name, 1.0) for name, focal in frames.focal_px.items()},
        image_size_px={**frames.image_size_px, **dict.fromkeys(other_sizes, stated_px)},
    )


def check_inside(frames: AnnotatedFrames) -> AnnotatedFrames:
    """Return annotations with a doubt if their image seems to have another size.

    That is the case if some sure keypoints lie outside the image, or nearly all in its top left quarter.

    Raises:
        InputError: Many lie outside; the message has both sizes.
    """
    doubts = []
    for name, (width, height) in frames.image_size_px.items():
        is_own = np.array([sequence_id == name for sequence_id in frames.sequence_id], dtype=bool)
        confidence = frames.confidence[is_own]
        seen = confidence[confidence > 0]
        if not len(seen):
            continue
        points = frames.keypoints_px[is_own][confidence >= _SURE_SHARE * np.percentile(seen, 95)]
        sides = np.array([width, height])
        share = float(((points < -MARGIN * sides) | (points > (1 + MARGIN) * sides)).any(axis=-1).mean())
        ends = np.percentile(points, _ENDS, axis=0)
        reach = " x ".join(f"{side:.0f}" for side in (points.max(axis=0) if share > DOUBTED_OUTSIDE else ends))
        both = f"they reach {reach}, and the image is {width} x {height}"
        if share > MAX_OUTSIDE:
            raise InputError(
                f"{share:.0%} of the keypoints of '{name}' lie outside the image: {both}; give the keypoints of an "
                "image of this size, or a file that states the size of its images"
            )
        if share > DOUBTED_OUTSIDE:
            doubts.append(
                f"{share:.0%} of the keypoints of '{name}' lie outside the image: {both}: is it another size?"
            )
        elif (ends <= _HALF * sides).all():
            doubts.append(f"the keypoints of '{name}' lie in a quarter of the image: {both}: is it another size?")
    return replace(frames, doubts=tuple(dict.fromkeys((*frames.doubts, *doubts))))


def stretch(layout: str, keypoints_px: Array, confidence: Array) -> float:
    """Return the length of the body segments relative to the longest possible on a body: below 0.5 for people.

    This is the mean over the segments of the median over the rows; NaN if too little is seen.

    Args:
        layout: Layout to test; if the data has fewer keypoints, the first of the layout.
        keypoints_px: (row, K, 2).
        confidence: (row, K).
    """
    names = get_keypoint_layout(layout).keypoint_names[: keypoints_px.shape[1]]
    is_seen = np.isfinite(keypoints_px).all(axis=-1) & (confidence > 0)
    is_enough = is_seen.sum(axis=1) >= 6
    is_seen, seen = is_seen[is_enough], keypoints_px[is_enough]
    if len(seen) == 0:
        return float("nan")
    highest = np.where(is_seen[..., None], seen, -np.inf).max(axis=1)
    lowest = np.where(is_seen[..., None], seen, np.inf).min(axis=1)
    diagonal = np.maximum(np.linalg.norm(highest - lowest, axis=-1), 1e-9)
    lengths = []
    for (start, end), limit in _SEGMENTS.items():
        if start not in names or end not in names:
            continue
        i, j = names.index(start), names.index(end)
        both = is_seen[:, i] & is_seen[:, j]
        if both.sum() >= MIN_CHECKED_ROWS:
            length = np.linalg.norm(seen[both, i] - seen[both, j], axis=-1)
            lengths.append(float(np.median(length / diagonal[both])) / limit)
    return float(np.mean(lengths)) if len(lengths) >= 4 else float("nan")


def _off_middle(frames: AnnotatedFrames) -> float:
    """Return the distance of the mid-hip from the middle of the hips, a share of the diagonal; NaN if not seen.

    This is the 0.3 quantile over the rows: in a wrong layout all rows are off, detectors err in a few.
    """
    names = get_keypoint_layout(frames.layout).keypoint_names
    if "mid_hip" not in names:
        return float("nan")
    middle, left, right = (names.index(name) for name in ("mid_hip", "left_hip", "right_hip"))
    points = frames.keypoints_px[np.isfinite(frames.keypoints_px[:, [middle, left, right]]).all(axis=(1, 2))]
    if len(points) < MIN_CHECKED_ROWS:
        return float("nan")
    diagonal = np.linalg.norm(np.nanmax(points, axis=1) - np.nanmin(points, axis=1), axis=-1)
    away = np.linalg.norm(points[:, middle] - 0.5 * (points[:, left] + points[:, right]), axis=-1)
    return float(np.quantile(away / np.maximum(diagonal, 1e-9), 0.3))


def check_anatomy(frames: AnnotatedFrames) -> None:
    """Refuse keypoints that are in another order than that of their layout.

    Raises:
        InputError: The segments are too long for a body, or much longer than in another layout (named), or the mid-hip
            is far from the middle of the hips.
    """
    stretch_here = stretch(frames.layout, frames.keypoints_px, frames.confidence)
    if np.isnan(stretch_here):
        return
    others = {
        name: stretch(name, frames.keypoints_px, frames.confidence)
        for name, layout in KEYPOINT_LAYOUTS.items()
        # Keypoints of the usual layouts are sometimes padded with empty ones.
        if name != frames.layout
        and (layout.num_keypoints == frames.keypoints_px.shape[1] or name in USUAL_LAYOUTS)
        and layout.num_keypoints <= frames.keypoints_px.shape[1]
    }
    better = [name for name, value in others.items() if value < CLEARLY_SHORTER * stretch_here]
    off_middle = _off_middle(frames)
    if off_middle > MAX_OFF_MIDDLE:
        hint = "; the order of 'coco18' fits" if others.get("coco18", np.inf) < stretch_here else ""
        raise InputError(
            f"the keypoints do not look like people in the layout '{frames.layout}': the mid-hip lies "
            f"{off_middle:.0%} of a body from the middle of the hips{hint}"
        )
    if stretch_here <= SURE_STRETCH or (stretch_here <= MAX_STRETCH and not better):
        return
    hint = f"; the order of '{min(better, key=lambda name: others[name])}' fits" if better else ""
    raise InputError(
        f"the keypoints do not look like people in the layout '{frames.layout}': their body segments are "
        f"{stretch_here:.0%} of the longest that a body allows (people come to 20-50%){hint}"
    )
