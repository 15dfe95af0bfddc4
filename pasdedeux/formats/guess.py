"""What a file is, and what it does not say: up axis, length unit, frame rate.  Told from content, never from a name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.npz import is_npz, read_npz
from pasdedeux.formats.source_motion import UP_AXES, SourceMotion
from pasdedeux.kinematics.forward import forward_kinematics
from pasdedeux.skeletons.layouts import find_layout

__all__ = ["MotionGuess", "guess_format", "guess_metres_per_unit", "guess_motion", "guess_up_axis"]

Array = npt.NDArray[np.float64]

FORMATS = (
    "bvh",
    "asf",
    "amc",
    "openpose",
    "coco",
    "annotation_csv",
    "annotation_npz",
    "positions_npz",
    "rotation_rows",
)

UNITS_M = {"metre": 1.0, "centimetre": 0.01, "inch": 0.0254, "millimetre": 0.001, "CMU unit": 0.0254 / 0.45}
"""Length units that motion files come in."""

ADULT_HEIGHT_M = (1.35, 2.1)
"""Statures within which a length unit is believed."""
USUAL_HEIGHT_M = 1.7
STATURE_OF_CHAIN = 1.13
"""Stature over the chain from the ankle to the ear: the foot is 5 % of it and the head above the ear 7 %."""

_SAMPLE = 200
"""Frames looked at for a guess."""


@dataclass(frozen=True)
class MotionGuess:
    """What a motion file seems to be; each sureness runs from 0 (a guess) to 1 (the file says so).

    Args:
        layout: Name of the layout that its joints belong to, None when no known one fits.
        up_axis: x, y or z.
        up_sureness: How clearly the bodies stand along that axis.
        metres_per_unit: Length of the file's unit.
        unit_sureness: 1 when the file states it.
        unit_reason: Why, in words.
        height_m: About the stature that follows from that unit.
        rate_hz: Frame rate the file states, None if it states none.
    """

    layout: str | None
    up_axis: str
    up_sureness: float
    metres_per_unit: float
    unit_sureness: float
    unit_reason: str
    height_m: float
    rate_hz: float | None


def guess_format(data: bytes) -> str:
    """Return the format of a file's content, one of `FORMATS`.

    Raises:
        FormatError: It is none of them.
    """
    if is_npz(data):
        names = set(read_npz(data, "npz archive"))
        if "keypoints_px" in names:
            return "annotation_npz"
        if "positions_m" in names:
            return "positions_npz"
        raise FormatError(
            "this npz archive has neither 'keypoints_px' (2D annotations) nor 'positions_m' (3D positions)"
        )
    head = data[:200_000].decode("utf-8-sig", errors="replace")
    start = head.lstrip()
    if re.match(r"HIERARCHY\b", start, re.IGNORECASE):
        return "bvh"
    if re.search(r"^\s*:bonedata\b", head, re.IGNORECASE | re.MULTILINE):
        return "asf"
    if re.search(r"^\s*:(fully-specified|degrees|radians)\b", head, re.IGNORECASE | re.MULTILINE):
        return "amc"
    if start[:1] in "[{" and start:
        if '"people"' in head:
            return "openpose"
        if '"keypoints"' in head or '"annotations"' in head or '"images"' in head:
            return "coco"
        raise FormatError("this JSON file is neither OpenPose (it has no 'people') nor COCO (no 'annotations')")
    for line in head.splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            cells = {cell.strip().lower() for cell in line.split(",")}
            if {"frame", "person", "joint", "x", "y"} <= cells:
                return "annotation_csv"
            words = line.split()
            if len(words) >= 9 and len(words) % 3 == 0 and all(re.fullmatch(r"[-+0-9.eE]+", word) for word in words):
                return "rotation_rows"
            break
    raise FormatError(f"this file is none of the known formats: {', '.join(FORMATS)}")


def guess_up_axis(source: SourceMotion) -> tuple[str, float]:
    """Return the axis along which the bodies stand, and how clearly: the mean cosine between them, 0 to 1.

    Bodies that lie as much as they stand give y, with little sureness: most files are y-up.
    """
    step = max(1, source.num_frames // _SAMPLE)
    positions, _ = forward_kinematics(
        source.skeleton, source.rest_offsets, source.root_translation[::step], source.local_unitquat[::step]
    )
    layout = find_layout(source.skeleton.joint_names)
    if layout is not None:
        names = list(source.skeleton.joint_names)
        top = names.index(layout.joint_map("body22").carrier("neck"))
        low = [names.index(layout.joint_map("body22").carrier(f"{side}_ankle")) for side in ("left", "right")]
        body = positions[:, top] - positions[:, low].mean(axis=1)
    else:
        # The root sits between legs and trunk; the leaves farthest from it on either side are head and feet.
        ends = [j for j in range(source.skeleton.num_joints) if not source.skeleton.children(j)]
        spread = positions[:, ends] - positions[:, source.skeleton.root][:, None]
        extent = np.abs(spread).max(axis=1).mean(axis=0)
        axis = int(np.argmax(extent))
        return UP_AXES[axis], float(np.clip(1.0 - np.partition(extent, 1)[1] / max(extent[axis], 1e-12), 0.0, 1.0))
    length = np.linalg.norm(body, axis=-1, keepdims=True)
    mean = (body / np.where(length > 0, length, 1.0)).mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    sureness = float(np.abs(mean[axis]))
    return (UP_AXES[axis], sureness) if sureness > 0.7 else ("y", min(sureness, 0.3))


def guess_common_up_axis(sources: Sequence[SourceMotion]) -> str:
    """Return the up axis of people who were captured together: that of the one for whom it is clearest, y among equals.

    One of two may lie on the floor all the time, as wrestlers do; alone that body would be taken to stand along it.
    Sureness that differs by less than a tenth decides nothing: most files are y-up.

    Raises:
        InputError: There is nobody.
    """
    if not sources:
        raise InputError("the up axis of nobody was asked for")
    guesses = [guess_up_axis(source) for source in sources]
    clear = max(sureness for _, sureness in guesses) - 0.1
    axes = [axis for axis, sureness in sorted(guesses, key=lambda guess: -guess[1]) if sureness > clear]
    return "y" if "y" in axes else axes[0]


def guess_metres_per_unit(source: SourceMotion) -> tuple[float, float, str, float]:
    """Return metres per unit, how sure it is, why, and the body height (in metres) that follows.

    The unit is the file's own where it states one; else the known unit that makes an adult of the body.
    """
    height = body_height(source)
    if source.metres_per_unit is not None:
        return source.metres_per_unit, 1.0, "the file states its unit", height * source.metres_per_unit
    if height <= 0:
        return 1.0, 0.0, "the body has no height", 0.0
    ranked = sorted(UNITS_M, key=lambda name: abs(np.log(height * UNITS_M[name] / USUAL_HEIGHT_M)))
    name, rival = ranked[0], ranked[1]
    metres = height * UNITS_M[name]
    if not ADULT_HEIGHT_M[0] <= metres <= ADULT_HEIGHT_M[1]:
        sureness = 0.1
    elif ADULT_HEIGHT_M[0] <= height * UNITS_M[rival] <= ADULT_HEIGHT_M[1]:
        sureness = 0.4
    else:
        sureness = 0.8 if abs(np.log(metres / USUAL_HEIGHT_M)) < 0.15 else 0.5
    reason = f"in units of one {name} the body is {metres:.2f} m tall"
    return UNITS_M[name], sureness, reason, metres


def body_height(source: SourceMotion) -> float:
    """Return the stature in file units by the chain ankle, hip, neck, ear; else the extent of the rest pose."""
    layout = find_layout(source.skeleton.joint_names)
    rest, _ = forward_kinematics(
        source.skeleton,
        source.rest_offsets,
        np.zeros(3),
        np.tile([0.0, 0.0, 0.0, 1.0], (source.skeleton.num_joints, 1)),
    )
    if layout is None:
        lowest, highest = rest.min(axis=0), rest.max(axis=0)
        return float((highest - lowest).max())
    names = list(source.skeleton.joint_names)
    places = layout.joint_map("body22")

    def place(joint: str) -> Array:
        weights = {name: weight for name, weight in places.weights(joint).items() if name in names}
        return np.asarray(sum(weight * rest[names.index(name)] for name, weight in weights.items()))

    def chain(*joints: str) -> float:
        points = [place(joint) for joint in joints]
        return float(sum(np.linalg.norm(b - a) for a, b in pairwise(points)))

    leg = np.mean([chain(f"{side}_hip", f"{side}_knee", f"{side}_ankle") for side in ("left", "right")])
    hips = (place("left_hip") + place("right_hip")) / 2
    trunk = float(np.linalg.norm(place("spine1") - hips)) + chain("spine1", "spine2", "spine3", "neck", "head")
    return (float(leg) + trunk) * STATURE_OF_CHAIN


def guess_motion(source: SourceMotion) -> MotionGuess:
    """Return everything that can be told of a motion that its file does not say."""
    layout = find_layout(source.skeleton.joint_names)
    up_axis, up_sureness = guess_up_axis(source)
    metres_per_unit, unit_sureness, reason, height = guess_metres_per_unit(source)
    return MotionGuess(
        layout=layout.name if layout else None,
        up_axis=up_axis,
        up_sureness=up_sureness,
        metres_per_unit=metres_per_unit,
        unit_sureness=unit_sureness,
        unit_reason=reason,
        height_m=height,
        rate_hz=source.rate_hz,
    )
