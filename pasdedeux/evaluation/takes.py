"""What a take looks like: closeness of the two people, floor and foot contact."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.scores import Score
from pasdedeux.interaction.surfaces import closest_joint_distance
from pasdedeux.skeletons import BODY22

_CLOSE_M = 0.15
"""Closest joints under this distance count as close contact."""


def take_scores(take_id: str, people_m: Array, rate_hz: float) -> list[Score]:
    """Describe a take in figures.

    Args:
        take_id: Name of the take.
        people_m: body22 positions (frame, person, 22, 3), metres.
        rate_hz: Frames per second.
    """
    ankles = people_m[:, :, BODY22.indices(("left_ankle", "right_ankle", "left_toe", "right_toe")), 1]
    figures = [
        ("duration", len(people_m) / rate_hz, "s"),
        ("lowest_foot_joint", float(np.percentile(ankles.min(axis=(1, 2)), 5)), "m"),
    ]
    if people_m.shape[1] == 2:
        closest = closest_joint_distance(people_m)
        roots = np.linalg.norm(people_m[:, 0, 0] - people_m[:, 1, 0], axis=-1)
        figures += [
            ("closest_joints_median", float(np.median(closest)), "m"),
            ("share_closer_than_15_cm", float(np.mean(closest < _CLOSE_M)), ""),
            ("root_distance_median", float(np.median(roots)), "m"),
        ]
    return [
        Score(metric=name, method="capture", value=value, unit=unit, item=take_id, count=len(people_m))
        for name, value, unit in figures
    ]
