"""Estimates of properties that a motion file does not state: up axis, length unit, whether it is mirrored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.formats.rigs.own_skeleton import body_map
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.layouts import Draft, Layout, draft_mapping, find_layout
from pasdedeux.skeletons.skeleton import by_side

UNITS_M = {
    "metre": 1.0,
    "decimetre": 0.1,
    "centimetre": 0.01,
    "inch": 0.0254,
    "millimetre": 0.001,
    "CMU unit": 0.0254 / 0.45,
}
"""Length units of motion files, so different that a body has the height of an adult in only one of them."""

ADULT_HEIGHT_M = (1.35, 2.1)
"""Statures within which an estimated length unit is plausible."""
USUAL_HEIGHT_M = 1.7
HUMAN_HEIGHT_M = (0.7, 2.6)
"""Statures within which a stated unit is accepted."""
_GUESSED = 0.5
"""Confidence of a unit that contradicts the stated one."""
STATURE_OF_CHAIN = 1.13
"""Stature over the chain from the ankle to the ear: the foot is 5 % of it and the head above the ear 7 %."""

_STANDS, _CLEARLY, _AT_REST = 0.7, 0.9, 0.5
"""Mean cosine between body and axis from which the body stands, and stands clearly; confidence of a rest pose."""
_WALKS, _FLAT = 0.5, 0.4
"""Shares of the stature: minimum travel of the feet of a standing person, maximum thickness of a lying one."""
_LEVEL = 0.05
"""Maximum change of height of hands that stand on the floor, a share of the stature."""
_BENT, _HARDLY, _CLEAR = 0.03, 0.3, 0.5
"""Deviation of a clearly bent knee, a share of the leg; share of that which is ignored; a clear cosine."""
_HIPS, _KNEES, _ANKLES, _TOES, _SHOULDERS, _WRISTS = (
    BODY22.indices(by_side("left", joint)) for joint in ("hip", "knee", "ankle", "toe", "shoulder", "wrist")
)
_TOE_NAMES = by_side("left", "toe")


@dataclass(frozen=True)
class AxisGuess:
    """The up axis and its confidence from 0 (a guess) to 1, by how clearly bodies stand along it."""

    axis: str
    confidence: float


@dataclass(frozen=True)
class UnitGuess:
    """The length of a file's unit.

    Args:
        metres_per_unit: The length.
        confidence: From 0 (a guess) to 1 (the file says so).
        reason: The reason, in words.
        height_m: Approximate stature in this unit.
    """

    metres_per_unit: float
    confidence: float
    reason: str
    height_m: float


@dataclass(frozen=True)
class MirrorGuess:
    """Whether a file exchanges left and right, and the confidence from 0 (a guess) to 1."""

    is_mirrored: bool
    confidence: float


def guess_up_axis(source: SourceMotion, layout: Layout | None = None) -> AxisGuess:
    """Return the axis along which the body stands, feet below head; the confidence is the mean cosine between both.

    If the body does not stand clearly, the axis is that of a standing rest pose, else y with low confidence, because
    most files are y-up.  If hands stay at one height above the head while feet do not, the person may stand on the
    hands, and the confidence is halved.  A person who does not walk may lie if the rest pose stands along another axis.

    Args:
        source: The motion.
        layout: Layout of its joints; detected by default.
    """
    positions, body = _sample(source, layout)
    if body is None:
        return _axis_of_leaves(source, positions)
    feet, neck = body[:, _ANKLES].mean(axis=1), body[:, BODY22.index("neck")]
    stature = float(np.median(np.linalg.norm(neck - feet, axis=-1)))
    stands = _axis_of(normalise(neck - feet).mean(axis=0))
    at_rest = _axis_at_rest(source, layout)
    is_other = at_rest.confidence > _CLEARLY and at_rest.axis != stands.axis
    if is_other and stands.confidence < _CLEARLY:
        return replace(at_rest, confidence=_AT_REST)
    if at_rest.confidence <= _CLEARLY and stands.confidence <= _STANDS:
        return AxisGuess("y", min(stands.confidence, 0.3))
    across = body[..., "xyz".index(at_rest.axis[-1])]
    may_lie = float(np.median(np.ptp(across, axis=1))) < _FLAT * stature
    if is_other and may_lie and float(np.ptp(feet, axis=0).max()) < _WALKS * stature:
        return replace(stands, confidence=_AT_REST)
    heights = body[..., "xyz".index(stands.axis[-1])] * (-1.0 if stands.axis[0] == "-" else 1.0)
    hands, soles = heights[:, _WRISTS].min(axis=1), heights[:, _ANKLES].min(axis=1)
    are_above = float(np.mean(hands > heights[:, BODY22.index("head")])) > _STANDS
    if are_above and np.ptp(hands) < min(np.ptp(soles) / 2.0, _LEVEL * stature):
        return replace(stands, confidence=stands.confidence / 2.0)
    return stands


def _axis_at_rest(source: SourceMotion, layout: Layout | None) -> AxisGuess:
    """Return the axis along which the rest pose stands; confidence 0 if trunk and legs have different directions."""
    _, body = _sample(source.rest, layout)
    assert body is not None
    feet, hips, neck = body[0, _ANKLES].mean(axis=0), body[0, _HIPS].mean(axis=0), body[0, BODY22.index("neck")]
    stands = normalise(neck - hips) @ normalise(hips - feet) > _STANDS
    return _axis_of(normalise(neck - feet)) if stands else AxisGuess("y", 0.0)


def _axis_of(direction: Array) -> AxisGuess:
    axis = int(np.argmax(np.abs(direction)))
    return AxisGuess("-" * bool(direction[axis] < 0) + "xyz"[axis], float(np.abs(direction[axis])))


def _axis_of_leaves(source: SourceMotion, positions: Array) -> AxisGuess:
    """Return the axis of the ends farthest from the root, which lies between head and feet."""
    ends = [joint for joint in range(source.skeleton.num_joints) if not source.skeleton.children(joint)]
    spread = positions[:, ends] - positions[:, source.skeleton.root][:, None]
    extent = np.abs(spread).max(axis=1).mean(axis=0)
    axis = int(np.argmax(extent))
    clearness = 1.0 - np.partition(extent, 1)[1] / max(extent[axis], 1e-12)
    return AxisGuess("xyz"[axis], float(np.clip(clearness, 0.0, 1.0)))


def guess_mirrored(source: SourceMotion, layout: Layout | None = None) -> MirrorGuess:
    """Return whether left and right are exchanged: whether toes point, and knees bend, to the back of the body.

    The front is to the right of the line from the right hip and shoulder to the left ones, seen from above.  Toes that
    are derived from that line are ignored.

    Args:
        source: The motion.
        layout: Layout of its joints; detected by default.
    """
    layout = layout or _layout_of(source)
    _, body = _sample(source, layout)
    if layout is None or body is None:
        return MirrorGuess(False, 0.0)
    feet = body[:, _ANKLES]
    up = body[:, BODY22.index("neck")] - body[:, _HIPS].mean(axis=1)
    left = sum(body[:, pair[0]] - body[:, pair[1]] for pair in (_HIPS, _SHOULDERS))
    front = normalise(np.cross(left, up))[:, None]
    entries = [layout.tables[BODY22.name][joint] for joint in _TOE_NAMES]
    real_toes = [at for at, entry in enumerate(entries) if entry in source.skeleton.joint_names]
    toes = (normalise(body[:, _TOES] - feet)[:, real_toes] * front).sum(axis=-1)
    knees = body[:, _KNEES] - (body[:, _HIPS] + feet) / 2.0
    legs = np.linalg.norm(body[:, _HIPS] - feet, axis=-1)
    bent = (knees * front).sum(axis=-1) / np.where(legs > 0, legs, 1.0)
    knee = float(np.clip(np.median(bent) / _BENT, -1.0, 1.0))
    toe = float(np.median(toes)) if real_toes else knee
    forward = (toe + knee) / 2.0 if abs(knee) > _HARDLY else toe
    return MirrorGuess(forward < 0, min(abs(forward) / _CLEAR, 1.0))


def common_up_axis(guesses: Sequence[AxisGuess]) -> AxisGuess:
    """Return the common up axis of people captured together: the one with the highest confidence, y if about equal.

    One of two people may lie on the floor all the time, as in wrestling; alone, that body would seem to stand along the
    floor.  Confidences that differ by less than 0.1 are equal, because most files are y-up.
    """
    ranked = sorted(guesses, key=lambda guess: -guess.confidence)
    clear = [guess for guess in ranked if guess.confidence > ranked[0].confidence - 0.1]
    return next((guess for guess in clear if guess.axis == "y"), clear[0])


def guess_unit(source: SourceMotion, layout: Layout | None = None) -> UnitGuess:
    """Return the unit that the file states, else the known unit that gives the body an adult height.

    A stated unit in which the body is no human is replaced, if a known unit gives an adult height, as a guess.

    Args:
        source: The motion.
        layout: Layout of its joints; detected by default.
    """
    height = _body_height(source, layout)
    if source.metres_per_unit is not None:
        stated_m = height * source.metres_per_unit
        known = guess_unit(replace(source, metres_per_unit=None), layout)
        if HUMAN_HEIGHT_M[0] <= stated_m <= HUMAN_HEIGHT_M[1] or known.confidence < _GUESSED:
            return UnitGuess(source.metres_per_unit, 1.0, "the file states its unit", stated_m)
        reason = f"the unit that the file states makes the body {stated_m:.3g} m tall; {known.reason}"
        return UnitGuess(known.metres_per_unit, _GUESSED, reason, known.height_m)
    if height <= 0:
        return UnitGuess(1.0, 0.0, "the body has no height", 0.0)
    name = min(UNITS_M, key=lambda unit: abs(np.log(height * UNITS_M[unit] / USUAL_HEIGHT_M)))
    metres = height * UNITS_M[name]
    if not ADULT_HEIGHT_M[0] <= metres <= ADULT_HEIGHT_M[1]:
        confidence = 0.1
    else:
        confidence = 0.8 if abs(np.log(metres / USUAL_HEIGHT_M)) < 0.15 else 0.5
    return UnitGuess(UNITS_M[name], confidence, f"in units of one {name} the body is {metres:.2f} m tall", metres)


def draft_motion(source: SourceMotion) -> Draft:
    """Draft a layout of a motion from names, tree and movement; see `draft_mapping`."""
    return draft_mapping(source.skeleton, source.rest_offsets, source.sample[0])


def _layout_of(source: SourceMotion) -> Layout | None:
    """Return the known layout of a motion, else a drafted one; None if that lacks parts."""
    known = find_layout(source.skeleton, source.rest_offsets)
    draft = None if known else draft_motion(source)
    return draft.layout("draft") if draft and draft.is_whole else known


def _sample(source: SourceMotion, layout: Layout | None) -> tuple[Array, Array | None]:
    """Return positions of the joints and of body22 (frame, joint, 3) in some frames; None for body22 if no body."""
    positions, world = source.sample
    layout = layout or _layout_of(source)
    if layout is None:
        return positions, None
    return positions, body_map(layout, source.skeleton, source.rest_offsets).positions(positions, world)


def _body_height(source: SourceMotion, layout: Layout | None) -> float:
    """Return the stature in file units from the chain ankle, hip, neck, ear; without a layout the extent of joints."""
    positions, body = _sample(source, layout)
    if body is None:
        return float(np.median(np.ptp(positions, axis=1).max(axis=-1)))

    def chain(*points: Array) -> Array:
        return np.asarray(sum(np.linalg.norm(after - before, axis=-1) for before, after in pairwise(points)))

    legs = [chain(*(body[:, joint] for joint in limb)) for limb in BODY22.legs]
    trunk = (body[:, BODY22.index(joint)] for joint in ("spine1", "spine2", "spine3", "neck", "head"))
    return float(np.median(sum(legs) / 2.0 + chain(body[:, _HIPS].mean(axis=1), *trunk))) * STATURE_OF_CHAIN
