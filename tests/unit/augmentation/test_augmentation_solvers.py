"""The solvers of variants: exact bones, kept contacts, and agreement with slow plain forms."""

from typing import Any, Literal

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.optimize import least_squares

from pasdedeux.augmentation import AugmentationSettings, Augmenter, Source, exact_bones, uniform_variations
from pasdedeux.augmentation import weights as w
from pasdedeux.augmentation.bulk import BulkResult, BulkSolver
from pasdedeux.augmentation.energy import descend, fit_terms
from pasdedeux.augmentation.exact_bones import project_to_bones
from pasdedeux.augmentation.factor import factorise, solve_factored
from pasdedeux.augmentation.problem import MeshProblem, Targets, girdle_pairs
from pasdedeux.augmentation.terms import bending_rows, build_problem, build_targets
from pasdedeux.augmentation.variations import Variation, bone_variations, group_variations
from pasdedeux.choreography.duets import make_duet
from pasdedeux.fitting.bones import BoneForest
from pasdedeux.fitting.levenberg import FitSettings
from pasdedeux.fitting.terms import total_energy
from pasdedeux.kinematics import bone_directions, bone_lengths, place_bones
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from tests.builders.choreography_laws import place_m
from tests.builders.moving_pairs import swaying_pair


def _problem(frames: int, scale: float = 0.8, **settings: Any) -> tuple[MeshProblem, Targets]:
    problem = build_problem(Source(swaying_pair(frames), 30.0), AugmentationSettings(**settings))
    scales = np.stack([variation.bone_scale for variation in uniform_variations([scale], ["A"])])
    return problem, build_targets(problem, scales)


def plain_residuals(problem: MeshProblem, targets: Targets, offsets: np.ndarray) -> np.ndarray:
    """Return all residuals of one variant at offsets (T, 44, 3); the energy is the sum of their squares."""
    apart = offsets - targets.difference[0]
    mesh, contacts, direction = problem.mesh, problem.contacts, w.CONTACT_DIRECTION
    frames = np.arange(len(offsets))[:, None, None]
    vectors = (contacts.shares[..., None] * (targets.reference[0] + offsets)[frames, contacts.points]).sum(axis=2)
    missed = vectors - targets.contact_m[0]
    stretched = np.linalg.norm(vectors, axis=-1) - np.linalg.norm(targets.contact_m[0], axis=-1)
    parts = [
        np.sqrt(w.LAPLACIAN) * (mesh.laplacian @ offsets - mesh.cross_laplacian @ targets.difference[0]),
        np.sqrt(problem.smoothness) * np.diff(offsets, n=2, axis=0),
        np.sqrt(w.REFERENCE) * offsets,
        np.sqrt(w.BENDING) * (bending_rows(problem.source) @ offsets),
        np.sqrt(problem.floor) * (offsets[..., 1] - targets.height[0]),
        np.sqrt(problem.stance)[..., None] * np.diff(apart, axis=0)[..., [0, 2]],
        np.sqrt(direction * problem.contact_weights)[..., None] * missed,
        np.sqrt((1.0 - direction) * problem.contact_weights) * stretched,
    ]
    near = problem.clearance
    for t in range(len(offsets)):
        between = (near.shares[t][..., None] * offsets[t, near.points[t]]).sum(axis=1)
        short = targets.clearance_m[0, t] - (between * near.normals[t]).sum(axis=-1)
        parts.append(np.sqrt(near.weights[t]) * np.maximum(short, 0.0))
    ends = (targets.reference[0] + offsets)[:, girdle_pairs(problem.source.num_people)]
    girdle = np.linalg.norm(ends[..., 0, :] - ends[..., 1, :], axis=-1) - targets.girdle_m[0]
    return np.concatenate([*(part.ravel() for part in parts), np.sqrt(w.GIRDLE) * girdle.ravel()])


def _oracle_energy(problem: MeshProblem, targets: Targets, start: np.ndarray) -> float:
    """Return the least energy by scipy's trust region over roots and direction vectors, which are normalised inside."""
    forest = BoneForest((BODY22, BODY22), targets.lengths_m[0])
    state = forest.state_of(start)
    frames = len(start)

    def positions(values: np.ndarray) -> np.ndarray:
        roots, vectors = np.split(values, [frames * 6])
        directions = vectors.reshape(frames, 44, 3)
        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        return forest.positions(type(state)(roots.reshape(frames, 2, 3), directions))

    def residuals(values: np.ndarray) -> np.ndarray:
        return plain_residuals(problem, targets, positions(values) - targets.reference[0])

    first = np.concatenate([state.roots_m.ravel(), state.directions.ravel()])
    result = least_squares(residuals, first, method="trf", ftol=1e-7, xtol=1e-9, gtol=1e-9, max_nfev=30)
    return 2.0 * result.cost


def test_the_shared_matrix_adds_up_to_the_energy_as_it_is_written() -> None:
    problem, targets = _problem(5)
    offsets = np.random.default_rng(0).normal(0.0, 0.1, (1, 5, 44, 3))
    written = (plain_residuals(problem, targets, offsets[0]) ** 2).sum()
    terms = fit_terms(problem, targets, 0)
    assert total_energy(terms, targets.reference[0] + offsets[0]) == pytest.approx(written, rel=1e-10)


def _apply(problem: MeshProblem, x: np.ndarray, group: int) -> np.ndarray:
    product = np.einsum("tij,tj->ti", problem.matrix[group], x)
    for shift, lag in ((1, problem.lag1[group]), (2, problem.lag2[group])):
        product[:-shift] += lag * x[shift:]
        product[shift:] += lag * x[:-shift]
    return product


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 7])
def test_the_shared_factor_solves_its_matrix(frames: int) -> None:
    problem, _ = _problem(frames)
    for group in (0, 1):
        factor = factorise(problem.matrix[group], problem.lag1[group], problem.lag2[group])
        expected = np.random.default_rng(frames).normal(size=(frames, 44, 3))
        rhs = np.zeros((2 * factor.num_blocks, 44, 3))
        rhs[:frames] = np.stack([_apply(problem, expected[..., v], group) for v in range(3)], axis=-1)
        solution = np.zeros((factor.num_blocks, 88, 3, 3))
        solution[:, :, [0, 2]] = rhs.reshape(factor.num_blocks, 88, 1, 3)
        solve_factored(factor, solution, np.array([0, 2]))
        assert not solution[:, :, 1].any()
        for axis in (0, 2):
            np.testing.assert_allclose(solution[:, :, axis].reshape(-1, 44, 3)[:frames], expected, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.75, 1.25])
def test_bulk_and_descent_reach_the_optimum_of_a_slow_plain_solver(scale: float) -> None:
    problem, targets = _problem(3, scale)
    terms = fit_terms(problem, targets, 0)
    best = _oracle_energy(problem, targets, targets.reference[0])
    descent = descend(targets, 0, terms, settings=FitSettings(max_iterations=200, tolerance=1e-9))
    bulk = BulkSolver(problem, dtype=np.float64).solve(targets)
    assert descent.energies[-1] <= best * (1.0 + 1e-3)
    assert total_energy(terms, bulk.positions[0]) <= best * (1.0 + 1e-3)
    single = BulkSolver(_problem(3, scale)[0]).solve(targets).positions[0]
    assert total_energy(terms, single) <= best * (1.0 + 1e-3)


@pytest.mark.parametrize("solver", ["bulk", "polished"])
def test_extreme_scales_of_bones_give_finite_motion_with_exact_bones(solver: Literal["bulk", "polished"]) -> None:
    """Every bone has a scale of its own, left and right too."""
    scales = np.random.default_rng(1).uniform(0.5, 1.5, (24 if solver == "bulk" else 8, 2, 22))
    augmenter = Augmenter(Source(swaying_pair(12, apart_m=0.4), 30.0), AugmentationSettings(solver=solver))
    for variant in augmenter.solve([Variation(f"wild-{index}", scale) for index, scale in enumerate(scales)]):
        assert np.isfinite(variant.positions_m).all()
        assert variant.quality.bone_error_m < 1e-9
        assert variant.energy <= variant.energy_fk
        assert (variant.verdict.level is Level.PASS) == (variant.verdict.reason == "")


def test_bones_are_exact_and_contacts_kept() -> None:
    source = Source(swaying_pair(30), 30.0)
    variants = Augmenter(source).solve(uniform_variations([0.75, 0.9, 1.1, 1.25], ["A", "B", "AB"]))
    for variant in variants:
        wanted = source.lengths_m * variant.bone_scale
        wanted[:, BODY22.root] = 0.0
        lengths = bone_lengths(BODY22, variant.positions_m)
        np.testing.assert_allclose(lengths, np.broadcast_to(wanted, lengths.shape), atol=1e-9)
        assert variant.quality.bone_error_m < 1e-9
        # Plain forward kinematics is off by 23 mm and more, the mesh without its contacts by 1.3 to 13.5 mm.
        assert variant.quality.contact_drift_m < 0.001
        assert variant.energy <= variant.energy_fk


def test_a_spine_does_not_fold_to_make_a_torso_shorter() -> None:
    source = Source(swaying_pair(10, apart_m=0.3), 30.0)
    for variant in Augmenter(source).solve(uniform_variations([0.75, 1.25], ["A"])):
        assert variant.quality.spine_bend_rad < 0.5


def test_solving_is_equivariant_under_turns_about_the_vertical_and_shifts_over_the_floor() -> None:
    positions = swaying_pair(12)
    turn, shift = yaw_rotmat(0.7), np.array([3.0, 0.0, -2.0])
    variations = uniform_variations([0.8, 1.2], ["A"])
    scales = np.stack([variation.bone_scale for variation in variations])

    def solve(pair: np.ndarray) -> np.ndarray:
        problem = build_problem(Source(pair, 30.0))
        return BulkSolver(problem, dtype=np.float64).solve(build_targets(problem, scales)).positions

    # Iterations amplify rounding errors, above all accelerated ones.
    np.testing.assert_allclose(solve(positions) @ turn.T + shift, solve(positions @ turn.T + shift), atol=1e-5)


def test_single_and_double_precision_agree() -> None:
    problem, targets = _problem(20)
    single = BulkSolver(problem).solve(targets)
    double = BulkSolver(problem, dtype=np.float64).solve(targets)
    apart_m = np.linalg.norm(single.positions - double.positions, axis=-1).mean()
    assert apart_m < single.estimated_gap_m[0] + double.estimated_gap_m[0] < 0.006


@pytest.mark.parametrize("rate_hz", [5.0, 30.0])
def test_a_variant_has_the_same_bits_alone_and_in_any_batch(rate_hz: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Variants end at different iterations and leave the batch; at 30 Hz the take is thinned out, at 5 Hz it is not."""
    monkeypatch.setattr("pasdedeux.augmentation.bulk._MOST_ITERATIONS", 40)
    augmenter = Augmenter(Source(swaying_pair(33, apart_m=0.3), rate_hz))
    variations = [*bone_variations([0.6, 0.95], ["A"]), *uniform_variations([0.5, 1.02, 1.5], ["AB"])]
    together = augmenter.solve(variations)
    assert len({variant.num_iterations for variant in together}) > 2
    order = np.random.default_rng(0).permutation(len(variations))
    shuffled = augmenter.solve([variations[index] for index in order])
    for place, index in enumerate(order):
        assert shuffled[place].positions_m.tobytes() == together[index].positions_m.tobytes()
    for index in (0, 5, 16, 20, len(variations) - 3, len(variations) - 1):
        (alone,) = augmenter.solve(variations[index : index + 1])
        assert alone.positions_m.tobytes() == together[index].positions_m.tobytes()
        assert alone.quality == together[index].quality
        for figure in ("energy", "estimated_gap_m", "num_iterations"):
            assert getattr(alone, figure) == getattr(together[index], figure)


@pytest.mark.parametrize("name", ["waltz", "hug"])
def test_bulk_ends_where_guaranteed_descent_does(name: str) -> None:
    """Within 2 mm and 5 % of the energy, for shrunk and grown people, limbs and bones; the estimate says so."""
    source = Source(make_duet(name, rate_hz=30.0).positions_m()[:90], 30.0)
    drawn = np.random.default_rng(0).uniform(0.75, 1.25, (2, 22))
    variations = [
        *uniform_variations([0.75, 1.25], ["A", "B"]),
        *group_variations([0.75], ["A"], ["arms"]),
        Variation("drawn", drawn[:, np.minimum(np.arange(22), BODY22.mirror)]),
    ]
    bulk = Augmenter(source).solve(variations)
    polished = Augmenter(source, AugmentationSettings(solver="polished")).solve(variations)
    for found, best in zip(bulk, polished, strict=True):
        assert (found.solver, best.solver) == ("bulk", "polished")
        assert best.energy <= found.energy <= 1.05 * best.energy
        gap_m = np.linalg.norm(found.positions_m - best.positions_m, axis=-1).mean()
        assert gap_m < 0.002
        assert found.estimated_gap_m is not None
        assert gap_m < found.estimated_gap_m < 0.005


def test_results_are_continuous_in_scale() -> None:
    """No step between neighbouring scales is 20 % above that of guaranteed descent, though iterations differ."""
    source = Source(make_duet("hug", rate_hz=30.0).positions_m()[:60], 30.0)
    scales = uniform_variations(np.linspace(0.78, 0.9, 7).round(3).tolist(), ["A"])

    def steps(solver: Literal["bulk", "polished"]) -> np.ndarray:
        variants = Augmenter(source, AugmentationSettings(solver=solver)).solve(scales)
        motions = np.array([variant.positions_m for variant in variants])
        return np.asarray(np.linalg.norm(np.diff(motions, axis=0), axis=-1).mean(axis=(1, 2, 3)))

    assert (steps("bulk") < 1.2 * steps("polished")).all()


def test_people_do_not_sink_into_each_other_where_contacts_are_dense() -> None:
    source = Source(make_duet("hug", rate_hz=10.0).positions_m(), 10.0)
    variations = uniform_variations([0.75, 1.25], ["A"])
    kept = Augmenter(source, AugmentationSettings(solver="polished")).solve(variations)
    assert max(variant.quality.penetration_m for variant in kept) < 0.01


def test_feet_do_not_creep_while_they_stand_for_long() -> None:
    source = Source(make_duet("hug", rate_hz=10.0).positions_m(), 10.0)
    for variant in Augmenter(source).solve(uniform_variations([0.75, 1.25], ["A"])):
        assert variant.quality.stance_excursion_m < 0.004


@pytest.mark.parametrize(("frames", "depth"), [(1, 1.0), (2, 1.0), (3, 1.0), (3, 0.0)])
def test_takes_of_a_few_frames_and_those_in_one_plane_are_solved(frames: int, depth: float) -> None:
    source = Source(swaying_pair(frames) * [1.0, 1.0, depth], 30.0)
    (variant,) = Augmenter(source).solve(uniform_variations([0.8], ["A"]))
    assert np.isfinite(variant.positions_m).all()
    assert variant.quality.bone_error_m < 1e-6
    assert variant.quality.jerk_ratio == 1.0


def test_people_far_apart_are_solved_and_said_to_be_apart() -> None:
    (variant,) = Augmenter(Source(swaying_pair(10, apart_m=6.0), 30.0)).solve(uniform_variations([0.8], ["A"]))
    assert np.isfinite(variant.positions_m).all()
    assert variant.quality.num_contact_pairs == 0
    assert variant.verdict.level is Level.WARN
    assert "never come closer" in variant.verdict.reason


def test_plain_forward_kinematics_replaces_a_bulk_result_that_is_not_finite(monkeypatch: pytest.MonkeyPatch) -> None:
    def solve(solver: BulkSolver, targets: Targets) -> BulkResult:
        found = np.full(targets.reference.shape, np.nan)
        return BulkResult(found, np.zeros(len(found)), np.zeros(len(found), np.int64))

    monkeypatch.setattr(BulkSolver, "solve", solve)
    (variant,) = Augmenter(Source(swaying_pair(6), 30.0)).solve(uniform_variations([0.75], ["A"]))
    assert (variant.solver, variant.estimated_gap_m) == ("plain_fk", None)
    assert variant.energy == variant.energy_fk
    assert variant.verdict.level is Level.FAIL
    assert "plain forward kinematics" in variant.verdict.reason


def test_iterations_have_a_ceiling_and_the_estimate_says_when_it_was_too_low(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Source(swaying_pair(40), 30.0)
    (enough,) = Augmenter(source).solve(uniform_variations([0.75], ["A"]))
    monkeypatch.setattr("pasdedeux.augmentation.bulk._MOST_ITERATIONS", 6)
    (few,) = Augmenter(source).solve(uniform_variations([0.75], ["A"]))
    assert few.num_iterations == 6
    assert enough.num_iterations < 300
    assert few.estimated_gap_m is not None
    assert enough.estimated_gap_m is not None
    assert few.estimated_gap_m > 5.0 * enough.estimated_gap_m


def test_a_person_held_fixed_stays_with_the_source() -> None:
    source = Source(swaying_pair(10), 30.0)
    (variant,) = Augmenter(source, AugmentationSettings(fixed_person="B")).solve(uniform_variations([0.8], ["A"]))
    np.testing.assert_allclose(variant.positions_m[:, 1], source.positions_m[:, 1], atol=2e-3)
    assert variant.quality.contact_drift_m < 0.25 * variant.quality.contact_drift_fk_m


def test_a_carried_person_hangs_in_the_partners_hands_at_every_size_with_free_feet() -> None:
    duet = make_duet("lift", rate_hz=15.0)
    source = Source(duet.positions_m()[45:105], 15.0)
    toes = BODY22.indices(["left_toe", "right_toe"])
    low = source.positions_m[:, 1, toes, 1].min(axis=-1)
    stated = [contact.within(45, 105) for contact in duet.known_contacts(15.0)]
    augmenter = Augmenter(source, user_contacts=[contact for contact in stated if contact is not None])
    heights = []
    for variant in augmenter.solve(uniform_variations([0.75, 1.25], ["A"])):
        for contact in duet.contacts:
            apart = place_m(contact.point_a, variant.positions_m) - place_m(contact.point_b, variant.positions_m)
            np.testing.assert_allclose(np.linalg.norm(apart, axis=-1), contact.distance_m, atol=0.002)
        heights.append(variant.positions_m[:, 1, toes, 1].min(axis=-1) - low)
    assert heights[0].mean() < -0.05
    assert heights[1].mean() > 0.05


def test_a_foot_stays_where_it_is_put_down_at_any_rate() -> None:
    worst = []
    for rate_hz in (20.0, 80.0):
        source = Source(make_duet("waltz", rate_hz=rate_hz, duration_s=4.0).positions_m(), rate_hz)
        (variant,) = Augmenter(source).solve(uniform_variations([0.75], ["A"]))
        worst.append(variant.quality.stance_excursion_m)
    assert max(worst) < 0.01
    assert worst[0] == pytest.approx(worst[1], rel=0.25)


def test_the_result_does_not_depend_much_on_the_frame_rate() -> None:
    fast = swaying_pair(59)
    scales = uniform_variations([0.8], ["A"])
    (at_60,) = Augmenter(Source(fast, 60.0)).solve(scales)
    (at_30,) = Augmenter(Source(fast[::2], 30.0)).solve(scales)
    np.testing.assert_allclose(at_60.positions_m[::2], at_30.positions_m, atol=0.015)


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ({"fixed_person": "c"}, "fixed_person"),
        ({"limits": {"jerk_ratio": (2.0, 1.0)}}, "0 <= warn <= fail"),
        ({"limits": {"jerk": (1.0, 2.0)}}, "no figure that is judged; there are: bone_error_m"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], found: str) -> None:
    with pytest.raises(ValidationError, match=found):
        AugmentationSettings.model_validate(settings)


def test_the_compiled_projection_to_bones_is_plain_kinematics_to_the_last_bit() -> None:
    generator = np.random.default_rng(0)
    people, lengths = generator.normal(size=(3, 7, 2, 22, 3)), generator.uniform(0.1, 0.6, (3, 44))
    people[:, :, 1, 5] = people[:, :, 1, BODY22.parents[5]]
    lengths[:2, 22 + 5] = 0.0
    directions = bone_directions(BODY22, people)
    plain = place_bones(BODY22, people[..., BODY22.root, :], directions, lengths.reshape(3, 1, 2, 22))
    points = plain.reshape(3, 7, 44, 3)
    found = project_to_bones(people.reshape(points.shape), lengths)
    np.testing.assert_array_equal(found[:2], points[:2])
    # A bone that has a length and no direction points up.
    bone = found[2, :, 22 + 5] - found[2, :, 22 + BODY22.parents[5]]
    np.testing.assert_allclose(bone, np.tile([0.0, lengths[2, 22 + 5], 0.0], (7, 1)), atol=1e-12)


def test_the_nearest_motion_with_exact_bones_moves_joints_along_bones_alone() -> None:
    generator = np.random.default_rng(0)
    points = swaying_pair(7).reshape(1, 7, 44, 3) + generator.normal(0.0, 0.002, (1, 7, 44, 3))
    lengths = 1.01 * bone_lengths(BODY22, swaying_pair(7))[:1].reshape(1, 44)
    kept, nearest = (project_to_bones(points, lengths, is_nearest=is_nearest) for is_nearest in (False, True))
    found = bone_lengths(BODY22, nearest.reshape(7, 2, 22, 3)).reshape(7, 44)
    np.testing.assert_allclose(found, np.broadcast_to(lengths, found.shape), atol=1e-12)
    away = [np.linalg.norm(placed - points, axis=-1).mean() for placed in (kept, nearest)]
    assert away[1] < 0.6 * away[0]
    for body, moved in zip(nearest.reshape(-1, 22, 3), (nearest - points).reshape(-1, 66), strict=True):
        normals = np.zeros((21, 22, 3))
        for row, (parent, child) in enumerate(BODY22.bones):
            normals[row, child] = body[child] - body[parent]
            normals[row, parent] = -normals[row, child]
        left = moved - normals.reshape(21, 66).T @ np.linalg.lstsq(normals.reshape(21, 66).T, moved, rcond=None)[0]
        assert np.linalg.norm(left) < 0.1 * np.linalg.norm(moved)


def test_the_steps_to_exact_bones_are_within_0_05_mm_of_many_more(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = np.random.default_rng(1)
    points = (swaying_pair(5) + generator.normal(0.0, 0.01, (5, 2, 22, 3))).reshape(1, 5, 44, 3)
    lengths = 1.03 * bone_lengths(BODY22, swaying_pair(5))[:1].reshape(1, 44)
    nearest = project_to_bones(points, lengths, is_nearest=True)
    monkeypatch.setattr(exact_bones, "_STEPS_TO_NEAREST", 20)
    converged = project_to_bones(points, lengths, is_nearest=True)
    assert np.linalg.norm(nearest - converged, axis=-1).mean() < 5e-5
