"""Distances between distributions: laws of each, and two halves of one distribution."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.evaluation.distributions import (
    density_coverage,
    distances,
    frechet_distance,
    halves,
    kernel_distance,
    kernel_interval,
)


def _normal(seed: int, count: int = 200, size: int = 4, shift: float = 0.0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, size)) + shift


def test_the_frechet_distance_of_normals_is_known() -> None:
    mean, spread = np.array([1.0, -2.0]), np.array([2.0, 0.5])
    normal, wide = _normal(0, 200_000, 2), _normal(1, 200_000, 2) * spread + mean
    assert frechet_distance(normal, wide) == pytest.approx(5.0 + 1.0 + 0.25, abs=0.1)
    assert frechet_distance(normal, normal) == pytest.approx(0.0, abs=1e-9)


def test_the_kernel_distance_has_no_bias_and_the_frechet_distance_of_few_has() -> None:
    pairs = [(_normal(2 * seed, 20), _normal(2 * seed + 1, 20)) for seed in range(300)]
    kernel = np.array([kernel_distance(*pair) for pair in pairs])
    assert abs(kernel.mean()) < 3.0 * kernel.std() / np.sqrt(len(kernel))
    assert np.mean([frechet_distance(*pair) for pair in pairs]) > 0.3
    apart = [kernel_distance(first, second + 0.5) for first, second in pairs]
    assert np.mean(apart) > 30.0 * kernel.std() / np.sqrt(len(kernel))


def _clips_of_units(seed: int, shift: float = 0.0) -> tuple[np.ndarray, list[str]]:
    """Return features of 12 units with 4 clips each that are much alike."""
    middles = np.repeat(_normal(seed, 12, shift=shift), 4, axis=0)
    return middles + 0.2 * _normal(seed + 1, 48), [str(row // 4) for row in range(48)]


def test_the_interval_of_the_kernel_distance_holds_what_it_should_and_knows_that_clips_of_a_unit_are_alike() -> None:
    true, hits, widths = 10.0, [], []  # the mean of 1000 draws of a clip a unit, 10.0 +- 0.2
    for seed in range(0, 240, 4):
        first, second = _clips_of_units(seed, 1.0), _clips_of_units(seed + 2)
        low, high = kernel_interval(first[0], second[0], first[1], second[1])
        hits.append(low < true < high)
        alone = [str(row) for row in range(48)]
        narrow = kernel_interval(first[0], second[0], alone, alone)
        widths.append((narrow[1] - narrow[0]) / (high - low))
    assert np.mean(hits) > 0.8  # few units of a skewed figure: not the 95 % of many
    assert np.median(widths) < 0.7
    assert np.isnan(kernel_interval(first[0], second[0], ["take"] * 48, second[1])).all()


def test_the_interval_is_that_of_leaving_out_one_unit_after_the_other() -> None:
    first, second = _clips_of_units(1, 1.0), _clips_of_units(3)
    variance = 0.0
    for kept, units, is_first in ((first[0], np.array(first[1]), True), (second[0], np.array(second[1]), False)):
        rests = [kept[units != name] for name in sorted(set(units))]
        values = [kernel_distance(rest, second[0]) if is_first else kernel_distance(first[0], rest) for rest in rests]
        variance += (len(values) - 1) * np.var(values)
    reach = 1.96 * np.sqrt(variance)
    middle = kernel_distance(first[0], second[0])
    found = kernel_interval(first[0], second[0], first[1], second[1])
    np.testing.assert_allclose(found, (middle - reach, middle + reach), rtol=1e-9)


@given(strata=st.lists(st.tuples(st.sampled_from("ab"), st.sampled_from("123")), max_size=20), seed=st.integers(0, 9))
def test_halves_are_made_up_alike(strata: list[tuple[str, str]], seed: int) -> None:
    first, second = halves(strata, np.random.default_rng(seed))
    assert sorted(first + second) == list(range(len(strata)))
    assert 0 <= len(first) - len(second) <= 1
    for part in {*strata, *((kind,) for kind, _ in strata)}:
        count = [sum(strata[at][: len(part)] == part for at in half) for half in (first, second)]
        assert abs(count[0] - count[1]) <= 1


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), turn=st.floats(-3.0, 3.0))
def test_no_distance_changes_when_features_are_rotated_or_reordered(seed: int, turn: float) -> None:
    first, second = _normal(seed, 30, 2), _normal(seed + 1, 25, 2, 0.3)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = distances(first[::-1] @ rotation.T, second @ rotation.T)
    for name, value in distances(first, second).items():
        assert moved[name] == pytest.approx(value, abs=1e-6)


def test_density_and_coverage_detect_samples_that_are_far_off_or_collapsed() -> None:
    real = _normal(0)
    density, coverage = density_coverage(real, _normal(1))
    assert density == pytest.approx(1.0, abs=0.2)
    assert coverage > 0.9
    assert density_coverage(real, _normal(1, shift=20.0)) == (0.0, 0.0)
    collapsed = density_coverage(real, np.zeros((200, 4)))
    assert collapsed[0] > 1.0
    assert collapsed[1] < 0.5
