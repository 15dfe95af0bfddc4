"""Benchmarks of the projection database: exact query, live chain, and databases of any size.

Times of single pieces of work are processor time of this process, which other programs on the machine do not change
much; rates beside each other were measured in the same run.
"""

from __future__ import annotations

import resource
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import chain, starmap
from typing import TypeVar
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from benchmarks.benchmark import BenchmarkResult, Rate, measure_rate
from pasdedeux.kinematics.rotations import unitquat_from_rotvec
from pasdedeux.people.identity import Follower
from pasdedeux.projections.database import Database, DatabaseCamera
from pasdedeux.projections.published import Clusters, PublishedIndex, box_images, cluster_places, place_projections
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, centre_and_face, mid_hip
from pasdedeux.projections.search import Neighbours, build_index, prepare_query
from pasdedeux.reconstruction.bones import place_bone_rotations
from pasdedeux.reconstruction.errors import root_centred_error_m
from pasdedeux.reconstruction.live.chain import LivePeople
from pasdedeux.reconstruction.live.cleanup import LiveCleanUp
from pasdedeux.reconstruction.live.person import NUM_CANDIDATES, LivePose
from pasdedeux.reconstruction.live.window_fit import WindowFit
from pasdedeux.reconstruction.matching import Method, Searcher, match_track
from pasdedeux.reconstruction.people import SequenceOptions, reconstruct_people
from pasdedeux.reconstruction.reconstruct import reconstruct_track
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import OP14

T = TypeVar("T")
Waits = npt.NDArray[np.float64]

_NUM_POSES = 7_200
"""Poses of the paper's database; with 30 yaw steps 216,000 projections."""

_NUM_CLUSTERS = 500
"""Number of clusters in the paper."""

_NUM_SIGNALS = 5
_NUM_QUERIES = 300
_LIVE_FRAMES = 240
_NUM_TRIES = 3
"""Each query is made this many times and the best counts: what other processes take is not the search's."""


def made_up_database(num_poses: int = _NUM_POSES, *, seed: int = 0) -> Database:
    """Return a database of smooth made-up motion: bones turn about the T-pose with a few common signals, sums of sines.

    People's joints move together, so poses of other motions lie near those of a database; how signals move the bones is
    therefore the same for every seed, and the seed draws the signals.

    Args:
        num_poses: Poses, at 24 Hz.
        seed: Draws the signals.
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


def search_brute_force(
    database: Database, query_m: npt.ArrayLike, weights: npt.ArrayLike | None = None, *, num_neighbours: int = 50
) -> Neighbours:
    """Return the result of `ProjectionIndex.search` by brute force: the plain form, and the oracle of the tests."""
    joints = database.num_joints
    query, weight = prepare_query(query_m, weights, num_joints=joints)
    projections = database.project().reshape(-1, joints, 2)
    flat_query, flat_weight = query.reshape(-1, joints, 2), weight.reshape(-1, joints)
    nearest = np.full((len(flat_query), num_neighbours), -1, dtype=np.int64)
    distance = np.full((len(flat_query), num_neighbours), np.inf)
    for number, (image, joint_weight) in enumerate(zip(flat_query, flat_weight, strict=True)):
        total = float(joint_weight.sum(dtype=np.float64))
        if total <= 0:
            continue
        summed = np.zeros(len(projections), dtype=np.float32)
        for joint in range(joints):
            dx = image[joint, 0] - projections[:, joint, 0]
            dy = image[joint, 1] - projections[:, joint, 1]
            summed += joint_weight[joint] * np.sqrt(dx * dx + dy * dy)
        count = min(num_neighbours, len(summed))
        cut = np.partition(summed, count - 1)[count - 1]
        near = np.flatnonzero(summed <= cut)
        order = near[np.lexsort((near, summed[near]))][:count]
        nearest[number, :count] = order
        distance[number, :count] = summed[order].astype(np.float64) / total
    shape = (*query.shape[:-2], num_neighbours)
    return Neighbours(nearest.reshape(shape), distance.reshape(shape), database.num_yaws)


def _queries() -> npt.NDArray[np.float64]:
    """Return noisy images of a motion that is not in the database, 1 cm of noise per joint.

    About as far from their best match as people's motion is from other people's, 5 to 10 cm a joint.
    """
    rng = np.random.default_rng(1)
    poses = made_up_database(24 * _NUM_QUERIES, seed=1).poses_m[::24].astype(np.float64)
    return np.asarray(poses[..., :2] + rng.normal(0.0, 0.01, (_NUM_QUERIES, OP14.num_joints, 2)))


def _waits_ms(start: Callable[[], Callable[[int, Waits], object]], inputs: Waits) -> Waits:
    """Return the processor time of each input, one a call, the best of some runs, each started anew, in milliseconds.

    The first run, which may compile, does not count.
    """
    tries = []
    for _ in range(_NUM_TRIES + 1):
        step, waits = start(), []
        for number, given in enumerate(inputs):
            started = time.thread_time()
            step(number, given)
            waits.append(1e3 * (time.thread_time() - started))
        tries.append(waits)
    return np.asarray(np.min(tries[1:], axis=0))


def _in_words(waits_ms: Waits) -> str:
    return f"median {np.median(waits_ms):.2f} ms, 99th percentile {np.quantile(waits_ms, 0.99):.2f} ms"


def _query() -> BenchmarkResult:
    database, queries = made_up_database(), _queries()
    started = time.process_time()
    index = build_index(database)
    build_s = time.process_time() - started
    waits = _waits_ms(lambda: lambda _, query: index.search(query), queries)
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return BenchmarkResult(
        "exact projection query, 50 best",
        "queries",
        *Rate("box tree", 1e3 / float(np.mean(waits))),
        *measure_rate("brute force numpy", lambda: search_brute_force(database, queries[:5]), count=5, repeats=2),
        f"{database.num_projections:,} projections, built in {build_s:.1f} s of processor time with at most "
        f"{peak_gb:.1f} GB; one query a call: {_in_words(waits)}",
    )


def _published() -> BenchmarkResult:
    """Measure each step of the published preparation and our tree, then a query and a frame of both."""
    database, rng = made_up_database(), np.random.default_rng(0)
    steps: dict[str, str] = {}

    def timed(name: str, step: Callable[[], T]) -> T:
        step()  # which may compile
        started = time.process_time()
        result = step()
        taken_s = time.process_time() - started
        tracemalloc.start()
        step()
        steps[name] = f"{taken_s:.1f} s and {tracemalloc.get_traced_memory()[1] / 1e6:.0f} MB"
        tracemalloc.stop()
        return result

    images = timed("projections", lambda: box_images(database))
    places = timed("MDS", lambda: place_projections(images, rng))
    clusters: Clusters = timed("k-means", lambda: cluster_places(places, _NUM_CLUSTERS, rng))
    index, published = timed("tree", lambda: build_index(database)), PublishedIndex(database, clusters)
    searcher, queries = Searcher.of(database, clusters), _queries()
    waits = _waits_ms(lambda: lambda _, query: published.search(query), queries)
    exact = _waits_ms(lambda: lambda _, query: index.search(query), queries)
    px = DatabaseCamera().project(made_up_database(_LIVE_FRAMES, seed=1).poses_m.astype(np.float64))
    track = Track(px * [350.0, -350.0], np.ones(px.shape[:2]), 24.0, Lens(1e9, (0.0, 0.0)))
    matches = match_track(searcher, track)
    frames = {"place and exact search": lambda: match_track(searcher, track)} | {
        f"method {method}": partial(reconstruct_track, searcher, track, method, matches=matches)
        for method in (Method.PUBLISHED, Method.VITERBI, Method.FIT)
    }
    shown = [
        f"{name} {1e3 / measure_rate(name, frame, count=_LIVE_FRAMES, repeats=1).per_s:.2f} ms"
        for name, frame in frames.items()
    ]
    return BenchmarkResult(
        "published projection query, 10 of each of 5 clusters",
        "queries",
        *Rate("clusters", 1e3 / float(np.mean(waits))),
        *Rate("exact search, 50 best", 1e3 / float(np.mean(exact))),
        f"{database.num_projections:,} projections; preparation, processor time and greatest memory: "
        + ", ".join(f"{name} {taken}" for name, taken in steps.items())
        + f"; a frame of a track of {_LIVE_FRAMES}: {', '.join(shown)}; one query a call: {_in_words(waits)}",
    )


def _live() -> BenchmarkResult:
    camera = DatabaseCamera(np.deg2rad(8.2))
    searcher = Searcher.of(replace(made_up_database(), camera=camera))
    motions = [made_up_database(_LIVE_FRAMES, seed=seed).poses_m.astype(np.float64) for seed in (1, 2)]
    rng = np.random.default_rng(2)
    places = np.array([[760.0, 540.0], [1160.0, 540.0]])
    px = np.stack([camera.project(motion) * np.array([350.0, -350.0]) for motion in motions], axis=1) + places[:, None]
    px += rng.normal(0.0, 1.0, px.shape)
    confidence = np.ones(px.shape[1:-1])
    spent_ms: list[float] = []

    def follow() -> Callable[[int, Waits], object]:
        follower = Follower()
        return lambda frame, px: follower.step(frame / 24.0, px, confidence)

    def start() -> Callable[[int, Waits], list[LivePose]]:
        people = LivePeople(searcher, rate_hz=24.0, image_size_px=(1920, 1080))
        return lambda frame, px: people.push(frame, px, confidence)

    def timed(method: Callable[..., T]) -> Callable[..., T]:
        def call(*given: object) -> T:
            started = time.thread_time()
            result = method(*given)
            spent_ms.append(1e3 * (time.thread_time() - started))
            return result

        return call

    with threadpool_limits(limits=1):  # as `reconstruct --follow` does
        waits = _waits_ms(start, px)
        with patch.multiple(WindowFit, see=timed(WindowFit.see), fit=timed(WindowFit.fit)):
            poses = list(chain.from_iterable(starmap(start(), enumerate(px))))
    parts = {
        "identities": _waits_ms(follow, px) / 2.0,
        "search": _waits_ms(
            lambda: lambda _, query: searcher.index.search(query, num_neighbours=NUM_CANDIDATES), _queries()
        ),
        "window fit": 2.0 * np.mean(spent_ms, keepdims=True),  # one call takes a frame, another gives its pose
        "clean-up": _waits_ms(lambda: LiveCleanUp(24.0).step, motions[0]),
    }
    track = Track(px[:, 0], np.ones(px.shape[::2]), 24.0, Lens.assumed(1920, 1080, px))
    in_parts = ", ".join(f"{name} {np.median(times):.3f}" for name, times in parts.items())
    axes = camera.camera_from_upright_rotmat.T
    truth = np.stack(motions, axis=1)[[pose.frame for pose in poses]] @ axes
    yaw_steps = np.array([pose.yaw_rad for pose in poses]) / searcher.database.yaw_step_rad
    matched = searcher.database.turned([pose.row for pose in poses], yaw_steps) @ axes
    person = np.array([pose.person_id for pose in poses])
    quality = []
    for poses_m in (np.stack([pose.positions_m for pose in poses]), matched):
        off = np.min([root_centred_error_m(poses_m, truth[:, other]) for other in (0, 1)], axis=0).mean()
        bent = [np.diff(poses_m[person == at] - mid_hip(poses_m[person == at])[:, None], n=2, axis=0) for at in (0, 1)]
        size = np.linalg.norm(np.concatenate(bent), axis=-1).mean() * 24.0**2
        quality.append(f"{100 * off:.1f} cm off with accelerations of {size:.1f} m/s2")
    return BenchmarkResult(
        "whole live chain, a frame of a person",
        "frames",
        *Rate("identities, search, yaw, Viterbi, window fit, filter, clean-up", 2e3 / float(np.mean(waits))),
        *measure_rate(
            "whole track at once, fit, without identities and clean-up",
            lambda: reconstruct_track(searcher, track, Method.FIT),
            count=_LIVE_FRAMES,
            repeats=1,
        ),
        f"{_LIVE_FRAMES} frames of two people, per person {_in_words(waits / 2.0)} of processor time; "
        f"medians of parts, ms: {in_parts}; joints {quality[0]}, of the matches {quality[1]}",
    )


def _reconstruct() -> BenchmarkResult:
    """Measure the reconstruction of a film of two people, and the nearest pose of each frame as baseline."""
    searcher = Searcher.of(made_up_database())
    camera, places = searcher.database.camera, np.array([[760.0, 540.0], [1160.0, 540.0]])
    motions = [made_up_database(_LIVE_FRAMES, seed=seed).poses_m.astype(np.float64) for seed in (1, 2)]
    noise = np.random.default_rng(2)
    px = [camera.project(motion) * [350.0, -350.0] + place for motion, place in zip(motions, places, strict=True)]
    px = [track + noise.normal(0.0, 1.0, track.shape) for track in px]
    lens = Lens.assumed(1920, 1080, np.stack(px, axis=1))
    tracks = [Track(track, np.ones(track.shape[:2]), 24.0, lens, person_id=number) for number, track in enumerate(px)]
    forms = {"fit, scene, clean-up and bodies": Method.FIT, "nearest pose and bodies": Method.NEAREST}
    rates = [
        measure_rate(
            name,
            partial(reconstruct_people, searcher, tracks, SequenceOptions([method])),
            count=2 * _LIVE_FRAMES,
            repeats=1,
        )
        for name, method in forms.items()
    ]
    return BenchmarkResult(
        "reconstruction of film",
        "frames of a person",
        *rates[0],
        *rates[1],
        f"{_LIVE_FRAMES} frames of two people, {searcher.database.num_projections:,} projections",
    )


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {
    "query": _query,
    "published": _published,
    "live": _live,
    "reconstruct": _reconstruct,
}
