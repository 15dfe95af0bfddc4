"""Benchmarks of the projection database: build and exact query of 216,000 projections beside the plain forms."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from pasdedeux.benchmark import BenchmarkResult, measure_rate
from pasdedeux.kinematics.rotations import unitquat_from_rotvec
from pasdedeux.projections.bones import place_bone_rotations
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, centre_and_face
from pasdedeux.projections.search import build_index, search_brute_force
from pasdedeux.projections.temporal import choose_viterbi, choose_window
from pasdedeux.skeletons import OP14

__all__ = ["BENCHMARKS", "made_up_database"]

_NUM_POSES = 7_200
"""Poses of the paper's database; with 30 yaw steps 216,000 projections."""

_NUM_SIGNALS = 5
_NUM_QUERIES = 300
_NUM_TRIES = 3
"""Each query is made this many times and the best counts: what other processes take is not the search's."""


def made_up_database(num_poses: int = _NUM_POSES, *, seed: int = 0) -> Database:
    """Give a database of smooth made-up motion: bones turn about the T-pose with a few common signals, sums of sines.

    People's joints move together, so poses of other motions lie near those of a database; how signals move the bones is
    therefore the same for every seed, and the seed draws the signals.
    """
    shared = np.random.default_rng(0)
    mixing = shared.normal(0.0, 0.25, (_NUM_SIGNALS, OP14.num_joints, 3))
    rng = np.random.default_rng(seed)
    time_s = np.arange(num_poses) / 24.0
    signals = np.zeros((num_poses, _NUM_SIGNALS))
    for hz in (0.05, 0.2, 0.7):
        phase, pace = rng.uniform(0.0, 2.0 * np.pi, _NUM_SIGNALS), rng.uniform(0.8, 1.2, _NUM_SIGNALS)
        signals += np.sin(2.0 * np.pi * hz * pace * time_s[:, None] + phase) / np.sqrt(1.5)
    rotvec = np.einsum("ts,sjd->tjd", signals, mixing)
    rotvec[:, OP14.root] *= 0.2
    poses = place_bone_rotations(unitquat_from_rotvec(rotvec), REFERENCE_LENGTHS_M, np.zeros((num_poses, 3)))
    return Database(centre_and_face(poses).poses_m.astype(np.float32), np.arange(num_poses) % 300 == 0)


def _queries() -> npt.NDArray[np.float64]:
    """Give noisy images of a motion that the database does not hold, 1 cm a joint.

    About as far from their best match as people's motion is from other people's, 5 to 10 cm a joint.
    """
    rng = np.random.default_rng(1)
    poses = made_up_database(24 * _NUM_QUERIES, seed=1).poses_m[::24].astype(np.float64)
    return np.asarray(poses[..., :2] + rng.normal(0.0, 0.01, (_NUM_QUERIES, OP14.num_joints, 2)))


def _build() -> BenchmarkResult:
    database = made_up_database()
    fast = measure_rate(lambda: build_index(database), count=database.num_projections, repeats=2)
    plain = measure_rate(lambda: _project_one_by_one(database, 200), count=200 * database.num_yaws, repeats=1)
    return BenchmarkResult(
        name="projection database build",
        unit="projections",
        fast_name="vectorised projection and search tree",
        fast_per_s=fast,
        plain_name="projection one by one, no index",
        plain_per_s=plain,
        note=f"{database.num_projections:,} projections in {database.num_projections / fast:.2f} s",
    )


def _project_one_by_one(database: Database, num_rows: int) -> list[npt.NDArray[np.float64]]:
    return [
        np.asarray(database.camera.project(database.turned(np.array(row), np.array(yaw))))
        for row in range(num_rows)
        for yaw in range(database.num_yaws)
    ]


def _query() -> BenchmarkResult:
    database = made_up_database()
    index = build_index(database)
    queries = _queries()
    index.search(queries[0])
    waits = []
    for query in queries:
        tries = []
        for _ in range(_NUM_TRIES):
            started = time.perf_counter()
            found = index.search(query)
            tries.append(time.perf_counter() - started)
        waits.append(min(tries))
    expected = search_brute_force(database, queries[-1])
    is_same = bool(np.array_equal(found.projection, expected.projection))
    plain = measure_rate(lambda: search_brute_force(database, queries[:5]), count=5, repeats=2)
    return BenchmarkResult(
        name="exact projection query, 50 best",
        unit="queries",
        fast_name="box tree",
        fast_per_s=len(waits) / float(np.sum(waits)),
        plain_name="brute force numpy",
        plain_per_s=plain,
        note=(
            f"{database.num_projections:,} projections, one query a call: median {1e3 * np.median(waits):.2f} ms, "
            f"99th percentile {1e3 * np.quantile(waits, 0.99):.2f} ms, same answer: {is_same}"
        ),
    )


def _temporal() -> BenchmarkResult:
    database = made_up_database(1_200)
    frames = 200
    noise = np.random.default_rng(2).normal(0.0, 0.02, (frames, OP14.num_joints, 2))
    neighbours = build_index(database).search(database.poses_m[:frames, :, :2] + noise)
    return BenchmarkResult(
        name="choice over time among 50 candidates",
        unit="frames",
        fast_name="Viterbi",
        fast_per_s=measure_rate(lambda: choose_viterbi(database, neighbours, rate_hz=24.0), count=frames),
        plain_name="the paper's window rule",
        plain_per_s=measure_rate(lambda: choose_window(database, neighbours), count=frames, repeats=1),
        note="200 frames; the plain form is another rule, shown for scale",
    )


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {"build": _build, "query": _query, "temporal": _temporal}
