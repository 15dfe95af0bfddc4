"""Check captures: good takes pass and each planted fault is named, at any place, heading and rate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.choreography.duets import DUETS, make_duet
from pasdedeux.figure import complete_limits, limits_of
from pasdedeux.kinematics import bone_directions, bone_lengths, place_bones
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.plausibility.capture import JUDGED, check_capture, judge_capture
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.humanoid import t_pose
from pasdedeux.verdict import Level, Verdict

Array = npt.NDArray[np.float64]

LIMITS = limits_of(JUDGED)
TURNED = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
Z_READ_AS_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


FEET = BODY22.indices(["left_ankle", "right_ankle", "left_toe", "right_toe"])
KNEE = BODY22.index("left_knee")


@cache
def duet(name: str, rate_hz: float) -> Array:
    return make_duet(name, rate_hz=rate_hz, duration_s=8.0).positions_m()


def judged(body22_m: Array, rate_hz: float, names: Sequence[str] = ()) -> Verdict:
    return judge_capture(check_capture(body22_m, rate_hz=rate_hz), LIMITS, names).take


def one_changed(change: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda pair: np.stack([change(pair[:, 0]), pair[:, 1]], axis=1)


def foot_jumps(body: Array) -> Array:
    jumped = body.copy()
    jumped[len(body) // 2 :, BODY22.index("left_toe"), 0] += 0.58
    return jumped


def knee_sinks(body: Array) -> Array:
    sunk = body.copy()
    sunk[:, BODY22.index("left_knee"), 1] = -0.3
    return sunk


FAULTS: dict[str, tuple[Callable[[Array], Array], str]] = {
    "a foot jumps": (one_changed(foot_jumps), "A: the left_toe jumps by 0.58 m at"),
    "z up read as y up": (lambda pair: pair @ Z_READ_AS_Y.T, "nobody is upright: up_axis may be wrong"),
    "the same motion twice": (
        lambda pair: np.stack([pair[:, 0], pair[:, 0] + [0.9, 0.0, 0.0]], axis=1),
        "the same motion twice",
    ),
    "one person at two scales": (
        lambda pair: np.stack([pair[:, 0], 0.9 * pair[:, 0] @ TURNED + [0.9, 0.0, 0.0]], axis=1),
        "the same motion twice",
    ),
    "scale 0.01": (lambda pair: 0.01 * pair, "A: is 0.0182 m tall"),
    "another's unit": (one_changed(lambda body: 2.54 * body), "A: is 4.62 m tall"),
    "one floats": (lambda pair: pair + np.array([[[0.0, 0.5, 0.0]], [[2.0, 0.0, 0.0]]]), "A: is in the air for 100%"),
    "a knee under the floor": (one_changed(knee_sinks), "m deep in the floor"),
    "feet slide": (
        one_changed(lambda body: body + np.linspace(0.0, 8.0, len(body))[:, None, None] * [1.0, 0.0, 0.0]),
        "A: the supporting feet slide at 1.0",
    ),
    "noise": (one_changed(lambda body: body + np.random.default_rng(1).normal(0.0, 0.03, body.shape)), "m/s3"),
    "partners far apart": (lambda pair: pair + np.array([[[0.0, 0.0, 0.0]], [[9.0, 0.0, 0.0]]]), "come no nearer than"),
    "through each other": (
        lambda pair: pair - pair[:, :, :1] * [1.0, 0.0, 1.0],
        "the spines of the partners come within",
    ),
}


@pytest.mark.parametrize("name", DUETS)
def test_the_built_in_duets_pass_at_any_rate(name: str) -> None:
    for rate_hz in (30.0, 50.0, 120.0):
        assert judged(duet(name, rate_hz), rate_hz) == Verdict(Level.PASS)


def test_two_of_one_body_are_doubted_though_they_move_each_in_their_own_way() -> None:
    people = duet("waltz", 30.0).swapaxes(0, 1)
    lengths = 1.04 * bone_lengths(BODY22, people[0, 0])
    leader, twin = (place_bones(BODY22, body[:, 0], bone_directions(BODY22, body), lengths) for body in people)
    assert judged(np.stack([leader, people[1]], axis=1), 30.0).level is Level.PASS
    verdict = judged(np.stack([leader, twin], axis=1), 30.0)
    assert verdict.level is Level.WARN
    assert "the partners have the same body" in verdict.reason


def test_how_deep_people_are_in_each_other_is_said() -> None:
    hug = duet("hug", 30.0)
    assert check_capture(hug, rate_hz=30.0)[0].penetration_m < 0.05
    deep = hug.copy()
    deep[:, 1] -= (hug[:, 1, :1] - hug[:, 0, :1]) * [1.0, 0.0, 1.0]
    found = check_capture(deep, rate_hz=30.0)[0]
    assert 0.12 < found.penetration_m < 0.2
    assert f"people are {found.penetration_m:.2f} m inside each other" in judged(deep, 30.0).reason


def test_one_of_three_who_is_far_away_or_another_twice_is_noticed() -> None:
    trio = duet("trio", 30.0)
    for third, reason in (
        (trio[:, 2] + [7.0, 0.0, 0.0], "come no nearer than"),
        (trio[:, 0] + [1.5, 0.0, 0.0], "the same motion twice"),
    ):
        verdict = judged(np.stack([trio[:, 0], trio[:, 1], third], axis=1), 30.0)
        assert verdict.level is Level.FAIL
        assert reason in verdict.reason


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_a_failure_and_named_at_any_rate(fault: str) -> None:
    plant, said = FAULTS[fault]
    for rate_hz in (30.0, 120.0):
        verdict = judged(plant(duet("waltz", rate_hz)), rate_hz)
        assert verdict.level is Level.FAIL
        assert said in verdict.reason


@settings(max_examples=15, deadline=None)
@given(
    fault=st.sampled_from([None, *FAULTS]),
    yaw=st.floats(-np.pi, np.pi),
    shift=st.tuples(st.floats(-50.0, 50.0), st.floats(-2.0, 2.0), st.floats(-50.0, 50.0)),
)
def test_a_verdict_is_blind_to_place_and_heading(fault: str | None, yaw: float, shift: tuple[float, ...]) -> None:
    pair = duet("hug", 30.0)
    pair = FAULTS[fault][0](pair) if fault else pair
    cos, sin = np.cos(yaw), np.sin(yaw)
    turned = pair @ np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]).T + np.array(shift)
    found, moved = (check_capture(people, rate_hz=30.0) for people in (pair, turned))
    levels = [[verdict.level for verdict in judge_capture(people, LIMITS).people] for people in (found, moved)]
    assert levels[0] == levels[1]
    assert [person.complaints(LIMITS) for person in found] == [person.complaints(LIMITS) for person in moved]


def test_a_limit_is_what_the_study_says() -> None:
    pair = FAULTS["a foot jumps"][0](duet("waltz", 30.0))
    wide = complete_limits(JUDGED, {"jump_m": (0.5, 1.0), "speed_m_s": (50.0, 50.0)})
    assert judge_capture(check_capture(pair, rate_hz=30.0), wide).take.level is Level.WARN


STAND = duet("waltz", 30.0)[0, 0] - [0.0, duet("waltz", 30.0)[0, 0, FEET, 1].min(), 0.0]
ABOVE_M = float(np.linalg.norm(STAND[:, None] + [0.0, 2.0, 0.0] - STAND, axis=-1).min())
"""Distance of a person to a copy 2 m above."""
LONGER_M = 0.05 * normalise(STAND[BODY22.index("head")] - STAND[BODY22.index("neck")])
"""Vector of 5 cm along the neck."""
LYING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def still(*, frames: Sequence[int] = (), joint: str = "", by: npt.ArrayLike = 0.0) -> Array:
    """Return a person who stands still for 120 frames; a joint or the whole body is moved in some of them."""
    body = np.repeat(STAND[None], 120, axis=0)
    body[np.ix_(frames, [BODY22.index(joint)] if joint else range(22))] += by
    return body


def moving(path: Array, joint: str = "") -> Array:
    """Return a standing person; a joint or the whole body moves on a path (frame,) along x."""
    body = np.repeat(STAND[None], len(path), axis=0)
    body[:, [BODY22.index(joint)] if joint else slice(None), 0] += path[:, None]
    return body


def stepping(path: Array, *, above_m: float) -> Array:
    """Return a person whose right foot slides along a path (frame,); the left one is still and this much higher."""
    body = np.repeat(STAND[None], len(path), axis=0)
    left, right = (BODY22.indices([f"{side}_ankle", f"{side}_toe"]) for side in ("left", "right"))
    body[:, left, 1] = body[:, right, 1] + above_m
    body[:, right, 0] += path[:, None]
    return body


def lying(frames: int) -> Array:
    body = still()
    body[:frames] = body[:frames] @ LYING.T
    return body


def grown(stature_m: float) -> Array:
    """Return somebody who stands upright, arms to the sides, with the legs of that stature, in 120 frames."""
    body = stature_m * np.array([t_pose(joint) for joint in BODY22.joint_names])
    thigh, shank = (0.245 * stature_m, 0.246 * stature_m)  # Drillis and Contini (1966)
    for side in ("left", "right"):
        hip, knee, ankle, toe = BODY22.indices([f"{side}_hip", f"{side}_knee", f"{side}_ankle", f"{side}_toe"])
        body[[knee, ankle, toe]] = body[hip] - np.multiply.outer([thigh, thigh + shank, thigh + shank], [0.0, 1.0, 0.0])
        body[toe] += [0.0, -0.05, 0.12]
    return np.repeat(body[None], 120, axis=0)


def beside(gap_m: npt.ArrayLike) -> list[Array]:
    """Return two people side by side, a gap (frame,) between a left hand and a right one."""
    left, right = grown(1.8), grown(1.8)
    apart_m = np.ptp(left[0, BODY22.indices(["left_wrist", "right_wrist"]), 0]) + np.asarray(gap_m)
    right[..., 0] += apart_m * np.ones((120, 1))
    return [left, right]


def imitated(by_m: npt.ArrayLike) -> list[Array]:
    """Return a person, and a turned copy of two thirds the size whose left hand is this much higher."""
    taller, smaller = grown(1.7), grown(1.7)
    smaller[:, BODY22.index("left_wrist"), 1] += by_m
    return [taller, smaller @ TURNED / 1.5 + [3.0, 1.0, -2.0]]


RARELY = (np.arange(120) % 12 == 0)[:, None]
"""A quarter of the frames that the check samples, at 30 and at 60 Hz."""


@pytest.mark.parametrize("rate_hz", [30.0, 60.0])
@pytest.mark.parametrize(
    ("column", "take", "value"),
    [
        ("sunk_m", lambda _: [still(frames=range(12), joint="left_knee", by=(0.0, -0.3 - STAND[KNEE, 1], 0.0))], 0.3),
        ("skate_m_s", lambda time_s: [moving(0.9 * time_s)], 0.9),
        ("skate_m_s", lambda time_s: [stepping(0.9 * time_s, above_m=0.08)], 0.0),
        ("skate_m_s", lambda time_s: [stepping(0.9 * time_s, above_m=0.3)], 0.9),
        ("speed_m_s", lambda time_s: [moving(-2.0 * time_s, "left_wrist")], 2.0),
        ("jerk_m_s3", lambda time_s: [moving(100.0 * time_s**3, "left_wrist")], 600.0),
        ("floating_share", lambda _: [still(frames=range(24), by=(0.0, 0.5, 0.0))], 0.2),
        ("floor_spread_m", lambda _: [still(frames=range(60), by=(0.0, 0.3, 0.0))], 0.3),
        ("upright_share", lambda _: [lying(36)], 0.7),
        (
            "distance_m",
            lambda _: [still(), np.add(still(frames=range(60), by=(0.0, 2.0, 0.0)), [0.0, 2.0, 0.0])],
            ABOVE_M,
        ),
        ("body_difference_m", lambda _: [still(), still(frames=range(120), joint="head", by=LONGER_M)], 0.05),
        ("stature_m", lambda _: [grown(1.83)], 1.83),
        ("trunk_m", lambda _: [grown(1.8), grown(1.8) + np.where(RARELY, 0.3, 0.5)[..., None] * [1.0, 0.0, 0.0]], 0.3),
        ("distance_m", lambda _: beside(np.where(RARELY, 0.04, 0.3)), 0.04),
        # A forearm is a fiftieth of the stature thick on each side.
        ("penetration_m", lambda _: beside(np.where(RARELY, 0.01, 0.3)), 2 * 0.02 * 1.8 - 0.01),
        ("penetration_m", lambda _: beside(0.3), 0.0),
        ("twin_m", lambda _: imitated(np.where(RARELY[:, 0], 0.2, 0.1)), 0.2 / np.sqrt(22)),
    ],
)
def test_each_figure_of_a_capture_is_known_of_a_motion_made_for_it(
    column: str, take: Callable[[Array], list[Array]], value: float, rate_hz: float
) -> None:
    people = np.stack(take(np.arange(120) / rate_hz), axis=1)
    assert getattr(check_capture(people, rate_hz=rate_hz)[0], column) == pytest.approx(value, rel=1e-9)


def test_a_jump_is_as_far_as_the_joint_and_when_it_happens() -> None:
    (found,) = check_capture(still(frames=range(60, 120), joint="left_toe", by=(0.0, 0.0, 0.4))[:, None], rate_hz=30.0)
    assert found.jump_joint == "left_toe"
    assert (found.jump_m, found.jump_s) == pytest.approx((0.4, 59.5 / 30))


def test_one_person_and_a_single_frame_have_figures() -> None:
    for frames in (1, 2, 5, 240):
        (alone,) = check_capture(duet("waltz", 30.0)[:frames, :1], rate_hz=30.0)
        assert np.isnan([alone.distance_m, alone.trunk_m, alone.penetration_m, alone.twin_m]).all()
        assert not alone.complaints(LIMITS)


@pytest.mark.parametrize(
    ("names", "level"),
    [
        (("60_01.bvh", "61_01.bvh"), Level.PASS),
        (("High_five_S1.bvh", "High_five_S2.bvh"), Level.PASS),
        (("anna.bvh", "bert_take_3.bvh"), Level.PASS),
        (("take_3.bvh", "take_3.bvh"), Level.PASS),
        (("60_01.bvh", "61_03.bvh"), Level.WARN),
        (("push_up001_S1.bvh", "stack_push_up002_S2.bvh"), Level.WARN),
        (("60_01.amc", "60_01.bvh"), Level.WARN),
    ],
)
def test_names_of_two_takes_are_a_warning(names: tuple[str, str], level: Level) -> None:
    assert judged(duet("waltz", 30.0), 30.0, names).level is level
