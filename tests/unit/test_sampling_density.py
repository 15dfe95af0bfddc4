"""Parameters, prior, likelihood, density and proposals of a pair."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.benchmarks.synthetic import random_annotations, random_pairs, standing_pair
from pasdedeux.cameras import pair_frame, project_pair
from pasdedeux.cameras.view_density import ViewDensity
from pasdedeux.errors import InputError
from pasdedeux.interaction import interaction_dissimilarity
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotations import multiply, normalise, rotmat_from_unitquat, unitquat_from_rotvec
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.annotations import AnnotatedPairs, ViewBank, build_bank, gather_pairs, shows_enough
from pasdedeux.sampling.density import PairDensity, Pooling
from pasdedeux.sampling.image_kernels import pair_axes
from pasdedeux.sampling.likelihood import InteractionLikelihood, plain_log_likelihood
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
from pasdedeux.sampling.proposals import GaussianBlocks, StepSettings
from pasdedeux.sampling.seeds import choose_seeds, seed_quality
from pasdedeux.skeletons import PAIR17
from tests.builders.poses import block_indices

SEED = gauge_fix(standing_pair())
LIMITS = JointLimits.published()


def random_parameters(rng: np.random.Generator, *, scale: float = 0.2) -> np.ndarray:
    parameters = PairChart(SEED).seed_parameters()
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
    pairs = random_pairs(rng, 200, spread_rad=0.15)
    annotations = random_annotations(rng, pairs, 600)
    views = ViewDensity(annotations.directions, np.ones(600), 0.5).sample(rng, 8)
    return annotations, build_bank(views, annotations, num_candidates=80)


def density_of(annotated: tuple[AnnotatedPairs, ViewBank], **options: float) -> PairDensity:
    chart = PairChart(SEED)
    return PairDensity(chart, PhysicalPrior(chart, LIMITS), InteractionLikelihood(*annotated), **options)


def test_seed_parameters_give_the_seed() -> None:
    chart = PairChart(SEED)
    assert chart.seed_parameters().shape == (108,)
    np.testing.assert_allclose(chart.positions(chart.seed_parameters()), SEED, atol=1e-14)


def test_blocks_cut_the_parameters_into_all_of_them() -> None:
    indices = np.concatenate([block_indices(block) for block in range(NUM_BLOCKS)])
    assert sorted(indices) == list(range(NUM_PARAMETERS))


def test_compiled_positions_agree_with_the_plain_ones() -> None:
    rng = np.random.default_rng(2)
    chart = PairChart(SEED)
    parameters = np.stack([random_parameters(rng, scale=1.0) for _ in range(20)])
    fast = np.stack([chart.positions_fast(one) for one in parameters])
    np.testing.assert_allclose(fast, chart.positions(parameters), atol=1e-12)


def test_bones_have_the_lengths_their_parameters_say_and_a_joint_carries_what_hangs_on_it() -> None:
    rng = np.random.default_rng(3)
    chart = PairChart(SEED)
    parameters = random_parameters(rng)
    lengths = bone_lengths(PAIR17, chart.positions(parameters))[:, 1:]
    np.testing.assert_allclose(lengths, chart.lengths_m[:, 1:] * (1.0 + parameters[LENGTH_INDICES]), rtol=1e-12)
    elbow, wrist = PAIR17.index("left_elbow"), PAIR17.index("left_wrist")
    bent = chart.seed_parameters()
    bent[block_indices(elbow)[0]] = 0.5
    change = np.linalg.norm(chart.positions(bent) - SEED, axis=-1)
    assert change[0, elbow] > 0.05
    assert change[0, wrist] > 0.05
    others = [joint for joint in range(17) if joint not in (elbow, wrist)]
    np.testing.assert_allclose(change[0, others], 0.0, atol=1e-12)
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
    chart = PairChart(SEED)
    parameters = random_parameters(rng)
    expected = chart.gauge_fixed(parameters)
    np.testing.assert_allclose(
        chart.positions(chart.gauge_fixed(moved(rng, parameters))), chart.positions(expected), atol=1e-9
    )
    np.testing.assert_allclose(chart.gauge_fixed(expected), expected, atol=1e-9)


def test_compiled_frame_agrees_with_the_cameras_own_in_all_its_cases() -> None:
    rng = np.random.default_rng(6)
    pairs = list(random_pairs(rng, 20))
    above = standing_pair()
    above[1] = above[0] + [0.0, 1.0, 0.0]
    nearly = standing_pair()
    nearly[1] = nearly[0] + [0.05, -1.0, 0.02]
    together = standing_pair()
    together[1] = together[0]
    head_down = standing_pair()
    head_down[1] = head_down[1] * [1.0, -1.0, 1.0]
    for pair in (*pairs, above, nearly, together, head_down):
        axes = np.empty((3, 3))
        pair_axes(pair.reshape(-1, 3), axes)
        np.testing.assert_allclose(axes, pair_frame(pair).axes, atol=1e-9)


def test_prior_of_a_standing_pair_is_one_and_falls_with_penetration_and_bad_angles() -> None:
    chart = PairChart(SEED)
    prior = PhysicalPrior(chart, LIMITS)
    seed = chart.seed_parameters()
    assert prior.terms(seed, SEED).log_prior == pytest.approx(0.0, abs=1e-9)
    pushed = seed.copy()
    pushed[POSITION_INDICES[1, 0]] -= 0.45
    terms = prior.terms(pushed, chart.positions(pushed))
    assert terms.penetration_m > 0.05
    assert terms.log_prior == pytest.approx(
        -(terms.limit_distance_m**2 + 10.0 * terms.penetration_m**2) / (2 * 0.05**2), rel=1e-12
    )
    bent = seed.copy()
    bent[block_indices(PAIR17.index("left_ankle"))[:2]] = 2.0
    assert prior.terms(bent, chart.positions(bent)).num_invalid > 0
    assert prior.terms(bent, chart.positions(bent)).log_prior < -1.0


def test_prior_is_the_plain_form_of_the_equation() -> None:
    chart = PairChart(SEED)
    rng = np.random.default_rng(12)
    prior = PhysicalPrior(chart, LIMITS, PriorSettings(max_invalid_angles=58))
    for _ in range(30):
        parameters = chart.seed_parameters()
        bones = [block_indices(block)[:2] for block in range(NUM_BLOCKS) if block % 17]
        parameters[np.concatenate(bones)] += 0.3 * rng.normal(size=2 * len(bones))
        pair = chart.positions(parameters)
        terms, plain = prior.terms(parameters, pair), LIMITS.nearest_valid(pair)
        squared = plain.squared_distance_m2.sum()
        assert terms.num_invalid == plain.num_invalid.sum()
        assert terms.limit_distance_m == pytest.approx(np.sqrt(squared), abs=1e-6)
        expected = -(squared + 10.0 * terms.penetration_m**2) / (2 * 0.05**2)
        assert terms.log_prior == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_prior_is_zero_for_stretched_or_untied_bones() -> None:
    chart = PairChart(SEED)
    prior = PhysicalPrior(chart, LIMITS)
    knees = LENGTH_INDICES[0, [PAIR17.index("left_knee") - 1, PAIR17.index("right_knee") - 1]]
    stretched, untied = (chart.seed_parameters() for _ in range(2))
    stretched[knees] = 0.051
    untied[knees[0]] = 0.01
    for parameters in (stretched, untied):
        assert prior.terms(parameters, chart.positions(parameters)).log_prior == -np.inf
    stretched[knees] = 0.049
    assert prior.terms(stretched, chart.positions(stretched)).log_prior > -np.inf


def test_people_too_far_apart_and_turned_over_bones_have_density_zero() -> None:
    chart = PairChart(SEED)
    density = PairDensity(chart, PhysicalPrior(chart, LIMITS), None, max_apart_m=1.5)
    near, far, turned = (chart.seed_parameters() for _ in range(3))
    near[POSITION_INDICES[1]] = near[POSITION_INDICES[0]] + [1.49, 0.0, 0.0]
    far[POSITION_INDICES[1]] = far[POSITION_INDICES[0]] + [1.51, 0.0, 0.0]
    turned[block_indices(PAIR17.index("head"))[0]] = 3.2
    assert np.isfinite(density(near).log_density)
    assert density(far).log_density == density(turned).log_density == -np.inf
    wide = PairChart(chart.positions(far))
    assert np.isfinite(
        PairDensity(wide, PhysicalPrior(wide, LIMITS), None, max_apart_m=1.5)(wide.seed_parameters()).log_density
    )


def test_compiled_likelihood_agrees_with_the_definition(annotated: tuple[AnnotatedPairs, ViewBank]) -> None:
    pairs, bank = annotated
    exact = InteractionLikelihood(pairs, bank, is_exact=True)
    for pair in random_pairs(np.random.default_rng(7), 12, spread_rad=0.15):
        plain = plain_log_likelihood(pair, pairs, bank)
        match = exact.match(pair)
        assert match.log_likelihood == pytest.approx(plain.log_likelihood, rel=1e-9)
        mattered = np.isfinite(match.dissimilarity_m)
        np.testing.assert_allclose(match.dissimilarity_m[mattered], plain.dissimilarity_m[mattered], rtol=1e-9)
        np.testing.assert_array_equal(match.entry[mattered], plain.entry[mattered])


def test_estimates_leave_the_same_best_as_comparing_all() -> None:
    rng = np.random.default_rng(8)
    pairs = random_annotations(rng, random_pairs(rng, 500, spread_rad=0.2), 1500)
    views = ViewDensity(pairs.directions, np.ones(1500), 0.5).sample(rng, 6)
    bank = build_bank(views, pairs, num_candidates=400, view_bandwidth_rad=1.2)
    assert bank.counts.max() > 300
    fast, exact = InteractionLikelihood(pairs, bank), InteractionLikelihood(pairs, bank, is_exact=True)
    # An estimate trusted too far loses the best: the comparison can fail.
    careless = InteractionLikelihood(pairs, bank, min_ratio=1.0, min_own_ratio=1.0)
    samples = random_pairs(rng, 150, spread_rad=0.2)
    expected = np.array([exact.log_likelihood(pair) for pair in samples])
    assert np.array([fast.log_likelihood(pair) for pair in samples]) == pytest.approx(expected, rel=1e-12)
    assert np.array([careless.log_likelihood(pair) for pair in samples]) != pytest.approx(expected, rel=1e-12)


def with_hidden(rng: np.random.Generator, pairs: AnnotatedPairs, share: float) -> AnnotatedPairs:
    """Return the annotations that still show enough with a share of all joints hidden."""
    points = np.where(rng.random((*pairs.points_m.shape[:3], 1)) < share, np.nan, pairs.points_m)
    enough = shows_enough(points)
    return AnnotatedPairs(points[enough], pairs.directions[enough], pairs.annotation_index[enough])


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_a_likelihood_that_every_view_has_a_say_in_is_its_definition(share: float) -> None:
    rng = np.random.default_rng(23)
    pairs = random_annotations(rng, random_pairs(rng, 300, spread_rad=0.2), 900)
    pairs = with_hidden(rng, pairs, share) if share else pairs
    views = ViewDensity(pairs.directions, np.ones(len(pairs.directions)), 0.5).sample(rng, 6)
    bank = build_bank(views, pairs, num_candidates=300, view_bandwidth_rad=1.2)
    every = InteractionLikelihood(pairs, bank, sigma_l=0.03, pooling=Pooling.EVERY_VIEW)
    best_alone = InteractionLikelihood(pairs, bank, sigma_l=0.03)
    for pair in random_pairs(rng, 8, spread_rad=0.2):
        plain = plain_log_likelihood(pair, pairs, bank, sigma_l=0.03, pooling=Pooling.EVERY_VIEW)
        assert plain.log_likelihood == pytest.approx(-plain.dissimilarity_m.mean() / (2 * 0.03**2), rel=1e-12)
        value = every.log_likelihood(pair)
        assert value == pytest.approx(plain.log_likelihood, rel=1e-9)
        np.testing.assert_array_equal(every.nearest(pair), plain.entry)
        # Jensen: the mean of logarithms is at most the logarithm of the mean.
        assert value <= best_alone.log_likelihood(pair)
        for level in (value - 1e-9 * abs(value), value + 1e-9 * abs(value), 0.9 * value, 1.1 * value):
            found = every.log_likelihood(pair, at_least=level)
            assert found == (value if value >= level else -np.inf)
            np.testing.assert_array_equal(every.nearest(pair), plain.entry)
        # What was found of this pair is not taken for that of one asked for between, nor of one in the same memory.
        every.nearest(1.1 * pair)
        np.testing.assert_array_equal(every.nearest(pair), plain.entry)
        moving = 1.5 * pair
        every.log_likelihood(moving)
        moving[:] = pair
        np.testing.assert_array_equal(every.nearest(moving), plain.entry)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.35])
def test_a_likelihood_with_hidden_joints_is_the_definition_and_looks_at_all_that_matter(share: float) -> None:
    rng = np.random.default_rng(17)
    pairs = with_hidden(rng, random_annotations(rng, random_pairs(rng, 400, spread_rad=0.2), 1200), share)
    views = ViewDensity(pairs.directions, np.ones(len(pairs.directions)), 0.5).sample(rng, 6)
    bank = build_bank(views, pairs, num_candidates=300, view_bandwidth_rad=1.2)
    fast, exact = InteractionLikelihood(pairs, bank), InteractionLikelihood(pairs, bank, is_exact=True)
    assert not pairs.is_seen.all()
    for pair in random_pairs(rng, 40, spread_rad=0.2):
        assert fast.log_likelihood(pair) == exact.log_likelihood(pair)
    for pair in random_pairs(rng, 6, spread_rad=0.2):
        plain = plain_log_likelihood(pair, pairs, bank)
        np.testing.assert_array_equal(fast.nearest(pair), plain.entry)
        assert exact.log_likelihood(pair) == pytest.approx(plain.log_likelihood, rel=1e-9)
        # The definition itself: the least d_I of one pair and one annotation at a time.
        image = project_pair(pair, bank.directions[0]).reshape(34, 2)
        own = bank.candidates[0, : bank.counts[0]]
        least = min(interaction_dissimilarity(image, points) for points in pairs.points_m[own].reshape(len(own), 34, 2))
        assert plain.dissimilarity_m[0] == pytest.approx(least, rel=1e-9)


def test_an_annotation_with_hidden_joints_still_fits_its_own_pair() -> None:
    rng = np.random.default_rng(18)
    pair = random_pairs(rng, 1)[0]
    view = normalise(np.array([[0.3, 0.1, 1.0]]))
    whole = AnnotatedPairs(project_pair(pair, view), view, np.zeros(1, dtype=np.int64))
    part = with_hidden(np.random.default_rng(4), whole, 0.2)
    assert InteractionLikelihood(part, build_bank(view, part)).log_likelihood(pair) == pytest.approx(0.0, abs=1e-6)
    # What is hidden may be anywhere: only what is seen counts.
    waving = pair.copy()
    waving[~part.is_seen[0]] += 0.3
    waving[:, [0, 3]] = pair[:, [0, 3]]
    moved = ~part.is_seen[0].copy()
    moved[:, [0, 3]] = False
    assert moved.any()
    assert InteractionLikelihood(part, build_bank(view, part)).log_likelihood(waving) > -300.0
    assert InteractionLikelihood(whole, build_bank(view, whole)).log_likelihood(waving) < -300.0


def test_views_left_out_add_less_than_rounding_to_the_likelihood() -> None:
    rng = np.random.default_rng(14)
    pairs = random_annotations(rng, random_pairs(rng, 60, spread_rad=0.1), 150)
    bank = build_bank(pairs.directions[:12], pairs, num_candidates=50, view_bandwidth_rad=1.0)
    left_out = 0
    for sigma_l in (0.01, 0.05):
        likelihood = InteractionLikelihood(pairs, bank, sigma_l=sigma_l)
        for pair in random_pairs(rng, 12, spread_rad=0.1):
            plain = plain_log_likelihood(pair, pairs, bank, sigma_l=sigma_l)
            match = likelihood.match(pair)
            left_out += np.isinf(match.dissimilarity_m).sum()
            # exp of the logs agrees to 1e-9 relative; d_I itself is only known to that once divided by 2 sigma_l^2.
            assert match.log_likelihood == pytest.approx(plain.log_likelihood, rel=1e-11, abs=1e-10)
    assert left_out > 100


def test_every_view_finds_its_nearest_annotation_also_where_it_cannot_matter(
    annotated: tuple[AnnotatedPairs, ViewBank],
) -> None:
    pairs, bank = annotated
    likelihood = InteractionLikelihood(pairs, bank)
    for pair in random_pairs(np.random.default_rng(9), 12, spread_rad=0.15):
        plain = plain_log_likelihood(pair, pairs, bank)
        np.testing.assert_array_equal(likelihood.nearest(pair), plain.entry)


def test_likelihood_of_an_annotated_pair_under_its_own_view_is_one() -> None:
    pair = random_pairs(np.random.default_rng(9), 1)[0]
    view = normalise(np.array([[0.3, 0.1, 1.0]]))
    pairs = AnnotatedPairs(project_pair(pair, view), view, np.zeros(1, dtype=np.int64))
    bank = build_bank(view, pairs)
    assert InteractionLikelihood(pairs, bank).log_likelihood(pair) == pytest.approx(0.0, abs=1e-6)
    mirrored = AnnotatedPairs(pairs.points_m * [-1.0, 1.0], view, np.zeros(1, dtype=np.int64))
    assert InteractionLikelihood(mirrored, bank).log_likelihood(pair) < -100.0


def test_a_floor_never_changes_a_value_above_it(annotated: tuple[AnnotatedPairs, ViewBank]) -> None:
    likelihood = InteractionLikelihood(*annotated)
    for pair in random_pairs(np.random.default_rng(10), 30, spread_rad=0.15):
        value = likelihood.log_likelihood(pair)
        for floor in (value - 5.0, value - 1e-9):
            assert likelihood.log_likelihood(pair, at_least=floor) == pytest.approx(value, rel=1e-12)
        for floor in (value + 1e-9, value + 5.0):
            assert likelihood.log_likelihood(pair, at_least=floor) == -np.inf


def test_density_ignores_rigid_motion_of_the_pair(annotated: tuple[AnnotatedPairs, ViewBank]) -> None:
    rng = np.random.default_rng(11)
    density = density_of(annotated, truncation=np.inf)
    compared = 0
    for _ in range(20):
        parameters = random_parameters(rng, scale=0.03)
        value = density(parameters).log_density
        assert density(moved(rng, parameters)).log_density == pytest.approx(value, rel=1e-8)
        compared += np.isfinite(value)
    assert compared >= 10


def test_density_is_cut_below_and_flat_above_the_seed(annotated: tuple[AnnotatedPairs, ViewBank]) -> None:
    rng = np.random.default_rng(12)
    free, cut = density_of(annotated, truncation=np.inf), density_of(annotated, truncation=10.0)
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


def test_a_seed_with_density_zero_names_the_term_and_the_amount() -> None:
    chart = PairChart(SEED)
    bent = chart.seed_parameters()
    for person in range(2):
        for name in ("left_ankle", "right_ankle", "left_wrist", "right_wrist", "head", "neck"):
            bent[block_indices(PAIR17.index(name) + 17 * person)[:2]] = [1.8, 0.5]
    broken = PairChart(chart.positions(bent))
    with pytest.raises(InputError, match=r"density 0: the prior found \d+ joint angles out of range, \d+ more than"):
        PairDensity(broken, PhysicalPrior(broken, LIMITS), None)


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
    propose = GaussianBlocks(StepSettings(max_blocks=3))
    parameters = random_parameters(rng)
    for _ in range(200):
        proposed = propose(parameters, None, rng).parameters
        np.testing.assert_allclose(proposed[LENGTH_INDICES], proposed[MIRRORED_LENGTH], atol=1e-12)
        changed = [
            block
            for block in range(NUM_BLOCKS)
            if not np.array_equal(proposed[block_indices(block)[:2]], parameters[block_indices(block)[:2]])
        ]
        assert 1 <= len(changed) <= 3


def test_annotations_that_show_too_little_are_left_out_and_counted() -> None:
    rng = np.random.default_rng(14)
    pixels = rng.normal(size=(5, 2, 17, 2))
    pixels[0, :, [6, 7, 9, 10, 12, 13]] = np.nan
    pixels[1, 0, PAIR17.indices(("neck", "left_hip", "left_shoulder"))] = np.nan
    pixels[4, :, 4:13] = np.nan
    gathered = gather_pairs(pixels, np.ones((5, 2)), np.ones((5, 3)), np.ones(5), np.arange(5))
    assert gathered.num_skipped == 2
    assert list(gathered.pairs.annotation_index) == [0, 2, 3]
    np.testing.assert_array_equal(gathered.pairs.is_seen[0], np.isfinite(pixels[0, ..., 0]))
    pixels[:, 1] = np.nan
    with pytest.raises(InputError, match="none of the 5 annotated pairs"):
        gather_pairs(pixels, np.ones((5, 2)), np.ones((5, 3)), np.ones(5), np.arange(5))


def test_an_annotation_enters_a_view_once_by_its_nearest_hypothesis() -> None:
    rng = np.random.default_rng(15)
    directions = normalise(rng.normal(size=(90, 3)))
    pairs = AnnotatedPairs(rng.normal(size=(90, 2, 17, 2)), directions, np.repeat(np.arange(30), 3))
    bank = build_bank(normalise(rng.normal(size=(5, 3))), pairs, num_candidates=25)
    for view in range(5):
        own = bank.candidates[view, : bank.counts[view]]
        assert len(own) >= 20
        assert len(set(pairs.annotation_index[own])) == len(own)
        for entry in own:
            same = np.flatnonzero(pairs.annotation_index == pairs.annotation_index[entry])
            nearest = same[np.argmax(directions[same] @ bank.directions[view])]
            assert entry == nearest


def test_fewer_annotations_than_candidates_are_all_used() -> None:
    rng = np.random.default_rng(16)
    pairs = random_annotations(rng, random_pairs(rng, 3), 3)
    bank = build_bank(normalise(rng.normal(size=(4, 3))), pairs)
    assert list(bank.counts) == [3, 3, 3, 3]
    match = InteractionLikelihood(pairs, bank).match(random_pairs(rng, 1)[0])
    assert np.isfinite(match.log_likelihood)


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
    """In the pair, the annotations and the frame of the views: i and k turn round, j stays (lift eq. 3)."""
    rng = np.random.default_rng(19)
    pairs = random_annotations(rng, random_pairs(rng, 60, spread_rad=0.1), 60)
    swap_view = np.array([-1.0, 1.0, -1.0])
    swapped = AnnotatedPairs(pairs.points_m[:, ::-1].copy(), pairs.directions * swap_view, pairs.annotation_index)
    views = ViewDensity(pairs.directions, np.ones(60), 0.5).sample(rng, 5)
    one = InteractionLikelihood(pairs, build_bank(views, pairs))
    other = InteractionLikelihood(swapped, build_bank(views * swap_view, swapped))
    for pair in random_pairs(rng, 20, spread_rad=0.1):
        assert other.log_likelihood(pair[::-1]) == pytest.approx(one.log_likelihood(pair), rel=1e-9)
        # Who is who matters: the same pair with its people exchanged is another one.
        assert one.log_likelihood(pair[::-1]) != pytest.approx(one.log_likelihood(pair), rel=1e-3)
    chart, mirror = PairChart(SEED), PairChart(SEED[::-1].copy())
    own, exchanged = PhysicalPrior(chart, LIMITS), PhysicalPrior(mirror, LIMITS)
    for _ in range(20):
        parameters = random_parameters(rng, scale=0.1)
        flipped = np.concatenate([parameters[NUM_PARAMETERS // 2 :], parameters[: NUM_PARAMETERS // 2]])
        terms = own.terms(parameters, chart.positions(parameters))
        there = exchanged.terms(flipped, mirror.positions(flipped))
        np.testing.assert_allclose(mirror.positions(flipped), chart.positions(parameters)[::-1], atol=1e-12)
        assert there.log_prior == pytest.approx(terms.log_prior, rel=1e-9)
        assert there.penetration_m == pytest.approx(terms.penetration_m, rel=1e-9, abs=1e-12)
