"""Bodies as capsules around the bones: radii, distances in closed form, penetration within and between people.

Penetration is eta of lift eq. 2 (Yin et al. 2018): the sum of the penetration depths over pairs of bones.  The paper
asks a physics engine; here, the distance of two segments is a formula, and pairs far apart are skipped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Integers, plain
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.kinematics import bone_lengths
from pasdedeux.kinematics.rotation_kernels import closest_on_segments, dot, row_of, subtract, weighted_sum
from pasdedeux.skeletons import BODY22, Skeleton
from pasdedeux.skeletons.humanoid import t_pose
from pasdedeux.skeletons.layouts import LAYOUTS

LEG_PER_HEIGHT = 0.491
"""Length of thigh and shank together, as a share of the stature (Drillis and Contini 1966: 0.245 + 0.246)."""

_SIDED = {
    "collar": 0.030,
    "shoulder": 0.030,
    "elbow": 0.025,  # the upper arm
    "wrist": 0.020,
    "hip": 0.040,
    "knee": 0.040,  # the thigh
    "ankle": 0.026,
    "toe": 0.018,
}
RADIUS_PER_HEIGHT: Mapping[str, float] = {
    **dict.fromkeys(("spine", "chest", "spine1", "spine2", "spine3"), 0.052),
    "neck": 0.030,
    "head": 0.040,
    **{f"{side}_{bone}": radius for side in ("left", "right") for bone, radius in _SIDED.items()},
}
"""Radius of the capsule around each bone, named by its child joint, as a share of the stature.

About four fifths of the half depth of the trunk and of girth / 2 pi of the limbs of an adult (a median man at 1.75 m:
half depth of the chest 0.115, girth of upper arm 0.33, forearm 0.27, mid thigh 0.55, calf 0.38 m): limbs taper, and
flesh yields by a centimetre or two before bodies penetrate.
"""


@dataclass(frozen=True)
class CapsuleModel:
    """The capsules of a skeleton, and the pairs of bones that are checked.

    Args:
        skeleton: The skeleton; a bone is named by its child joint.
        parents: Parent of every joint, (J,), -1 for the root.
        radius_per_height: Radius of each joint's bone as a share of the stature, (J,); 0 for the root.
        within: Pairs of bones of one person that are checked, by child joint, (pair, 2): at least two bones lie
            between them and they do not overlap when the person stands.
        between: Pairs of bones of two people that are checked, all of them, (pair, 2), person A's first.
    """

    skeleton: Skeleton
    parents: Integers
    radius_per_height: Array
    within: Integers
    between: Integers

    def radii_m(self, height_m: Array | float) -> Array:
        """Return radii (*batch, J) in metres of people of stature (*batch,)."""
        return np.asarray(height_m, dtype=np.float64)[..., None] * self.radius_per_height

    def radii_of(self, positions: Array) -> Array:
        """Return radii (person, J) of people in poses (*batch, person, J, 3), from their median leg lengths."""
        lengths = bone_lengths(self.skeleton, positions)
        typical = np.median(lengths.reshape(-1, *lengths.shape[-2:]), axis=0)
        return self.radii_m(body_height_m(self.skeleton, typical))

    def penetration(self, people_m: Array, radii_m: Array | None = None) -> Array:
        """Return the sums of penetration depths within each person and, last, between them (*batch, P + 1), metres.

        Args:
            people_m: People (*batch, person, J, 3), metres.
            radii_m: Radii of each person's bones, (person, J), metres; by default from the leg lengths of each pose.
        """
        *batch, num_people, _, _ = np.shape(people_m)
        people = plain(people_m, np.float64).reshape(-1, num_people, self.skeleton.num_joints, 3)
        if radii_m is None:
            radii_m = self.radii_m(body_height_m(self.skeleton, bone_lengths(self.skeleton, people)))
        radii = np.empty(people.shape[:-1])
        radii[...] = radii_m
        sums = _penetrations(people, radii, self.parents, self.within, self.between)
        return np.asarray(sums.reshape(*batch, num_people + 1))


def body_height_m(skeleton: Skeleton, bone_lengths_m: Array) -> Array:
    """Return the stature (*batch,) of people with these bone lengths (*batch, J), from their legs, metres."""
    legs = [joint for leg in skeleton.legs for joint in leg[1:]]
    return np.asarray(bone_lengths_m[..., legs].sum(axis=-1) / (2.0 * LEG_PER_HEIGHT))


def radius_per_height(skeleton: Skeleton) -> Array:
    """Return the radius of each joint's bone as a share of the stature (J,); 0 if it is unknown."""
    return np.array([RADIUS_PER_HEIGHT.get(name, 0.0) for name in skeleton.joint_names])


@compiled()
def segment_distance(start_a: Array, end_a: Array, start_b: Array, end_b: Array) -> float:
    """Return the distance between segments a and b, all ends (3,); a segment may be a point."""
    return _distance(subtract(end_a, start_a), subtract(end_b, start_b), subtract(start_a, start_b))


@inner_kernel()
def _distance(u: Any, v: Any, gap: Any) -> float:
    """Return the distance of segments along u and v whose starts are `gap` apart."""
    s, t = closest_on_segments(dot(u, u), dot(v, v), dot(u, v), dot(u, gap), dot(v, gap), 0.0)
    dx, dy, dz = gap[0] + s * u[0] - t * v[0], gap[1] + s * u[1] - t * v[1], gap[2] + s * u[2] - t * v[2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@inner_kernel()
def _depth(
    a: Array, parent_a: int, child_a: int, b: Array, parent_b: int, child_b: int, reach: float, halves: float
) -> float:
    """Return the penetration depth of two capsules whose radii sum to `reach`, half their bones to `halves`, or 0."""
    start_a, start_b = row_of(a, parent_a), row_of(b, parent_b)
    u, v, gap = subtract(row_of(a, child_a), start_a), subtract(row_of(b, child_b), start_b), subtract(start_a, start_b)
    # Balls around the two bones exclude pairs far apart without a division.
    middle = weighted_sum(1.0, gap, 0.5, subtract(u, v))
    far = reach + halves
    if dot(middle, middle) >= far * far:
        return 0.0
    return max(reach - _distance(u, v, gap), 0.0)


@compiled()
def pair_penetration(
    people: Array, radii: Array, parents: Integers, within: Integers, between: Integers, out: Array
) -> float:
    """Return the sum of penetration depths of a pair, or of any number of people, metres.

    Args:
        people: Positions (person, J, 3), float64, metres.
        radii: Radii (person, J), metres.
        parents: `CapsuleModel.parents`, (J,).
        within: `CapsuleModel.within`, (pair, 2).
        between: `CapsuleModel.between`, (pair, 2).
        out: The sums within person A, within B, ... and, last, between people are written here, (P + 1,).
    """
    count, half = people.shape[0], np.zeros(radii.shape)
    for person in range(count):
        for joint in range(parents.shape[0]):
            if parents[joint] >= 0:
                bone = subtract(row_of(people[person], joint), row_of(people[person], parents[joint]))
                half[person, joint] = 0.5 * math.sqrt(dot(bone, bone))
    for person in range(count):
        total = 0.0
        points, radius, size = people[person], radii[person], half[person]
        for row in range(within.shape[0]):
            first, other = within[row, 0], within[row, 1]
            reach, halves = radius[first] + radius[other], size[first] + size[other]
            total += _depth(points, parents[first], first, points, parents[other], other, reach, halves)
        out[person] = total
    total = 0.0
    for a in range(count):
        for b in range(a + 1, count):
            for row in range(between.shape[0]):
                first, other = between[row, 0], between[row, 1]
                reach = radii[a, first] + radii[b, other]
                halves = half[a, first] + half[b, other]
                total += _depth(people[a], parents[first], first, people[b], parents[other], other, reach, halves)
    out[count] = total
    everything = 0.0
    for part in range(count + 1):
        everything += out[part]
    return everything


@compiled()
def _penetrations(people: Array, radii: Array, parents: Integers, within: Integers, between: Integers) -> Array:
    sums = np.empty((people.shape[0], people.shape[1] + 1))
    for row in range(people.shape[0]):
        pair_penetration(people[row], radii[row], parents, within, between, sums[row])
    return sums


@lru_cache(maxsize=8)
def capsule_model(skeleton: Skeleton) -> CapsuleModel:
    """Return the default capsules of pair17, op14 or body22."""
    bones = [child for _, child in skeleton.bones]
    radii = radius_per_height(skeleton)
    stand = standing_m(skeleton)
    steps, within = _bones_on_paths(skeleton), []
    for (start, end), (other_start, other) in combinations(skeleton.bones, 2):
        ends = stand[[start, end, other_start, other]]
        is_apart = float(segment_distance(*ends)) > radii[end] + radii[other]
        if is_apart and steps[np.ix_([start, end], [other_start, other])].min() >= 2:
            within.append((end, other))
    return CapsuleModel(
        skeleton=skeleton,
        parents=np.array(skeleton.parents, dtype=np.int64),
        radius_per_height=radii,
        within=np.array(within, dtype=np.int64).reshape(-1, 2),
        between=np.array([(bone, other) for bone in bones for other in bones], dtype=np.int64),
    )


def _bones_on_paths(skeleton: Skeleton) -> Array:
    """Return the number of bones on the path between any two joints (J, J)."""
    from scipy.sparse.csgraph import shortest_path  # here: planning need not wait for it

    links = np.zeros((skeleton.num_joints, skeleton.num_joints))
    links[tuple(np.transpose(skeleton.bones))] = 1.0
    return np.asarray(shortest_path(links, directed=False, unweighted=True))


def standing_m(skeleton: Skeleton) -> Array:
    """Return a person of stature 1 in the T-pose (J, 3) of pair17, op14 or body22; the nose is at the head."""
    places = np.array([t_pose(joint) for joint in (*BODY22.joint_names, "head")])
    return LAYOUTS[BODY22.name].joint_map(skeleton.name).positions(places, (*BODY22.joint_names, "nose"))
