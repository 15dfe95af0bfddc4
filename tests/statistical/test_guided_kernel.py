"""Guided steps sample what they are told to, and stop doing so when their ratio is forgotten."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from scipy.stats import norm

from pasdedeux.benchmarks.synthetic import random_annotations, random_pairs
from pasdedeux.cameras import pair_frame
from pasdedeux.errors import InputError
from pasdedeux.sampling import ChainState, Evaluation, GaussianBlocks, MoveMixture, Proposed, run_segment
from pasdedeux.sampling.growth import ViewedImages
from pasdedeux.sampling.guided import Guided, GuidedStep, Guides
from pasdedeux.sampling.guided_kernels import move_by
from pasdedeux.sampling.parameters import NUM_BLOCKS, NUM_JOINTS, POSITION_INDICES
from pasdedeux.sampling.proposals import Local
from tests.statistical.test_pair_kernels import (
    CHART,
    EVERYTHING,
    NUM_ERRORS,
    ROOTS_ONLY,
    X,
    Y,
    kernel,
    worst_error,
)

EVERY_BLOCK = np.arange(NUM_BLOCKS)


def guides(count: int, *, width_m: float) -> Guides:
    rng = np.random.default_rng(2)
    return Guides(random_annotations(rng, random_pairs(rng, 6, spread_rad=0.15), count), CHART, width_m=width_m)


def guided(mixture: MoveMixture) -> Guided:
    """A kernel with two goals: how the seed looks from two sides."""
    rng = np.random.default_rng(4)
    seed = Guides(random_annotations(rng, CHART.seed_m[None], 2), CHART, width_m=0.2)
    return Guided(
        replace(kernel(mixture, is_biased=False), root_position_m=0.1, root_rotation_rad=0.3),
        seed,
        share=0.8,
        stretch=0.3,
    )


def log_near_target(parameters: np.ndarray, at_least: float) -> Evaluation:
    """Roots about the seed's: x of A skewed, Gamma(3, 10) from 0.3 m beside it, y cut to +-0.2 m, the others normal."""
    offset = (parameters - CHART.seed_parameters())[POSITION_INDICES]
    x, y = offset[0, 0] + 0.3, offset[0, 1]
    if x <= 0.0 or abs(y) > 0.2:
        return Evaluation(-np.inf)
    others = offset[0, 2] ** 2 + (offset[1] ** 2).sum()
    return Evaluation(float(2.0 * np.log(x) - 10.0 * x - 0.5 * others / 0.2**2))


NEAR = {X: (0.3, 0.12), Y: (0.0, 0.2**2 / 3.0), 108: (0.0, 0.07), 109: (0.0, 0.04 + 0.2**2 / 3.0), 110: (0.0, 0.08)}
"""First two moments; 108 to 110 is where B's root is from A's, which is what an annotation pulls at."""


def positions_of_roots(propose: object) -> np.ndarray:
    """Return draws as offsets from seed, x of A from where its density begins and the roots' offset (108 to 110)."""
    chains = []
    for chain in range(2):
        rng = np.random.default_rng([23, chain])
        start = CHART.seed_parameters()
        state = ChainState(start, log_near_target(start, -np.inf))
        state, _ = run_segment(rng, state, log_near_target, propose, num_draws=20, thin=10)
        _, segment = run_segment(rng, state, log_near_target, propose, num_draws=300, thin=10)
        chains.append(segment.parameters - CHART.seed_parameters())
    draws = np.stack(chains)
    between = draws[..., POSITION_INDICES[1]] - draws[..., POSITION_INDICES[0]]
    draws[..., X] += 0.3
    return np.concatenate([draws, between], axis=-1)


def test_guided_roots_have_the_moments_of_a_skewed_and_a_truncated_target() -> None:
    assert worst_error(positions_of_roots(guided(ROOTS_ONLY)), NEAR) < NUM_ERRORS


@dataclass(frozen=True)
class OnlyTowards(Guided):
    """Steps that always go towards the annotation, taken for symmetric."""

    def __call__(self, parameters: np.ndarray, local: Local | None, rng: np.random.Generator) -> Proposed:
        pair = CHART.positions_fast(parameters)
        axes = np.ascontiguousarray(pair_frame(pair).axes)
        blocks = np.array([0, NUM_JOINTS])
        step = 0.6 * self.guides.way(parameters, pair, axes, int(rng.integers(2)), blocks)
        there = parameters.copy()
        assert move_by(there, blocks, step + 0.1 * rng.standard_normal((2, 6)), NUM_JOINTS)
        return Proposed(there)


def test_guided_steps_without_their_ratio_are_caught() -> None:
    right = guided(ROOTS_ONLY)
    assert worst_error(positions_of_roots(OnlyTowards(right.plain, right.guides)), NEAR) > 2 * NUM_ERRORS


def test_the_ratio_is_that_of_the_normal_densities_of_one_displacement_at_both_ends() -> None:
    """By the definition, number by number, for steps of every kind of move."""
    propose = Guided(kernel(EVERYTHING, is_biased=False), guides(6, width_m=0.5))
    rng = np.random.default_rng(3)
    here = CHART.seed_parameters() + 0.05 * rng.standard_normal(108)
    for _ in range(20):
        blocks = np.array(propose.plain.mixture.draw(rng).blocks)
        deviation = np.zeros((len(blocks), 6))
        deviation[blocks % NUM_JOINTS == 0] = 0.1
        deviation[blocks % NUM_JOINTS > 0, :2] = 0.2
        log_z = float(rng.uniform(-0.4, 0.4))
        step = GuidedStep(0.3 * rng.standard_normal((len(blocks), 6)), blocks, int(rng.integers(6)), log_z, deviation)
        there = here.copy()
        assert move_by(there, blocks, step.step, NUM_JOINTS)
        ends = []
        for point, displacement, z in ((here, step.step, np.exp(log_z)), (there, -step.step, np.exp(-log_z))):
            pair = CHART.positions(point)
            axes = np.ascontiguousarray(pair_frame(pair).axes)
            mean = (1.0 - z) * propose.guides.way(point, pair, axes, step.entry, blocks)
            logs = norm.logpdf(displacement, mean, np.sqrt(z) * np.maximum(deviation, 1e-9))[deviation > 0.0]
            images = np.swapaxes(propose.guides.images.reshape(6, 34, 2), 1, 2)
            residual = ViewedImages(images, propose.guides.annotated.directions).residuals(pair)
            chance = np.exp(-0.5 * (residual / 0.5) ** 2)
            ends.append(logs.sum() + np.log(chance[step.entry] / chance.sum()))
        found = propose.log_density(there, step.back()) - propose.log_density(here, step)
        assert found == pytest.approx(ends[1] - ends[0], abs=1e-6)


def test_a_proposed_step_carries_the_ratio_of_its_two_densities() -> None:
    propose = Guided(kernel(EVERYTHING, is_biased=False), guides(6, width_m=0.5), share=1.0)
    here = CHART.seed_parameters()

    class Kept(Guided):
        steps: ClassVar[list[GuidedStep]] = []

        def log_density(self, parameters: np.ndarray, guided: GuidedStep) -> float:
            self.steps.append(guided)
            return super().log_density(parameters, guided)

    watched = Kept(propose.plain, propose.guides, share=1.0)
    rng = np.random.default_rng(6)
    for _ in range(10):
        proposed = watched(here, None, rng)
        back = Kept.steps[-1]
        ratio = propose.log_density(proposed.parameters, back) - propose.log_density(here, back.back())
        assert proposed.log_correction == pytest.approx(ratio, abs=1e-9)


def test_the_way_to_an_annotation_leads_to_what_it_shows_and_back() -> None:
    found = guides(20, width_m=0.05)
    images = np.swapaxes(found.images.reshape(20, 34, 2), 1, 2)
    here = CHART.seed_parameters()
    pair = CHART.positions(here)
    axes = np.ascontiguousarray(pair_frame(pair).axes)
    before = ViewedImages(images, found.annotated.directions).residuals(pair)
    for entry in range(20):
        way = found.way(here, pair, axes, entry, EVERY_BLOCK)
        there = here.copy()
        assert move_by(there, EVERY_BLOCK, way, NUM_JOINTS)
        after = ViewedImages(images, found.annotated.directions).residuals(CHART.positions(there))[entry]
        assert after < 0.5 * before[entry]
        assert move_by(there, EVERY_BLOCK, -way, NUM_JOINTS)
        np.testing.assert_allclose(there, here, atol=1e-12)


def test_annotations_near_the_pair_are_preferred_as_much_as_the_width_says() -> None:
    pair = CHART.positions(CHART.seed_parameters())
    axes = np.ascontiguousarray(pair_frame(pair).axes)
    near, even = (guides(20, width_m=width).log_chances(pair, axes) for width in (0.03, np.inf))
    images = np.swapaxes(guides(20, width_m=1.0).images.reshape(20, 34, 2), 1, 2)
    residual = ViewedImages(images, guides(20, width_m=1.0).annotated.directions).residuals(pair)
    np.testing.assert_allclose(np.exp(even), 0.05)
    np.testing.assert_allclose(near - near[0], -0.5 * (residual**2 - residual[0] ** 2) / 0.03**2, atol=1e-6)
    assert np.exp(near).sum() == pytest.approx(1.0)


def test_a_turn_by_more_than_half_a_circle_is_refused() -> None:
    there = CHART.seed_parameters()
    assert not move_by(there, np.array([0]), np.array([[3.2, 0.0, 0.0, 0.0, 0.0, 0.0]]), NUM_JOINTS)


def test_guides_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="the width of guided proposals must be positive"):
        guides(3, width_m=0.0)
    with pytest.raises(InputError, match="stretch 0 cannot be"):
        Guided(GaussianBlocks(), guides(3, width_m=0.1), stretch=0.0)
    with pytest.raises(InputError, match="guided steps need positive scales"):
        Guided(GaussianBlocks(root_position_m=0.0), guides(3, width_m=0.1))
