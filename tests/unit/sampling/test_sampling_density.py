"""Parameters, prior, density and proposals of a pair."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.synthetic import random_annotations, random_bank, random_pairs, standing_pair
from pasdedeux.cameras.view_density import draw_views
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import multiply, normalise, rotate, rotmat_from_unitquat, unitquat_from_rotvec
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.annotations import AnnotatedPairs, ViewBank, build_bank
from pasdedeux.sampling.chain import ChainState
from pasdedeux.sampling.densities.density import Evaluation, PairDensity, PriorOnly, TargetSettings
from pasdedeux.sampling.densities.interaction import InteractionLikelihood
from pasdedeux.sampling.parameters import (
    LENGTH_INDICES,
    MIRRORED_LENGTH,
    NUM_BLOCKS,
    NUM_PARAMETERS,
    POSITION_INDICES,
    ROTATION_INDICES,
    PairChart,
    gauge_fix,
)
from pasdedeux.sampling.prior import PhysicalPrior, PriorSettings
from pasdedeux.sampling.proposals.blocks import GaussianBlocks, StepSizes
from pasdedeux.sampling.seeds import choose_seeds, seed_quality
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import block_indices

SEED = gauge_fix(standing_pair())
LIMITS = JointLimits.published()
CHART = PairChart(SEED)
PRIOR = PhysicalPrior(CHART, LIMITS)


def random_parameters(rng: np.random.Generator, *, scale: float = 0.2) -> np.ndarray:
    parameters = CHART.seed_parameters()
    noise = scale * rng.normal(size=NUM_PARAMETERS)
    noise[LENGTH_INDICES] = 0.02 * rng.uniform(-1.0, 1.0, size=LENGTH_INDICES.shape)
    noise[LENGTH_INDICES] = 0.5 * (noise[LENGTH_INDICES] + noise[MIRRORED_LENGTH])
    return parameters + noise


def moved(rng: np.random.Generator, parameters: np.ndarray) -> np.ndarray:
    """The same pair after a random rigid motion, as parameters."""
    quaternion = normalise(rng.normal(size=4))
    shift = rng.normal(size=3)
    result = parameters.copy()
    for person in range(2):
        turned = multiply(quaternion, unitquat_from_rotvec(parameters[ROTATION_INDICES[person]]))
        angle = 2.0 * np.arctan2(np.linalg.norm(turned[:3]), turned[3])
        result[ROTATION_INDICES[person]] = turned[:3] / max(np.linalg.norm(turned[:3]), 1e-12) * angle
        result[POSITION_INDICES[person]] = (
            rotmat_from_unitquat(quaternion) @ parameters[POSITION_INDICES[person]] + shift
        )
    return result


@pytest.fixture(scope="module")
def annotated() -> tuple[AnnotatedPairs, ViewBank]:
    rng = np.random.default_rng(1)
    annotations = random_annotations(rng, random_pairs(rng, 200, spread_rad=0.15), 600)
    return annotations, random_bank(rng, annotations, 8, num_candidates=80)


def density_of(annotated: tuple[AnnotatedPairs, ViewBank], **settings: float) -> PairDensity:
    return PairDensity(CHART, PRIOR, InteractionLikelihood(*annotated), TargetSettings(**settings))


def test_blocks_partition_the_parameters() -> None:
    indices = np.concatenate([block_indices(block) for block in range(NUM_BLOCKS)])
    assert sorted(indices) == list(range(NUM_PARAMETERS))


def plain_positions(chart: PairChart, parameters: np.ndarray) -> np.ndarray:
    """Return what `PairChart.positions` gives, joint by joint."""
    placed = np.empty((len(parameters), 2, 17, 3))
    for person in range(2):
        part = parameters[:, 54 * person : 54 * (person + 1)]
        frames = {0: unitquat_from_rotvec(part[:, :3])}
        placed[:, person, 0] = part[:, 3:6]
        for joint in PAIR17.order[1:]:
            parent, start = PAIR17.parents[joint], 3 + 3 * joint
            turn = np.einsum("nk,kx->nx", part[:, start : start + 2], chart.axes[person, joint])
            frames[joint] = multiply(frames[parent], unitquat_from_rotvec(turn))
            bone = rotate(frames[joint], np.broadcast_to(chart.directions[person, joint], turn.shape))
            length = chart.lengths_m[person, joint] * (1.0 + part[:, start + 2])
            placed[:, person, joint] = placed[:, person, parent] + length[:, None] * bone
    return placed


def test_compiled_positions_agree_with_the_plain_ones() -> None:
    rng = np.random.default_rng(2)
    parameters = np.stack([random_parameters(rng, scale=1.0) for _ in range(20)])
    np.testing.assert_allclose(CHART.positions(parameters), plain_positions(CHART, parameters), atol=1e-12)


def test_bones_have_the_lengths_their_parameters_say_and_a_joint_carries_what_hangs_on_it() -> None:
    rng = np.random.default_rng(3)
    parameters = random_parameters(rng)
    lengths = bone_lengths(PAIR17, CHART.positions(parameters))[:, 1:]
    np.testing.assert_allclose(lengths, CHART.lengths_m[:, 1:] * (1.0 + parameters[LENGTH_INDICES]), rtol=1e-12)
    elbow, wrist = PAIR17.index("left_elbow"), PAIR17.index("left_wrist")
    bent = CHART.seed_parameters()
    bent[block_indices(elbow)[0]] = 0.5
    change = np.linalg.norm(CHART.positions(bent) - SEED, axis=-1)
    assert change[0, elbow] > 0.05
    assert change[0, wrist] > 0.05
    still = [joint for joint in range(17) if joint not in (elbow, wrist)]
    np.testing.assert_allclose(change[0, still], 0.0, atol=1e-12)
    np.testing.assert_allclose(change[1], 0.0, atol=1e-12)


def test_gauge_puts_the_centroid_at_the_origin_and_the_roots_along_x() -> None:
    rng = np.random.default_rng(4)
    pair = random_pairs(rng, 1)[0] @ rotmat_from_unitquat(normalise(rng.normal(size=4))).T + 3.0
    fixed = gauge_fix(pair)
    np.testing.assert_allclose(fixed.reshape(-1, 3).mean(axis=0), 0.0, atol=1e-12)
    line = fixed[1, 0] - fixed[0, 0]
    assert line[2] == pytest.approx(0.0, abs=1e-12)
    assert line[0] > 0.0
    np.testing.assert_allclose(gauge_fix(fixed), fixed, atol=1e-12)


def test_gauge_of_parameters_forgets_every_rigid_motion() -> None:
    rng = np.random.default_rng(5)
    parameters = random_parameters(rng)
    expected = CHART.gauge_fixed(parameters)
    fixed = CHART.gauge_fixed(moved(rng, parameters))
    np.testing.assert_allclose(CHART.positions(fixed), CHART.positions(expected), atol=1e-9)
    np.testing.assert_allclose(CHART.gauge_fixed(expected), expected, atol=1e-9)


def test_prior_of_a_standing_pair_is_one_and_falls_with_penetration_and_bad_angles() -> None:
    seed = CHART.seed_parameters()
    assert PRIOR.terms(seed, SEED).log_prior == pytest.approx(0.0, abs=1e-9)
    pushed = seed.copy()
    pushed[POSITION_INDICES[1, 0]] -= 0.45
    terms = PRIOR.terms(pushed, CHART.positions(pushed))
    assert terms.penetration_m > 0.05
    squared_m2 = terms.limit_distance_m**2 + 10.0 * terms.penetration_m**2
    assert terms.log_prior == pytest.approx(-squared_m2 / (2 * 0.05**2), rel=1e-12)
    bent = seed.copy()
    bent[block_indices(PAIR17.index("left_ankle"))[:2]] = 2.0
    invalid = PRIOR.terms(bent, CHART.positions(bent)).num_invalid
    assert invalid > 0
    assert PRIOR.terms(bent, CHART.positions(bent)).log_prior < -1.0
    for allowed in (invalid, invalid - 1):
        strict = PhysicalPrior(CHART, LIMITS, PriorSettings(max_invalid_angles=allowed))
        assert np.isfinite(strict.terms(bent, CHART.positions(bent)).log_prior) == (allowed == invalid)


def test_prior_is_the_plain_form_of_the_equation() -> None:
    rng = np.random.default_rng(12)
    prior = PhysicalPrior(CHART, LIMITS, PriorSettings(max_invalid_angles=58))
    for _ in range(30):
        parameters = CHART.seed_parameters()
        bones = [block_indices(block)[:2] for block in range(NUM_BLOCKS) if block % 17]
        parameters[np.concatenate(bones)] += 0.3 * rng.normal(size=2 * len(bones))
        pair = CHART.positions(parameters)
        terms, plain = prior.terms(parameters, pair), LIMITS.nearest_valid(pair)
        squared = plain.squared_distance_m2.sum()
        assert terms.num_invalid == plain.num_invalid.sum()
        assert terms.limit_distance_m == pytest.approx(np.sqrt(squared), abs=1e-6)
        expected = -(squared + 10.0 * terms.penetration_m**2) / (2 * 0.05**2)
        assert terms.log_prior == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_prior_is_zero_for_stretched_or_untied_bones() -> None:
    knees = LENGTH_INDICES[0, [PAIR17.index("left_knee") - 1, PAIR17.index("right_knee") - 1]]
    stretched, untied = (CHART.seed_parameters() for _ in range(2))
    stretched[knees] = 0.051
    untied[knees[0]] = 0.01
    for parameters in (stretched, untied):
        assert PRIOR.terms(parameters, CHART.positions(parameters)).log_prior == -np.inf
    stretched[knees] = 0.049
    assert PRIOR.terms(stretched, CHART.positions(stretched)).log_prior > -np.inf


def test_people_too_far_apart_and_turned_over_bones_have_density_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pasdedeux.sampling.densities.density.MAX_APART_M", 1.5)
    density = PairDensity(CHART, PRIOR, PriorOnly())
    assert (density.log_floor, density.log_ceiling) == (-np.inf, np.inf), "as studies that set nothing"
    near, far, turned = (CHART.seed_parameters() for _ in range(3))
    near[POSITION_INDICES[1]] = near[POSITION_INDICES[0]] + [1.49, 0.0, 0.0]
    far[POSITION_INDICES[1]] = far[POSITION_INDICES[0]] + [1.51, 0.0, 0.0]
    turned[block_indices(PAIR17.index("head"))[0]] = 3.2
    assert np.isfinite(density(near).log_density)
    assert density(far).log_density == density(turned).log_density == -np.inf
    wide = PairChart(CHART.positions(far))
    wider = PairDensity(wide, PhysicalPrior(wide, LIMITS), PriorOnly())
    assert np.isfinite(wider(wide.seed_parameters()).log_density)


def test_density_ignores_rigid_motion_of_the_pair(annotated: tuple[AnnotatedPairs, ViewBank]) -> None:
    rng = np.random.default_rng(11)
    density = density_of(annotated)
    compared = 0
    for _ in range(20):
        parameters = random_parameters(rng, scale=0.03)
        value = density(parameters).log_density
        assert density(moved(rng, parameters)).log_density == pytest.approx(value, rel=1e-8)
        compared += np.isfinite(value)
    assert compared >= 10


def test_density_is_cut_below_and_flat_above_the_seed(annotated: tuple[AnnotatedPairs, ViewBank]) -> None:
    rng = np.random.default_rng(12)
    free, cut = density_of(annotated), density_of(annotated, truncation=10.0)
    assert cut.log_ceiling - cut.log_floor == pytest.approx(2 * np.log(10.0))
    seen = set()
    for _ in range(200):
        parameters = random_parameters(rng, scale=0.005)
        value, got = free(parameters).log_density, cut(parameters).log_density
        if value < cut.log_floor:
            assert got == -np.inf
            seen.add("below")
        elif value > cut.log_ceiling:
            assert got == cut.log_ceiling
            seen.add("above")
        else:
            assert got == pytest.approx(value, rel=1e-12)
            seen.add("between")
    assert "between" in seen
    assert "below" in seen


def test_a_seed_without_bones_or_with_nan_is_refused() -> None:
    folded = SEED.copy()
    folded[1, PAIR17.index("left_wrist")] = folded[1, PAIR17.index("left_elbow")]
    with pytest.raises(InputError, match="'left_wrist' of person B has length zero"):
        PairChart(folded)
    folded[0, 0, 0] = np.nan
    with pytest.raises(InputError, match="not finite"):
        PairChart(folded)


def test_proposals_keep_ties_and_move_few_blocks() -> None:
    rng = np.random.default_rng(13)
    propose = GaussianBlocks(StepSizes(max_blocks=3))
    parameters = random_parameters(rng)
    for _ in range(200):
        proposed = propose.propose(rng, ChainState(parameters, Evaluation(0.0))).parameters
        np.testing.assert_allclose(proposed[LENGTH_INDICES], proposed[MIRRORED_LENGTH], atol=1e-12)
        changed = [
            block
            for block in range(NUM_BLOCKS)
            if not np.array_equal(proposed[block_indices(block)[:2]], parameters[block_indices(block)[:2]])
        ]
        assert 1 <= len(changed) <= 3


def test_seeds_take_turns_over_the_takes_and_lie_apart() -> None:
    pairs = random_pairs(np.random.default_rng(18), 90, spread_rad=0.1)
    take_index = np.repeat([0, 1, 2], 30)
    quality = seed_quality(pairs, LIMITS)
    chosen = choose_seeds(pairs, take_index, quality, 6)
    assert sorted(take_index[chosen]) == [0, 0, 1, 1, 2, 2]
    assert len(set(chosen)) == 6
    assert quality.is_possible[chosen].all()
    np.testing.assert_array_equal(choose_seeds(pairs, take_index, quality, 3), chosen[:3])
    with pytest.raises(InputError, match="200 seeds were asked for"):
        choose_seeds(pairs, take_index, quality, 200)


def test_swapping_the_two_people_everywhere_changes_nothing() -> None:
    """People change places in the pair, the annotations and the frame of views: i and k turn round (lift eq. 3)."""
    rng = np.random.default_rng(19)
    pairs = random_annotations(rng, random_pairs(rng, 60, spread_rad=0.1), 60)
    swap_view = np.array([-1.0, 1.0, -1.0])
    swapped = AnnotatedPairs(pairs.points_m[:, ::-1].copy(), pairs.directions * swap_view, pairs.annotation_index)
    views = draw_views(rng, pairs.directions, np.ones(60), 5)
    likelihood = InteractionLikelihood(pairs, build_bank(views, pairs))
    swapped_likelihood = InteractionLikelihood(swapped, build_bank(views * swap_view, swapped))
    for pair in random_pairs(rng, 20, spread_rad=0.1):
        assert swapped_likelihood.log_likelihood(pair[::-1]) == pytest.approx(likelihood.log_likelihood(pair), rel=1e-9)
        # A pair with its people exchanged is a different pair.
        assert likelihood.log_likelihood(pair[::-1]) != pytest.approx(likelihood.log_likelihood(pair), rel=1e-3)
    swapped_chart = PairChart(SEED[::-1].copy())
    swapped_prior = PhysicalPrior(swapped_chart, LIMITS)
    for _ in range(20):
        parameters = random_parameters(rng, scale=0.1)
        flipped = np.roll(parameters, NUM_PARAMETERS // 2)
        terms = PRIOR.terms(parameters, CHART.positions(parameters))
        swapped_terms = swapped_prior.terms(flipped, swapped_chart.positions(flipped))
        np.testing.assert_allclose(swapped_chart.positions(flipped), CHART.positions(parameters)[::-1], atol=1e-12)
        assert swapped_terms.log_prior == pytest.approx(terms.log_prior, rel=1e-9)
        assert swapped_terms.penetration_m == pytest.approx(terms.penetration_m, rel=1e-9, abs=1e-12)
