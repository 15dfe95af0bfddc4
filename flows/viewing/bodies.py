"""Bodies as skins or capsules. Capsules are instances of two small meshes: a rod for each bone, a ball at each end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from flows.viewing.scene import People
from pasdedeux.arrays import Array
from pasdedeux.bodies import Body, body_of, standing_rest_m
from pasdedeux.evaluation.pictures import person_rgb, shade_of
from pasdedeux.interaction.contacts import find_contacts
from pasdedeux.interaction.surfaces import surface_gaps
from pasdedeux.plausibility.capsules import capsule_model, standing_m
from pasdedeux.skeletons import BODY22, PAIR17, WORKING_SKELETONS, Skeleton
from pasdedeux.spread import evenly_spread

THROUGH_M = 0.01
"""Smallest depth that is shown as penetration; less is cloth and flesh."""
TOUCH_M = 0.02
"""Largest gap that counts as touching on the timeline: where the weight of a contact begins to fall."""
MOST_MARKS = 24
"""Largest number of contacts, and of penetrations, shown in a frame."""
_NOWHERE_M = -100.0
_STICK_M = 0.015


@dataclass(frozen=True)
class Instances:
    """Positions, rotations and scales of rods (along z, radius and length 1) and balls (radius 1)."""

    rods_m: Array
    rods_wxyz: Array
    rods_scale: Array
    balls_m: Array
    balls_scale: Array


def capsules(ends_m: Array, radii_m: Array) -> Instances:
    """Return the instances of capsules with ends (n, 2, 3) and radii (n,), metres; NaN ends are invisible.

    >>> capsules(np.array([[[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]]), np.array([0.1])).rods_scale.tolist()
    [[0.10000000149011612, 0.10000000149011612, 2.0]]
    """
    is_there = np.asarray(np.isfinite(ends_m).all(axis=(1, 2)))
    ends = np.where(is_there[:, None, None], ends_m, _NOWHERE_M)
    radii = np.where(is_there, radii_m, 0.0)
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=-1)
    unit = along / np.maximum(length, 1e-9)[:, None]
    # The shortest rotation from z; from z to -z about x.
    wxyz = np.stack([1.0 + unit[:, 2], -unit[:, 1], unit[:, 0], np.zeros(len(unit))], axis=-1)
    wxyz[np.linalg.norm(wxyz, axis=-1) < 1e-6] = [0.0, 1.0, 0.0, 0.0]
    return Instances(
        rods_m=ends.mean(axis=1).astype(np.float32),
        rods_wxyz=(wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True)).astype(np.float32),
        rods_scale=np.stack([radii, radii, length], axis=-1).astype(np.float32),
        balls_m=ends.reshape(-1, 3).astype(np.float32),
        balls_scale=np.repeat(radii, 2).astype(np.float32),
    )


GAP = "surface_gap_m"
"""Name of the curve of the gap between bodies."""
_MOST_GAPS = 3000
"""Largest number of frames measured; in longer motion they are evenly spread."""


def surface_gap_curve(people: People) -> Array | None:
    """Return the smallest gap between surfaces of two people (frame,), metres; None for one person or other skeletons.

    It is negative where bodies overlap, and NaN with fewer than two people.
    """
    if people.positions_m.shape[1] < 2 or people.skeleton not in (BODY22, PAIR17):
        return None
    radii, gaps = _radii(people), np.full(len(people.positions_m), np.nan)
    step = -(-len(gaps) // _MOST_GAPS)
    for frame in range(0, len(gaps), step):
        positions = people.frame(frame)
        there = np.flatnonzero(np.isfinite(positions).all(axis=(1, 2)))
        if len(there) > 1:
            gaps[frame : frame + step] = min(
                surface_gaps(positions[list(pair)], radii[list(pair)], people.skeleton).gap_m.min()
                for pair in combinations(there.tolist(), 2)
            )
    return gaps


class Bodies:
    """People and objects over time: skins if a T-pose is known and no joint is missing, else capsules.

    Args:
        people: The people.
        ends_m: Axes of objects (frame, object, 2, 3) with their radii (object,), metres.
        is_thin: Whether bones are sticks of one width, as for 2D poses.
    """

    def __init__(
        self, people: People, ends_m: Array | None = None, radii_m: Array | None = None, *, is_thin: bool = False
    ) -> None:
        self._people, self._ends_m = people, ends_m
        self.radii_m, self.skins = _radii(people), list[Body]()
        bones: Any = people.skeleton.bones
        if people.skeleton.name in WORKING_SKELETONS and not is_thin and _are_whole(people):
            bones = []
            self.skins = [body_of(people.skeleton, *both) for both in zip(_rests(people), self.radii_m, strict=True)]
        self._bones = np.array(bones, dtype=np.int64).reshape(-1, 2)
        radii = np.full_like(self.radii_m, _STICK_M) if is_thin else self.radii_m
        self._radii = np.concatenate([radii[:, self._bones[:, 1]].ravel(), [] if radii_m is None else radii_m])

    def at(self, frame: int, pose: Array | None = None) -> Instances:
        """Return the capsules of a frame.

        Args:
            frame: The frame.
            pose: Positions (person, joint, 3), metres, in place of those of the frame.
        """
        positions = self._people.frame(frame) if pose is None else pose
        ends = positions[:, self._bones].reshape(-1, 2, 3)
        return capsules(ends if self._ends_m is None else np.concatenate([ends, self._ends_m[frame]]), self._radii)

    def turns(self, frame: int, pose: Array | None = None) -> list[tuple[Array, Array]]:
        """Return rotations (J, 4), w first, and positions (J, 3) of the joints of each skin; arguments as for `at`."""
        if not self.skins:
            return []
        positions = self._people.frame(frame) if pose is None else pose
        is_there = np.atleast_1d(np.isfinite(positions).all(axis=(1, 2)))
        rotations = []
        for body, pose_m, here in zip(self.skins, positions, is_there, strict=True):
            places = pose_m if here else np.full_like(pose_m, _NOWHERE_M)
            turns = body.turns(self._people.skeleton, places) if here else np.tile([0, 0, 0, 1.0], (len(pose_m), 1))
            rotations.append((turns[:, [3, 0, 1, 2]], places))
        return rotations

    def colours(self, grey: tuple[int, int, int] | None = None) -> Array:
        """Return the colour of each capsule (n, 3), 0 to 255, left limbs darker; `grey` replaces those of people."""
        num_people = self._people.positions_m.shape[1]
        shades = np.array([shade_of(name) for name in self._people.skeleton.joint_names])[self._bones[:, 1]]
        people = [np.outer(shades, grey or person_rgb(person)) for person in range(num_people)]
        objects = np.full((len(self._radii) - num_people * len(shades), 3), 119.0)
        return np.concatenate([*people, objects]).astype(np.uint8)


def _are_whole(people: People) -> bool:
    """Return whether each person has all joints or none in each frame."""
    is_known = np.isfinite(people.positions_m[..., 0])
    return bool((is_known.all(axis=-1) == is_known.any(axis=-1)).all())


def _whole(people: People) -> Array:
    """Return some frames (frame, person, joint, 3), metres, in which all people are complete."""
    is_whole = np.isfinite(people.positions_m).all(axis=(1, 2, 3))
    some = np.flatnonzero(is_whole)[evenly_spread(int(is_whole.sum()), 64)]
    return np.asarray(people.positions_m[some], dtype=np.float64)


def _rests(people: People) -> Array:
    """Return T-poses (person, joint, 3), metres, with median bone lengths, or those of an average body."""
    whole = _whole(people)
    if not len(whole):
        return np.broadcast_to(1.7 * standing_m(people.skeleton), people.positions_m.shape[1:])
    return np.stack([standing_rest_m(people.skeleton, person_m) for person_m in np.moveaxis(whole, 1, 0)])


def _radii(people: People) -> Array:
    """Return radii (person, joint), metres, from frames in which all people are complete, or of an average body."""
    if people.skeleton.name not in WORKING_SKELETONS:
        return np.full(people.positions_m.shape[1:3], _STICK_M)
    model, whole = capsule_model(people.skeleton), _whole(people)
    if not len(whole) or not np.ptp(whole[..., 2]):
        return np.broadcast_to(model.radii_m(1.7), people.positions_m.shape[1:3])
    return model.radii_of(whole)


def marks(skeleton: Skeleton, people_m: Array, radii_m: Array) -> tuple[Array, Array]:
    """Return points of contact (n, 3) and of penetration (m, 3), metres.

    Contacts are those of the augmentation for this frame alone; penetration is deeper than `THROUGH_M`.

    Args:
        skeleton: Their skeleton.
        people_m: A frame (person, joint, 3), metres; absent people are ignored.
        radii_m: Radii (person, joint), metres.
    """
    there = np.isfinite(people_m).all(axis=(1, 2))
    people, radii = people_m[there], radii_m[there]
    if len(people) < 2 or skeleton.name not in WORKING_SKELETONS:
        return np.empty((0, 3)), np.empty((0, 3))
    contacts = find_contacts(people[None], radii, skeleton, rate_hz=1.0)
    held = contacts.is_held[0]
    parts = contacts.shares[0, held][..., None] * people.reshape(-1, 3)[contacts.points[0, held]]
    touching = 0.5 * (parts[:, :2].sum(axis=1) - parts[:, 2:].sum(axis=1))
    deep: list[Array] = []
    for first, other in combinations(range(len(people)), 2):
        gaps = surface_gaps(people[[first, other]], radii[[first, other]], skeleton)
        a, b = np.nonzero(gaps.gap_m < -THROUGH_M)
        for person, bones, share in ((first, a, gaps.share[a, b, 0]), (other, b, gaps.share[a, b, 1])):
            child = gaps.bones[bones]
            start = people[person, np.array(skeleton.parents)[child]]
            deep.append(start + share[:, None] * (people[person, child] - start))
    middles = [0.5 * (x + y) for x, y in zip(deep[::2], deep[1::2], strict=True)]
    return touching[:MOST_MARKS], np.concatenate(middles)[:MOST_MARKS]


def marker_balls(points_m: Sequence[Array], radius_m: float) -> tuple[Any, Any]:
    """Return positions and sizes of a fixed number of balls for each set of points (n, 3); unused ones have size 0."""
    places = np.full((MOST_MARKS * len(points_m), 3), _NOWHERE_M, dtype=np.float32)
    sizes = np.zeros(len(places), dtype=np.float32)
    for number, points in enumerate(points_m):
        rows = slice(number * MOST_MARKS, number * MOST_MARKS + len(points))
        places[rows], sizes[rows] = points, radius_m
    return places, sizes
