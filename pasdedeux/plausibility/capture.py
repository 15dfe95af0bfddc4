"""Check a capture: compare the motion of the people of a take with what people can do.

Figures do not depend on the position and heading of a take.  Speed and jerk are taken over the whole number of frames
nearest to 1/30 s, and a jump is a distance, so figures hardly depend on the frame rate.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.figure import Figure, Limits, complaints, figure, figures_of
from pasdedeux.formats.rigs.guess import USUAL_HEIGHT_M
from pasdedeux.interaction.floor import StandingSettings, find_standing
from pasdedeux.interaction.surfaces import closest_joint_distance, surface_gaps
from pasdedeux.kinematics import bone_lengths
from pasdedeux.people.names import person_name
from pasdedeux.plausibility.capsules import body_height_m, capsule_model
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level, Verdict

_STEP_S, _SAMPLE_S = 1 / 30, 1 / 10
"""Time over which speed and jerk are taken, and time between the frames in which partners and floor are checked."""
_JERK_PERCENT, _FLOOR_PERCENT, _DEPTH_PERCENT = 95.0, 5.0, 95.0
_LOW_M, _AIR_M, _HELD_M = 0.05, 0.15, 0.2
"""A foot joint bears weight if it is at most the first above the smallest height of its foot, which is less than the
second above that of the other foot.  A person without a joint below the second is in the air (joints of feet lie 2-10
cm above the soles), or held by a partner nearer than the third."""
_UPRIGHT = 0.5
"""Smallest cosine between the vertical and the line from ankles to neck of an upright person."""
_UP, _LEVEL = 1, [0, 2]
_ANKLES = BODY22.indices(["left_ankle", "right_ankle"])
_FEET = [*_ANKLES, *BODY22.indices(["left_toe", "right_toe"])]
_OTHER_OF_FOOT = [2, 3, 0, 1]
"""For each of these, the index of the other joint of the same foot."""
_NECK = BODY22.index("neck")
_TRUNK = BODY22.indices(["spine1", "spine2", "spine3", "neck"])
_TOES = BODY22.indices(["left_toe", "right_toe"])
_STANDING = StandingSettings(away_share=1.0)
_FLAT, _FLAT_SHARE = 0.43, 0.05
"""Largest sine of the slope from toe to ankle of a flat foot (typically 0.26; 0.73 for a hanging foot), and smallest
share of frames with flat feet that determine a floor."""
_EXTENT_M = 0.1
"""Smallest standard deviation of the places of flat feet, in their narrower direction, that determines the tilt."""

_OF_TAKE = (
    *("floor_spread_m", "floor_gap_m", "tilt_rad", "upright_share", "distance_m", "trunk_m"),
    *("penetration_m", "twin_m", "body_difference_m"),
)


@dataclass(frozen=True)
class PersonCapture:
    """Figures of one person of a take, columns of `take_quality`.

    Figures from `floor_spread_m` on are of the whole take, and NaN if they need a partner and there is none.
    """

    stature_m: float = figure("Stature, estimated from the length of the legs")
    speed_m_s: float = figure(
        "Largest speed of a joint over 1/30 s",
        (15.0, 25.0),  # of the best throws and kicks
        complaint="moves the {speed_joint} at {speed_m_s:.0f} m/s",
    )
    speed_joint: str = figure("Name of that joint (body22)")
    jerk_m_s3: float = figure(
        "Jerk of the worst joint, 95th percentile over frames, over 1/30 s",
        (2000.0, 5000.0),  # capture has 30-500, noisy up to 1,600
        complaint="shakes the {jerk_joint} with a jerk of {jerk_m_s3:.0f} m/s3",
    )
    jerk_joint: str = figure("Name of that joint (body22)")
    jump_m: float = figure(
        "Largest step of a joint in 1/30 s that its speed before and after does not explain",
        (0.25, 0.4),  # fast dance has up to 0.2
        complaint="the {jump_joint} jumps by {jump_m:.2f} m at {jump_s:.2f} s",
    )
    jump_joint: str = figure("Name of that joint (body22)")
    jump_s: float = figure("Time of that jump from the start of the take")
    start_jump_m: float = figure(
        "Largest step of a joint out of the first 1/30 s that its later speed does not explain",
        (0.15, 0.6),
        complaint="jumps by {start_jump_m:.2f} m out of its first frame, perhaps a T-pose: cut that frame",
    )
    skate_m_s: float = figure(
        "Median speed of the stiller supporting foot",
        (0.3, 0.6),  # capture has 0.22 at most
        complaint="the supporting feet slide at {skate_m_s:.2f} m/s",
    )
    sunk_m: float = figure(
        "Depth of the lowest joint under the floor, 95th percentile; negative above",
        (0.1, 0.25),
        complaint="is {sunk_m:.2f} m deep in the floor",
    )
    floating_share: float = figure(
        "Share of the frames in which all joints are in the air and no partner is near",
        (0.25, 0.5),
        complaint="is in the air for {floating_share:.0%} of the time, held by nobody",
    )
    floor_spread_m: float = figure(
        "Range of the heights of standing ankles, 5th to 95th percentile",
        (0.2, 0.4),
        complaint="feet stand at heights {floor_spread_m:.2f} m apart, as on stairs or with a wrong up_axis",
    )
    floor_gap_m: float = figure(
        (
            "Difference of the floor heights under the flat feet of partners; NaN if fewer than two people "
            "have flat feet"
        ),
        (0.08, 0.2),
        complaint="people stand on floors {floor_gap_m:.2f} m apart",
    )
    tilt_rad: float = figure(
        (
            "Tilt of the floor: the smaller of the tilt by flat feet and the common lean of everybody; NaN if "
            "nobody stands"
        ),
        (0.06, 0.12),
        complaint="floor and people tilt by {tilt_rad:.2f} rad: up_axis may be wrong",
    )
    upright_share: float = figure(
        "Share of the frames in which somebody is upright",
        (0.05, 0.01),  # push-ups on a partner have 0.6
        complaint="nobody is upright: up_axis may be wrong",
    )
    distance_m: float = figure(
        "Smallest distance between joints of the partners; NaN without a partner",
        (1.0, 5.0),
        complaint="the partners come no nearer than {distance_m:.1f} m",
    )
    trunk_m: float = figure(
        "Smallest distance between the spines of the partners; NaN without a partner",
        (0.12, 0.08),  # close dance has 0.15, a hug 0.25
        complaint=(
            "the spines of the partners come within {trunk_m:.2f} m, through each other, as if two takes were combined"
        ),
    )
    penetration_m: float = figure(
        "Depth of the deepest overlap with a partner, by capsules, 95th percentile; NaN without a partner",
        (0.12, 0.16),  # who pushes on a back has 0.11; one chest in another 0.18
        complaint="people are {penetration_m:.2f} m inside each other",
    )
    twin_m: float = figure(
        "Difference of the poses of the partners at equal size, 95th percentile; NaN without a partner",
        (0.03, 0.015),  # duets have 0.05
        complaint="the partners move alike to {twin_m:.3f} m: the same motion twice",
    )
    body_difference_m: float = figure(
        "Largest difference between bone lengths of the partners; NaN without a partner",
        (0.0005, 0.0),  # people have 0.02 and more, twice the same betas nothing
        complaint="the partners have the same body: all bones have equal lengths, as if betas were given twice",
    )

    @property
    def stature_factor(self) -> float:
        """Factor by which the stature is larger or smaller than usual."""
        return max(self.stature_m / USUAL_HEIGHT_M, USUAL_HEIGHT_M / max(self.stature_m, 1e-9))

    def complaints(self, limits: Limits) -> list[Complaint]:
        """Return the complaints about figures that are past their limits."""
        judged = complaints(self, JUDGED, limits)
        return [Complaint(level, text, of_figure.name in _OF_TAKE) for of_figure, level, text in judged]


FIGURES = figures_of(PersonCapture)
JUDGED = {
    "stature_factor": Figure(
        "stature_factor",
        "",
        "How many times the stature is larger or smaller than usual",
        limits=(1.3, 2.0),  # 1.31 to 2.21 m are grown people
        complaint="is {stature_m:.3g} m tall by the legs",
    ),
    **FIGURES,
}


@dataclass(frozen=True)
class Complaint:
    """A figure past its limit, in words; of the whole take or of one of its people."""

    level: Level
    text: str
    is_of_take: bool


@dataclass(frozen=True)
class JudgedCapture:
    """Verdicts on a take and on each of its people."""

    take: Verdict
    people: tuple[Verdict, ...]


def judge_capture(people: Sequence[PersonCapture], limits: Limits, names: Sequence[str] = ()) -> JudgedCapture:
    """Return the verdicts on a take; complaints about the whole take stand in the verdict of each of its people.

    Args:
        people: Figures of each person.
        limits: Allowed ranges.
        names: Names of the files of the people, if any; names of different takes give a warning.
    """
    apart = next(filter(None, (_names_apart(*both) for both in combinations(names, 2))), "")
    shared = [Complaint(Level.WARN, apart, is_of_take=True)] if apart else []
    complaints = [shared + person.complaints(limits) for person in people]
    everybody = [
        item if item.is_of_take or len(people) == 1 else replace(item, text=f"{person_name(person)}: {item.text}")
        for person, of_person in enumerate(complaints)
        for item in of_person
    ]
    return JudgedCapture(_verdict(everybody), tuple(_verdict(of_person) for of_person in complaints))


def _verdict(complaints: Sequence[Complaint]) -> Verdict:
    """Return the worst level, and all complaints once, failures first."""
    in_order = dict.fromkeys(sorted(complaints, key=lambda complaint: complaint.level is not Level.FAIL))
    return Verdict(
        next(iter(in_order)).level if in_order else Level.PASS, "; ".join(complaint.text for complaint in in_order)
    )


def _names_apart(one: str, other: str) -> str:
    """Return a complaint if two names seem to be of different takes, else an empty text.

    Names of partners differ in one part (60_03 and 61_03).  Names with a single part, and equal names, whose folders
    distinguish the people, are not judged.
    """
    if one == other:
        return ""
    first, second = (re.findall("[a-z0-9]+", name.rsplit(".", 1)[0].lower()) for name in (one, other))
    if first == second:
        return f"{one} and {other} have one name: one performance twice"
    is_apart = min(len(first), len(second)) > 1 and (Counter(first) - Counter(second)).total() > 1
    return f"{one} and {other} are named as files of two takes" if is_apart else ""


def check_capture(body22_m: Array, *, rate_hz: float) -> list[PersonCapture]:
    """Return the figures of each person of a take.

    Args:
        body22_m: Positions (frame, person, 22, 3) of all people, y up, metres, at the capture's own rate; at
            least one frame.
        rate_hz: Frames per second.

    A person who never touches the floor has no sliding feet; motions of fewer than 4 steps of 1/30 s have no jerk.
    """
    low = body22_m[..., _UP].min(axis=-1)
    floor = np.percentile(body22_m[:, :, _FEET, _UP].min(axis=(1, 2)), _FLOOR_PERCENT)
    ankles, step = body22_m[:, :, _ANKLES], max(1, round(rate_hz * _STEP_S))
    rise = body22_m[:, :, _NECK] - ankles.mean(axis=2)
    is_upright = rise[..., _UP] > _UPRIGHT * _norm(rise)
    floors_m, slope = _floors(ankles, body22_m[:, :, _TOES], rate_hz=rate_hz, step=step)
    upright = rise[is_upright] / _norm(rise[is_upright])[:, None]
    lean = float(_norm(upright.mean(axis=0)[_LEVEL])) if len(upright) else np.nan
    standing = ankles[..., _UP][find_standing(ankles, rate_hz=rate_hz, settings=_STANDING)]
    of_take = dict.fromkeys(_OF_TAKE, np.nan) | {
        "floor_spread_m": float(np.ptp(np.percentile(standing, [5.0, 95.0]))) if len(standing) else 0.0,
        "floor_gap_m": float(np.ptp(floors_m)) if len(floors_m) > 1 else np.nan,
        "tilt_rad": float(np.fmin(np.arctan(slope), np.arcsin(lean))) if len(upright) else np.nan,
        "upright_share": float(is_upright.any(axis=1).mean()),
    }
    lengths = np.median(bone_lengths(BODY22, body22_m), axis=0)
    statures, radii = body_height_m(BODY22, lengths), capsule_model(BODY22).radii_of(body22_m)
    some = body22_m[:: max(1, round(rate_hz * _SAMPLE_S))]
    is_high = some[..., _UP].min(axis=-1) > floor + _AIR_M
    couples = [list(both) for both in combinations(range(body22_m.shape[1]), 2)]
    if couples:
        nearest = np.full(some.shape[:2], np.inf)  # of anybody else (frame, person)
        trunk_m, twin_m, depth_m, body_m = [], [], [], []
        for both in couples:
            pair = some[:, both]
            nearest[:, both] = np.minimum(nearest[:, both], closest_joint_distance(pair)[:, None])
            axes = surface_gaps(pair, np.zeros((2, BODY22.num_joints)), BODY22)
            is_trunk = np.isin(axes.bones, _TRUNK)
            trunk_m.append(float(axes.gap_m[:, is_trunk][:, :, is_trunk].min()))
            depth_m.append(float(np.percentile(-surface_gaps(pair, radii[both], BODY22).closest_m, _DEPTH_PERCENT)))
            body_m.append(float(np.abs(np.subtract(*lengths[both]))[1:].max()))
            twin_m.append(_difference(*(pair * (USUAL_HEIGHT_M / statures[both, None, None])).swapaxes(0, 1)))
        is_high &= nearest >= _HELD_M
        of_take |= {"distance_m": float(nearest.min(axis=0).max()), "trunk_m": min(trunk_m), "twin_m": min(twin_m)}
        of_take |= {"penetration_m": max(0.0, *depth_m), "body_difference_m": min(body_m)}
    captures = []
    for person in range(body22_m.shape[1]):
        person_m = body22_m[:, person]
        speed = _norm(person_m[step:] - person_m[:-step]) * (rate_hz / step)
        third = _norm(
            person_m[3 * step :]
            - 3 * person_m[2 * step : -step]
            + 3 * person_m[step : -2 * step]
            - person_m[: -3 * step]
        )
        speed, third = (values if len(values) else np.zeros((1, BODY22.num_joints)) for values in (speed, third))
        jerk = np.percentile(third, _JERK_PERCENT, axis=0) * (rate_hz / step) ** 3
        frame, jumping = np.unravel_index(np.argmax(third), third.shape)
        captures.append(
            PersonCapture(
                stature_m=float(statures[person]),
                speed_m_s=float(speed.max()),
                speed_joint=BODY22.joint_names[int(speed.max(axis=0).argmax())],
                jerk_m_s3=float(jerk.max()),
                jerk_joint=BODY22.joint_names[int(jerk.argmax())],
                jump_m=float(third[frame, jumping]) / 2,
                jump_joint=BODY22.joint_names[jumping],
                jump_s=float((frame + 1.5 * step) / rate_hz),
                start_jump_m=float(third[:step].max()),
                skate_m_s=_skate(person_m[:, _FEET], step) * rate_hz / step,
                sunk_m=float(np.percentile(floor - low[:, person], 95.0)),
                floating_share=float(is_high[:, person].mean()),
                **of_take,
            )
        )
    return captures


def _norm(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _floors(ankles_m: Array, toes_m: Array, *, rate_hz: float, step: int) -> tuple[Array, float]:
    """Return the heights of the toes of flat feet, for each person who has any, and the slope of these floors.

    The slope is NaN if all flat feet are on a line or in one place.

    Args:
        ankles_m: Ankles (frame, person, foot=2, 3), metres.
        toes_m: Toes, likewise.
        rate_hz: Frames per second.
        step: Frames over which speed is taken.
    """
    foot = (ankles_m - toes_m)[:-step]
    is_slow = _norm(toes_m[step:] - toes_m[:-step]) * (rate_hz / step) < _STANDING.contact_speed_m_s
    is_flat = is_slow & (np.abs(foot[..., _UP]) < _FLAT * _norm(foot))
    places = [toes_m[:-step, person][is_flat[:, person]] for person in range(toes_m.shape[1])]
    places = [toes for toes in places if len(toes) > _FLAT_SHARE * len(foot)]
    away = np.concatenate([toes - np.median(toes, axis=0) for toes in places] or [np.zeros((1, 3))])
    spread = away[:, _LEVEL].T @ away[:, _LEVEL] / len(away)
    is_wide = np.linalg.eigvalsh(spread)[0] > _EXTENT_M**2
    slope = np.linalg.solve(spread, away[:, _LEVEL].T @ away[:, _UP] / len(away)) if is_wide else np.array([np.nan])
    return np.array([np.median(toes[:, _UP]) for toes in places]), float(np.linalg.norm(slope))


def _skate(feet_m: Array, step: int) -> float:
    """Return the median displacement, over a step, of the stiller joint that bears weight (frame, joint, 3).

    A foot that is always some centimetres above the other still bears weight.
    """
    height = feet_m[..., _UP]
    lowest = np.minimum(height, height[:, _OTHER_OF_FOOT])
    least = np.percentile(lowest, _FLOOR_PERCENT, axis=0)
    is_low = (height < least + _LOW_M) & (least < least.min() + _AIR_M)
    moved = _norm((feet_m[step:] - feet_m[:-step])[..., _LEVEL])
    stillest = np.where(is_low[step:] & is_low[:-step], moved, np.inf).min(axis=1)
    carries = np.isfinite(stillest)
    return float(np.median(stillest[carries])) if carries.any() else 0.0


def _difference(first: Array, other: Array) -> float:
    """Return the difference of the poses (frame, joint, 3) of two people, turned about y; 95th percentile of frames."""
    first, other = first - first[:, :1], other - other[:, :1]
    a, b = first[..., 0] + 1j * first[..., 2], other[..., 0] + 1j * other[..., 2]
    turn = (a * b.conj()).sum(axis=1, keepdims=True)
    turn /= np.maximum(np.abs(turn), 1e-12)
    squared = np.abs(a - turn * b) ** 2 + (first[..., _UP] - other[..., _UP]) ** 2
    return float(np.percentile(np.sqrt(squared.mean(axis=1)), 95.0))
