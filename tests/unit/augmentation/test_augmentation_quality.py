"""Figures of variants, as a whole and frame by frame."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from pasdedeux.augmentation import Augmenter, Source, UserContact, uniform_variations
from pasdedeux.augmentation.quality import FIGURES, FRAME_LIMITS, FrameQuality, Quality, QualityMeter
from pasdedeux.augmentation.source import points_of
from pasdedeux.figure import limits_of
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from tests.builders.moving_pairs import standing_person, swaying_pair

Array = npt.NDArray[np.float64]

FRAMES = 20


def _measure(
    source: Source,
    variant: Array,
    *,
    plain: Array | None = None,
    scale: tuple[float, float] = (1.0, 1.0),
    contacts: Sequence[UserContact] = (),
    squared_residual: Array | None = None,
) -> tuple[Quality, FrameQuality]:
    """Measure a variant beside plain kinematics, which is the source unless it is given."""
    return QualityMeter(source, contacts).measure(
        points_of(variant),
        reference=points_of(source.positions_m if plain is None else plain),
        bone_scale=np.repeat(np.array(scale)[:, None], 22, axis=1),
        lengths_m=source.lengths_m.reshape(-1),
        squared_residual=np.zeros(len(variant)) if squared_residual is None else squared_residual,
    )


def test_figures_of_a_variant_are_those_of_its_frames_together() -> None:
    (variant,) = Augmenter(Source(swaying_pair(FRAMES), 30.0)).solve(uniform_variations([0.8], ["A"]))
    quality, frames = variant.quality, variant.frames
    assert quality.bone_error_m == frames.bone_error_m.max()
    assert quality.num_contact_pairs == frames.num_contact_pairs.sum() > 0
    summed = (frames.num_contact_pairs * np.nan_to_num(frames.contact_drift_m)).sum()
    assert quality.contact_drift_m == pytest.approx(summed / quality.num_contact_pairs)
    assert quality.laplacian_error_m == pytest.approx(np.sqrt((frames.laplacian_error_m**2).mean()))
    assert quality.floor_penetration_m == frames.floor_penetration_m.max()
    assert quality.penetration_m == np.percentile(frames.penetration_m, 95)
    assert variant.frame_verdicts.shape == (FRAMES,)


def test_the_worst_contact_does_not_vanish_among_those_that_are_kept() -> None:
    """Two hands touch all the time, a hand and a knee in a quarter of it, while the knee moves away by 6 cm."""
    apart = np.repeat(swaying_pair(1, apart_m=3.0), 20, axis=0)
    hands = UserContact(joint_a="left_wrist", joint_b="left_wrist", stop_frame=20)
    meter = QualityMeter(
        Source(apart, 30.0),
        [hands, UserContact(joint_a="right_wrist", joint_b="left_knee", start_frame=3, stop_frame=8)],
    )
    hand, knee = BODY22.indices(["right_wrist", "left_knee"])
    variant = apart.copy()
    variant[3:8, 1, knee] += 0.06 * normalise(apart[3:8, 1, knee] - apart[3:8, 0, hand])
    worst = meter.worst_contact(points_of(variant))
    assert worst is not None
    assert worst[0] == pytest.approx(0.06)
    assert worst[1] == (hand, 22 + knee)
    assert QualityMeter(Source(apart, 30.0)).worst_contact(points_of(apart)) is None


def test_drift_is_that_of_each_kind_of_contact_in_the_frames_in_which_it_is_held() -> None:
    """Hands drift by 3 cm in ten frames, hand and knee by 2 cm in five, backs by 1 cm in two; plain ones by 9 cm."""
    apart = np.repeat(swaying_pair(1, apart_m=3.0), 10, axis=0)
    stated = {"left_wrist": ("left_wrist", 10, 0.03), "left_knee": ("right_wrist", 5, 0.02)}
    stated |= {"spine2": ("spine2", 2, 0.01)}
    variant, plain, contacts = apart.copy(), apart.copy(), []
    for joint_b, (joint_a, frames, drift_m) in stated.items():
        contacts.append(UserContact(joint_a=joint_a, joint_b=joint_b, stop_frame=frames))
        away = normalise(apart[:, 1, BODY22.index(joint_b)] - apart[:, 0, BODY22.index(joint_a)])
        variant[:, 1, BODY22.index(joint_b)] += drift_m * away
        plain[:, 1, BODY22.index(joint_b)] += 0.09 * away
    squared = np.linspace(0.0, 9e-4, 10)
    quality, by_frame = _measure(Source(apart, 30.0), variant, plain=plain, contacts=contacts, squared_residual=squared)
    assert quality.num_contact_pairs == 17
    kinds = quality.contact_drift_extremity_m, quality.contact_drift_mixed_m, quality.contact_drift_body_m
    assert kinds == pytest.approx((0.03, 0.02, 0.01))
    assert (quality.contact_drift_m, quality.contact_drift_fk_m) == pytest.approx((0.42 / 17, 0.09))
    assert quality.contact_drift_p95_m == pytest.approx(0.03)
    np.testing.assert_allclose(by_frame.contact_drift_m, [*[0.02] * 2, *[0.025] * 3, *[0.03] * 5])
    assert quality.laplacian_error_m == pytest.approx(np.sqrt(4.5e-4))
    np.testing.assert_allclose(by_frame.laplacian_error_m[[0, -1]], [0.0, 0.03])


def test_without_a_contact_drift_is_not_known_and_the_verdict_says_so() -> None:
    apart = swaying_pair(FRAMES)
    apart[:, 1] += [3.0, 0.0, 0.0]
    (variant,) = Augmenter(Source(apart, 30.0)).solve(uniform_variations([0.95], ["A"]))
    assert variant.quality.num_contact_pairs == 0
    assert np.isnan([variant.quality.contact_drift_m, variant.quality.contact_drift_fk_m]).all()
    assert variant.verdict.level is Level.WARN
    assert "nothing is in contact" in variant.verdict.reason
    assert np.isnan([variant.verdict.value, variant.verdict.baseline]).all()


def held(*, rows: slice = slice(0), joint: str = "head", person: int = 0, by: npt.ArrayLike = 0.0) -> Array:
    """Return two people who stand still 2 m apart for 20 frames; a joint of one is moved in some frames."""
    pair = np.repeat((standing_person() + np.array([[[0.0, 0.0, 0.0]], [[2.0, 0.0, 0.0]]]))[None], FRAMES, axis=0)
    pair[rows, person, BODY22.index(joint)] += by
    return pair


def bent(angles_rad: npt.ArrayLike) -> Array:
    """Return the same with A's head bent to the side by angles (frame,)."""
    pair, angles = held(), np.broadcast_to(angles_rad, FRAMES)
    way = np.stack([np.sin(angles), np.cos(angles), np.zeros(FRAMES)], axis=-1)
    pair[:, 0, BODY22.index("head")] = pair[:, 0, BODY22.index("neck")] + 0.14 * way
    return pair


def reaching(gaps_m: npt.ArrayLike) -> Array:
    """Return the same with A's left and B's right forearm on one line, and gaps (frame,) between the wrists."""
    pair = held()
    for person, side, sign in ((0, "left", 1.0), (1, "right", -1.0)):
        elbow, wrist = BODY22.indices([f"{side}_elbow", f"{side}_wrist"])
        pair[:, person, elbow] = [1.0 - 0.3 * sign, 1.3, 0.5]
        pair[:, person, wrist] = [1.0, 1.3, 0.5]
    pair[:, 0, BODY22.index("left_wrist"), 0] -= gaps_m
    return pair


def toes(gaps_m: npt.ArrayLike) -> Array:
    """Return the same with gaps (frame,) between A's toes."""
    pair = held()
    pair[:, 0, BODY22.indices(["left_toe", "right_toe"]), 0] = 0.5 * np.multiply.outer([1.0, -1.0], gaps_m).T
    return pair


TWO, LAST_TWO = slice(9, 11), np.arange(FRAMES) >= FRAMES - 2
HAND: dict[str, Any] = {"rows": TWO, "joint": "left_wrist"}
CUBED = np.arange(FRAMES)[:, None, None, None] ** 3 * [1e-5, 0.0, 0.0]


@pytest.mark.parametrize(
    ("column", "source", "variant", "plain", "value"),
    [
        ("stance_excursion_m", held(), held(rows=TWO, joint="left_ankle", by=(0.03, 9e-3, 0.04)), held(), 0.05),
        ("floor_penetration_m", held(), held(rows=TWO, joint="left_toe", by=(0.0, -0.06, 0.0)), held(), 0.06),
        ("floor_penetration_m", held(**HAND, by=(0.0, -1.23, 0.0)), held(**HAND, by=(0.0, -1.25, 0.0)), held(), 0.02),
        ("penetration_m", reaching(0.02), reaching(np.where(LAST_TWO, 0.005, 0.03)), reaching(0.0), 0.015),
        ("self_penetration_m", toes(0.05), toes(np.where(LAST_TWO, 0.01, 0.06)), toes(0.3), 0.04),
        ("self_penetration_m", toes(0.3), toes(np.where(LAST_TWO, 0.01, 0.06)), toes(0.05), 0.04),
        ("spine_bend_rad", bent(0.2), bent(np.where(LAST_TWO, -0.5, 0.1)), held(), 0.3),
        ("jerk_ratio", held() + CUBED, held() - 2.5 * CUBED, held(), 2.5),
        ("jerk_ratio", held(), held() + CUBED, held(), 1.0 + 6e-5),
    ],
)
def test_figures_have_known_values(column: str, source: Array, variant: Array, plain: Array, value: float) -> None:
    quality, frames = _measure(Source(source, 30.0, ground_m=0.02), variant, plain=plain)
    assert getattr(quality, column) == pytest.approx(value, rel=1e-9)
    by_frame = getattr(frames, column)
    np.testing.assert_allclose(by_frame[by_frame > 0.5 * value], value, rtol=1e-9)
    assert (by_frame > 0.5 * value).sum() == (FRAMES if column == "jerk_ratio" else 2)


def test_the_source_itself_passes_in_every_frame() -> None:
    source = Source(swaying_pair(FRAMES), 30.0)
    _, frames = _measure(source, source.positions_m)
    assert not frames.judge(FRAME_LIMITS).any()
    assert frames.jerk_ratio.max() <= 1.0


def test_a_figure_beyond_its_limits_is_a_warning_or_a_failure_and_named() -> None:
    source = Source(swaying_pair(FRAMES), 30.0)
    quality, _ = _measure(source, source.positions_m)
    limits = limits_of(FIGURES)
    assert quality.judge(limits).level is Level.PASS
    for name, (warn, fail) in limits.items():
        for value, level in ((warn, Level.PASS), (0.5 * (warn + fail), Level.WARN), (1.1 * fail, Level.FAIL)):
            found = replace(quality, **{name: value}).judge(limits)
            assert found.level is level
            assert (" is above " in found.reason) == (level is not Level.PASS)


@pytest.mark.parametrize(
    ("figure", "joint", "moved_m"),
    [
        ("jerk_ratio", "head", (0.3, 0.0, 0.0)),
        ("floor_penetration_m", "left_toe", (0.0, -0.2, 0.0)),
        ("stance_excursion_m", "left_ankle", (0.2, 0.0, 0.0)),
        ("contact_drift_m", "left_wrist", (0.0, 1.0, 0.0)),
        ("bone_error_m", "right_elbow", (0.0, 0.1, 0.0)),
    ],
)
def test_a_joint_that_leaps_fails_in_its_frame(figure: str, joint: str, moved_m: tuple[float, float, float]) -> None:
    source = Source(swaying_pair(FRAMES), 30.0)
    pair = np.array(source.positions_m)
    pair[10, 0, BODY22.index(joint)] += moved_m
    _, frames = _measure(source, pair)
    values = getattr(frames, figure)
    assert values[10] > FRAME_LIMITS[figure][1]
    verdicts = frames.judge(FRAME_LIMITS)
    assert verdicts[10] == 2
    assert not verdicts[[*range(7), *range(14, FRAMES)]].any()


def test_a_foot_that_turns_on_its_toe_is_no_fault_of_a_longer_foot_and_one_that_slides_is() -> None:
    pair = swaying_pair(FRAMES)
    angle = np.linspace(0.0, 0.9, FRAMES)
    toe, ankle = BODY22.indices(["left_toe", "left_ankle"])
    behind = np.stack([np.sin(angle), np.zeros(FRAMES), -np.cos(angle)], axis=-1)
    pair[:, 0, toe] = pair[0, 0, toe]
    pair[:, 0, ankle] = pair[0, 0, toe] + [0.0, 0.05, 0.0] + 0.1 * behind
    source = Source(pair, 30.0)
    longer = np.array(source.positions_m)
    longer[:, 0, ankle] += 0.04 * behind
    assert _measure(source, longer)[0].stance_excursion_m > 0.01
    assert _measure(source, longer, scale=(1.4, 1.0))[0].stance_excursion_m < 1e-6
    assert _measure(source, longer, scale=(1.0, 1.4))[0].stance_excursion_m > 0.01, "A's feet have not grown"
    longer[2 * FRAMES // 3 :, 0, toe, 0] += 0.04
    assert _measure(source, longer, scale=(1.4, 1.0))[0].stance_excursion_m > 0.03


def test_a_take_of_one_frame_has_figures() -> None:
    source = Source(swaying_pair(1), 30.0)
    _, frames = _measure(source, source.positions_m)
    assert frames.jerk_ratio.tolist() == [1.0]
    assert frames.stance_excursion_m.tolist() == [0.0]
