"""People of a video kept apart: identities through crossings, and faults of detectors in close contact."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.experiments.detections import film, people_of
from pasdedeux.experiments.detector_faults import KINDS, JointCounts, count_joints, inject
from pasdedeux.people.faults import repair_faults
from pasdedeux.people.identity import follow_people, identity_switches

__all__ = ["fault_scores", "identity_scores"]

Array = npt.NDArray[np.float64]
Stream = Callable[[str, int], np.random.Generator]


def identity_scores(
    couples: Mapping[str, Array], *, rate_hz: float, num_views: int, noise_px: float, stream: Stream
) -> list[Score]:
    """Score how often people who are followed by pose and motion are taken for each other.

    Args:
        couples: By name, op14 positions (frame, person, 14, 3), upright axes, metres.
        rate_hz: Frames per second.
        num_views: Directions each couple is filmed from, drawn at random; people of a frame come in random order.
        noise_px: Noise at 1080 lines.
        stream: Gives the random stream of a (couple, view); the same for every noise, so views are the same too.

    Returns:
        Switches and rows dropped as ghosts for each couple and all of them, and switches per minute of video.
    """
    switches, dropped = dict.fromkeys(couples, 0), dict.fromkeys(couples, 0)
    rows = dict.fromkeys(couples, 0)
    for name, couple in couples.items():
        for view in range(num_views):
            seen = film(stream(name, view), couple, rate_hz=rate_hz, noise_px=noise_px)
            found = follow_people(seen.frame, seen.keypoints_px, seen.confidence, rate_hz=rate_hz)
            switches[name] += identity_switches(seen.true_id, found.track_id, seen.frame)
            dropped[name] += int(np.count_nonzero(found.track_id < 0))
            rows[name] += len(seen.frame)
    total = sum(rows.values())
    minutes = sum(len(couple) for couple in couples.values()) * num_views / rate_hz / 60.0
    split = _noise(noise_px)
    scores = []
    for metric, counts in (("identity_switches", switches), ("dropped_rows", dropped)):
        named = {**counts, "all": sum(counts.values())}
        scores += [
            Score(metric, "followed", float(value), "", False, split, name, count=rows.get(name, total))
            for name, value in named.items()
        ]
    per_minute = sum(switches.values()) / minutes if minutes else float("nan")
    return [*scores, Score("identity_switches_per_minute", "followed", per_minute, "", False, split, "all")]


def fault_scores(couples: Mapping[str, Array], *, rate_hz: float, noise_px: float, stream: Stream) -> list[Score]:
    """Score the repair of injected faults: shares of wrong joints found, put right, and left; and what was touched.

    Args:
        couples: By name, op14 positions (frame, 2, 14, 3), upright axes, metres; each is filmed from one direction.
        rate_hz: Frames per second.
        noise_px: Noise at 1080 lines.
        stream: Gives the random stream of a couple.
    """
    counts = dict.fromkeys(KINDS, JointCounts())
    touched = joints = 0
    for name, couple in couples.items():
        rng = stream(name, 0)
        points, confidence = people_of(film(rng, couple, rate_hz=rate_hz, noise_px=noise_px))
        clean = repair_faults(points, confidence, rate_hz=rate_hz)
        touched += int(np.count_nonzero(clean.is_touched))
        joints += clean.is_masked.size
        for kind in KINDS:
            faulty = inject(rng, points, confidence, kind)
            found = repair_faults(faulty.keypoints_px, faulty.confidence, rate_hz=rate_hz)
            counts[kind] += count_joints(faulty, points, found)
    split = _noise(noise_px)
    scores = []
    for kind, one in counts.items():
        scores += scores_of(one.shares, "repaired", split=split, item=f"fault: {kind}", count=one.wrong)
    share = {"share_of_good_joints_touched": touched / joints if joints else float("nan")}
    return [*scores, *scores_of(share, "repaired", split=split, item="no fault", count=joints)]


def _noise(noise_px: float) -> str:
    return f"noise {noise_px:g} px" if noise_px else "no noise"
