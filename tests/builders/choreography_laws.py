"""What is measured on a duet: contacts, slide, smoothness, penetration, joint angles; used by several tests."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pasdedeux.choreography.duet import BonePoint, Duet
from pasdedeux.plausibility.capsules import capsule_model, segment_distance
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.layouts import LAYOUTS


@dataclass(frozen=True)
class Measured:
    """Worst values of a duet, SI units."""

    contact_error_m: float
    slide_m: float
    between_m: float
    within_m: float
    acceleration: float
    jerk: float
    lowest_m: float
    num_invalid_angles: int


_SPARSE_HZ = 20.0
"""Frames a second in which bodies are looked for inside each other."""
distances = np.vectorize(segment_distance, signature="(k),(k),(k),(k)->()")


def measure(duet: Duet) -> Measured:
    """Measure everything over all frames."""
    positions = duet.positions_m()
    contact = max((_contact_error(duet, positions, c) for c in duet.contacts), default=0.0)
    velocity = np.diff(positions, axis=0) * duet.rate_hz
    acceleration = np.diff(velocity, axis=0) * duet.rate_hz
    jerk = np.diff(acceleration, axis=0) * duet.rate_hz
    pair17 = LAYOUTS["body22"].joint_map("pair17").positions(positions, BODY22.joint_names)
    within, between = _penetration(duet, positions[:: max(1, round(duet.rate_hz / _SPARSE_HZ))])
    return Measured(
        contact_error_m=contact,
        slide_m=_slide(duet, positions),
        between_m=between,
        within_m=within,
        acceleration=float(np.linalg.norm(acceleration, axis=-1).max(initial=0.0)),
        jerk=float(np.linalg.norm(jerk, axis=-1).max(initial=0.0)),
        lowest_m=float(positions[..., 1].min()),
        num_invalid_angles=int(JointLimits.published().num_invalid(pair17).max()),
    )


def place_m(point: BonePoint, positions: np.ndarray) -> np.ndarray:
    """Return a point of a bone (frame, 3) from everybody's positions (frame, person, 22, 3)."""
    child = BODY22.index(point.bone)
    end, start = positions[:, point.person, child], positions[:, point.person, BODY22.parents[child]]
    return start + point.fraction * (end - start)


def _contact_error(duet: Duet, positions, contact) -> float:
    apart = place_m(contact.point_a, positions) - place_m(contact.point_b, positions)
    distances = np.linalg.norm(apart, axis=-1)[duet.frames(contact)]
    return float(np.abs(distances - contact.distance_m).max(initial=0.0))


def _slide(duet: Duet, positions) -> float:
    worst = 0.0
    for stance in duet.stances:
        frames = duet.frames(stance)
        for joint in ("ankle", "toe"):
            points = positions[frames, stance.person, BODY22.index(f"{stance.foot}_{joint}")]
            worst = max(worst, float(np.abs(points - points[:1]).max(initial=0.0)))
    return worst


def _penetration(duet: Duet, positions) -> tuple[float, float]:
    """Deepest penetration: within a person over the pairs that the capsule model checks, between people over all.

    The tops of the thighs lie beside the belly (spine1 to spine2) in every pose, so these two are neighbours as well.
    """
    model = capsule_model(BODY22)
    radii = [body.radii_m for body in duet.bodies]
    names = np.array(BODY22.joint_names)
    is_neighbour = (names[model.within[:, 0]] == "spine2") & np.char.endswith(names[model.within[:, 1]], "_knee")
    pairs = model.within[~is_neighbour]
    people = range(len(radii))
    within = max(_depth(positions[:, p], positions[:, p], radii[p], radii[p], pairs, model) for p in people)
    couples = combinations(people, 2)
    return within, max(
        _depth(positions[:, a], positions[:, b], radii[a], radii[b], model.between, model) for a, b in couples
    )


def _depth(first, second, radii_a, radii_b, pairs, model) -> float:
    child_a, child_b = pairs[:, 0], pairs[:, 1]
    ends = (first[:, model.parents[child_a]], first[:, child_a], second[:, model.parents[child_b]], second[:, child_b])
    # Only bones whose middles are near enough can touch: the others need no exact distance.
    halves = 0.5 * sum(np.linalg.norm(ends[at + 1] - ends[at], axis=-1) for at in (0, 2))
    apart = np.linalg.norm(0.5 * (ends[0] + ends[1] - ends[2] - ends[3]), axis=-1)
    reach = np.broadcast_to(radii_a[child_a] + radii_b[child_b], apart.shape)
    near = apart - halves < reach
    return float((reach[near] - distances(*(end[near] for end in ends))).max(initial=0.0)) if near.any() else 0.0
