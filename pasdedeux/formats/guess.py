"""What a motion file does not state, estimated from its content: up axis, length unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.formats.source_motion import UP_AXES, SourceMotion
from pasdedeux.kinematics.forward import forward_kinematics
from pasdedeux.kinematics.rotations import identity_unitquat
from pasdedeux.skeletons.layouts import find_layout

UNITS_M = {"metre": 1.0, "centimetre": 0.01, "inch": 0.0254, "millimetre": 0.001, "CMU unit": 0.0254 / 0.45}
"""Length units that motion files come in: so far apart that only one of them can make an adult of a body."""

ADULT_HEIGHT_M = (1.35, 2.1)
"""Statures within which a length unit is believed."""
USUAL_HEIGHT_M = 1.7
STATURE_OF_CHAIN = 1.13
"""Stature over the chain from the ankle to the ear: the foot is 5 % of it and the head above the ear 7 %."""

_SAMPLE = 200
"""Frames that a guess is made from."""


@dataclass(frozen=True)
class AxisGuess:
    """Which axis points up, and how clearly the bodies stand along it: from 0 (a guess) to 1."""

    axis: str
    confidence: float


@dataclass(frozen=True)
class UnitGuess:
    """The length of a file's unit.

    Args:
        metres_per_unit: The length.
        confidence: From 0 (a guess) to 1 (the file says so).
        reason: Why, in words.
        height_m: About the stature that follows from it.
    """

    metres_per_unit: float
    confidence: float
    reason: str
    height_m: float


@dataclass(frozen=True)
class MotionGuess:
    """What a motion file seems to be.

    Args:
        layout: Name of the layout that its joints belong to, None when no known one fits.
        up: Its up axis.
        unit: Its length unit.
        rate_hz: Frame rate the file states, None if it states none.
    """

    layout: str | None
    up: AxisGuess
    unit: UnitGuess
    rate_hz: float | None


def guess_up_axis(source: SourceMotion) -> AxisGuess:
    """Return the axis along which the body stands; how clearly is the mean cosine between them.

    A body that lies as much as it stands gives y, with little confidence: most files are y-up.
    """
    step = max(1, source.num_frames // _SAMPLE)
    positions, _ = forward_kinematics(
        source.skeleton, source.rest_offsets, source.root_translation[::step], source.local_unitquat[::step]
    )
    layout = find_layout(source.skeleton, source.rest_offsets)
    if layout is None:
        # The root sits between legs and trunk; the leaves farthest from it on either side are head and feet.
        ends = [j for j in range(source.skeleton.num_joints) if not source.skeleton.children(j)]
        spread = positions[:, ends] - positions[:, source.skeleton.root][:, None]
        extent = np.abs(spread).max(axis=1).mean(axis=0)
        axis = int(np.argmax(extent))
        clearness = 1.0 - np.partition(extent, 1)[1] / max(extent[axis], 1e-12)
        return AxisGuess(list(UP_AXES)[axis], float(np.clip(clearness, 0.0, 1.0)))
    body22 = layout.joint_map("body22")
    top, *low = source.skeleton.indices(map(body22.carrier, ("neck", "left_ankle", "right_ankle")))
    body = positions[:, top] - positions[:, low].mean(axis=1)
    length = np.linalg.norm(body, axis=-1, keepdims=True)
    mean = (body / np.where(length > 0, length, 1.0)).mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    confidence = float(np.abs(mean[axis]))
    return AxisGuess(list(UP_AXES)[axis], confidence) if confidence > 0.7 else AxisGuess("y", min(confidence, 0.3))


def common_up_axis(guesses: Sequence[AxisGuess]) -> AxisGuess:
    """Return the up axis of people who were captured together: that of the one for whom it is clearest, y among equals.

    One of two may lie on the floor all the time, as wrestlers do; alone that body would be taken to stand along it.
    A confidence that differs by less than a tenth decides nothing: most files are y-up.
    """
    ranked = sorted(guesses, key=lambda guess: -guess.confidence)
    clear = [guess for guess in ranked if guess.confidence > ranked[0].confidence - 0.1]
    return next((guess for guess in clear if guess.axis == "y"), clear[0])


def guess_unit(source: SourceMotion) -> UnitGuess:
    """Return the file's own unit where it states one; else the known unit that makes an adult of the body."""
    height = _body_height(source)
    if source.metres_per_unit is not None:
        return UnitGuess(source.metres_per_unit, 1.0, "the file states its unit", height * source.metres_per_unit)
    if height <= 0:
        return UnitGuess(1.0, 0.0, "the body has no height", 0.0)
    name = min(UNITS_M, key=lambda unit: abs(np.log(height * UNITS_M[unit] / USUAL_HEIGHT_M)))
    metres = height * UNITS_M[name]
    if not ADULT_HEIGHT_M[0] <= metres <= ADULT_HEIGHT_M[1]:
        confidence = 0.1
    else:
        confidence = 0.8 if abs(np.log(metres / USUAL_HEIGHT_M)) < 0.15 else 0.5
    return UnitGuess(UNITS_M[name], confidence, f"in units of one {name} the body is {metres:.2f} m tall", metres)


def guess_motion(source: SourceMotion) -> MotionGuess:
    """Return estimates of everything that a motion file may not state."""
    layout = find_layout(source.skeleton, source.rest_offsets)
    return MotionGuess(
        layout=layout.name if layout else None,
        up=guess_up_axis(source),
        unit=guess_unit(source),
        rate_hz=source.rate_hz,
    )


def _body_height(source: SourceMotion) -> float:
    """Return the stature in file units by the chain ankle, hip, neck, ear; else the extent of the rest pose."""
    layout = find_layout(source.skeleton, source.rest_offsets)
    num_joints = source.skeleton.num_joints
    rest, _ = forward_kinematics(source.skeleton, source.rest_offsets, np.zeros(3), identity_unitquat(num_joints))
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
