"""The window rule and the 1-euro filter are those of the papers, written out plainly here."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.kinematics.rotations import conjugate, multiply, rotvec_from_unitquat, unitquat_from_rotvec
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import centre_and_face
from pasdedeux.projections.search import Neighbours, build_index
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.reconstruction.smoothing import OneEuro, OneEuroFilter
from pasdedeux.reconstruction.temporal import choose_window
from tests.builders.walkers import walk


def published_filter(values: np.ndarray, rate: float, least: float, beta: float, derivative: float) -> np.ndarray:
    """Casiez, Roussel and Vogel (2012), algorithm 1, for numbers."""

    def alpha(cutoff: float) -> float:
        tau = 1.0 / (2.0 * np.pi * cutoff)
        return 1.0 / (1.0 + tau * rate)

    out, slope = [values[0]], 0.0
    for value in values[1:]:
        raw = (value - out[-1]) * rate
        slope = alpha(derivative) * raw + (1.0 - alpha(derivative)) * slope
        share = alpha(least + beta * abs(slope))
        out.append(share * value + (1.0 - share) * out[-1])
    return np.array(out)


def filtered(unitquat: np.ndarray, settings: OneEuro) -> np.ndarray:
    """Return rotations (frame, n, 4) at 30 Hz after the filter, a frame at a time as live video has them."""
    filter_ = OneEuroFilter(settings, 30.0)
    return np.stack([filter_.step(frame, rotations) for frame, rotations in enumerate(unitquat)])


@pytest.mark.parametrize(("least", "beta"), [(1.0, 0.0), (0.5, 0.7), (3.0, 0.1)])
def test_the_filter_of_rotations_about_one_axis_is_the_published_one_of_the_angle(least: float, beta: float) -> None:
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.normal(0, 0.1, 80)) + rng.normal(0, 0.05, 80)
    axis = np.array([0.6, 0.0, -0.8])
    settings = OneEuro(min_cutoff_hz=least, beta=beta, derivative_cutoff_hz=1.3)
    smooth = filtered(unitquat_from_rotvec(angle[:, None, None] * axis), settings)[:, 0]
    expected = unitquat_from_rotvec(published_filter(angle, 30.0, least, beta, 1.3)[:, None] * axis)
    np.testing.assert_allclose(np.abs(np.sum(smooth * expected, axis=-1)), 1.0, atol=1e-12)


def test_noise_at_rest_does_not_open_the_filter() -> None:
    noise = np.random.default_rng(0).normal(0, 0.05, (400, 1, 3))
    still, shut = (filtered(unitquat_from_rotvec(noise), OneEuro(min_cutoff_hz=0.5, beta=beta)) for beta in (0.2, 0.0))
    left = [np.std(rotvec_from_unitquat(one)[50:]) for one in (still, shut)]
    assert left[0] < 1.5 * left[1]


def test_the_window_rule_is_that_of_the_paper() -> None:
    """Sections 5 and eq. 2 of Yiannakides et al. 2019, one candidate, frame and joint after the other."""
    poses = centre_and_face(np.concatenate([walk(40, seed=1), walk(40, seed=2)])).poses_m.astype(np.float32)
    database = Database(poses, np.arange(80) == 40, num_yaws=12)
    query = database.project()[10:30, 5] + np.random.default_rng(0).normal(0, 0.05, (20, 14, 2))
    found = build_index(database).search(query, num_neighbours=8)
    projection = found.projection.copy()
    projection[7] = -1  # a frame in which nothing was seen
    neighbours = Neighbours(projection, found.distance_m, 12)

    def rotations(row: int, yaw: int) -> np.ndarray:
        return bone_rotations(database.turned(row, yaw))

    def distance(one: np.ndarray, other: np.ndarray) -> float:
        total = 0.0
        for joint in range(14):
            log = 0.5 * rotvec_from_unitquat(multiply(conjugate(other[joint]), one[joint]))
            total += float(log @ log)
        return float(np.sqrt(total))

    made: list[np.ndarray] = []
    expected = []
    for frame in range(20):
        if projection[frame, 0] < 0:
            expected.append(-1)
            continue
        costs = []
        for row, yaw in zip(neighbours.row[frame], neighbours.yaw_index[frame], strict=True):
            first = 0 if row < 40 else 40
            terms = []
            for back in range(1, min(4, len(made)) + 1):
                if row - back >= first:
                    terms.append((1.0 / back, distance(rotations(row - back, yaw), made[-back])))
            if not terms and made:
                terms = [(1.0, distance(rotations(first, yaw), made[-1]))]
            costs.append(sum(w * d for w, d in terms) / sum(w for w, _ in terms) if terms else 0.0)
        best = int(np.argmin(costs))
        expected.append(best)
        made.append(rotations(neighbours.row[frame, best], neighbours.yaw_index[frame, best]))
    assert choose_window(database, neighbours, window=4).tolist() == expected
