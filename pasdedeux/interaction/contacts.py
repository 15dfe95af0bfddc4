"""Contacts of people: points of two bones whose surfaces meet.

A body is capsules round its bones, an object is capsules; people touch where the surface of one meets that of the
other, anywhere along a bone.  A contact is a point of a bone of one person and one of another's, of one's own or of an
object: a bone is named by its child joint, the point by the share of the bone from its parent joint.  It is found where
two surfaces are nearest, or stated; its weight fades with the distance of the surfaces and nothing switches.  This is
what "in contact" means everywhere.

Not every near point is a contact.  On bodies of other sizes, distances to several neighbouring bones cannot all be
kept; they would pull a hand off its place.  So a hand or foot touches only the bone nearest to it.  Other bones touch
at their closest points, except at a joint beyond which the next bone is closer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes, plain
from pasdedeux.compiled import compiled
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.interaction.objects import MovingObjects
from pasdedeux.interaction.surfaces import fade, nearest_on_bones, parents_of, standing_out
from pasdedeux.skeletons import Skeleton

Indices = npt.NDArray[np.int64]

_TOUCH_M = (0.02, 0.08)
"""Distance of surfaces: in contact up to the first (for cloth, flesh, and limbs that taper more than capsules), not
beyond the second."""
_HAND_M = 0.08
"""Distance from the wrist, where the working skeletons end, to the middle of the palm."""
_HAND_SHARE = 0.5
"""Share of a forearm or shank from which on a point counts increasingly as one of the hand or foot."""
_NEXT_M = 0.015
"""A hand or foot touches the nearest bone; others weigh less by a factor of e for each such length beyond."""
_SMOOTHING_S = 0.1
"""Standard deviation of the averaging of weights and points over time."""
_SMALLEST_WEIGHT = 1e-2
"""Contacts that weigh less are dropped."""


@dataclass(frozen=True)
class Contacts:
    """The contacts of each frame, padded to M with contacts of weight 0.

    Args:
        points: Ends of the first bone and of the second (T, M, 4), the joints of all people numbered through.
        shares: Factors of the ends in the vector from the second point to the first (T, M, 4).
        weights: From 0 to 1, or as stated (T, M).
        hand: Degree to which the two points belong to a hand or foot (T, M, 2), from 0 to 1.
        objects: The object that the second point is of (T, M), -1 where it is of a person.
        places_m: Where that point of the object is (T, M, 3), metres; zeros elsewhere.
    """

    points: Indices
    shares: Array
    weights: Array
    hand: Array
    objects: Indices
    places_m: Array

    @property
    def is_held(self) -> npt.NDArray[np.bool_]:
        """Which candidates count as contacts (T, M): those with a weight of at least one half."""
        return np.asarray(self.weights >= 0.5)

    @property
    def num_hands(self) -> Indices:
        """Number of points of each contact on a hand or foot (T, M)."""
        return np.asarray((self.hand >= 0.5).sum(axis=-1))

    def bones(self) -> Indices:
        """Return the child joints of the two bones (T, M, 2), numbered through; -1, -2, ... for objects."""
        bones = np.array(self.points[..., 1::2])
        bones[..., 1] = np.where(self.objects >= 0, -1 - self.objects, bones[..., 1])
        return bones

    def vectors(self, points_m: Array) -> Array:
        """Return the vectors from second to first point (*batch, T, M, 3) of joints (*batch, T, P J, 3), metres."""
        return np.asarray(stencil_vectors(self.points, self.shares, points_m) - self.places_m)

    def held_distances(self, points_m: Array) -> Array:
        """Return the distances of the two points of all held contacts (contact,), metres, frame after frame."""
        return np.asarray(np.linalg.norm(self.vectors(points_m)[self.is_held], axis=-1))

    def ends(self, points_m: Array) -> Array:
        """Return the first and the second point (T, M, 2, 3) of joints (T, P J, 3), metres."""
        first = np.asarray(stencil_vectors(self.points[..., :2], self.shares[..., :2], points_m))
        return np.stack([first, first - self.vectors(points_m)], axis=-2)

    def spread(self, pulls: Array, num_points: int) -> Array:
        """Return the forces on joints (T, P J, 3) that forces on the contacts' vectors (T, M, 3) amount to."""
        spread = np.zeros((len(pulls), num_points, 3))
        frames = np.broadcast_to(np.arange(len(pulls))[:, None, None], self.points.shape)
        np.add.at(spread, (frames, self.points), self.shares[..., None] * pulls[:, :, None])
        return spread


def find_contacts(
    people_m: Array,
    radii_m: Array,
    skeleton: Skeleton,
    *,
    rate_hz: float,
    stated: Sequence[UserContact] = (),
    own: Indices | None = None,
    objects: MovingObjects | None = None,
) -> Contacts:
    """Find where people touch each other, and objects; weights and points are averaged over a moment.

    Args:
        people_m: Motion of all people (T, person, joint, 3), metres.
        radii_m: Radius of the bone that ends in each joint (person, joint), metres.
        skeleton: Whose joints.
        rate_hz: Frames per second.
        stated: Contacts that replace those detected between two bones, and all detected ones of a hand or foot; names
            are those of the skeleton.
        own: Bones with which people may touch themselves (n, 2), by child joint, the hand's first; there a hand does
            not reach beyond its wrist, or arms that hang would touch the thighs.
        objects: Objects, which every bone may touch.
    """
    bones, share, gap = _all_gaps(people_m, radii_m, skeleton, own, objects)
    hand, weights = _found(bones, share, gap, skeleton)
    known = [contact for contact in stated if not contact.is_of_floor]
    for contact in known:
        _clear(weights, hand, bones, contact, skeleton, objects)
    is_near = weights.max(axis=0, initial=0.0) > _SMALLEST_WEIGHT
    bones, share, weights = bones[is_near], share[:, is_near], weights[:, is_near]
    frames, sigma = len(people_m), _SMOOTHING_S * rate_hz
    if frames > 1 and weights.size:
        moved = averaged(weights[..., None] * share, sigma)
        weights = averaged(weights, sigma)
        share = np.clip(moved / np.maximum(weights, 1e-9)[..., None], 0.0, 1.0)
    if known:
        constant = np.zeros((frames, len(known)))
        for column, contact in enumerate(known):
            constant[contact.start_frame : contact.stop_frame, column] = contact.weight
        weights = np.concatenate([weights, averaged(constant, sigma)], axis=1)
        at = np.array([[contact.share_a, contact.share_b] for contact in known])
        share = np.concatenate([share, np.broadcast_to(at, (frames, *at.shape))], axis=1)
        bones = np.concatenate([bones, np.array([contact.bones(skeleton, objects) for contact in known])])
    frame, pair = np.nonzero(weights > _SMALLEST_WEIGHT)
    return _pack(frame, frames, bones[pair], share[frame, pair], weights[frame, pair], skeleton, objects)


def _all_gaps(
    people_m: Array, radii_m: Array, skeleton: Skeleton, own: Indices | None, objects: MovingObjects | None
) -> tuple[Indices, Array, Array]:
    """Return all bones that may touch (n, 2), where they are nearest (T, n, 2), and their gap (T, n), metres."""
    num_people, joints = people_m.shape[1], skeleton.num_joints
    children = np.array([child for _, child in skeleton.bones])
    each = np.stack(np.broadcast_arrays(children[:, None], children), axis=-1).reshape(-1, 2)
    bones = np.concatenate(
        [each + joints * np.array(both) for both in combinations(range(num_people), 2)]
        + [own + joints * person for person in range(num_people) if own is not None]
        + [np.zeros((0, 2), np.int64)]
    )
    points = merge_axes(np.ascontiguousarray(people_m, dtype=np.float64), 1, -1)
    radii, parents = np.ravel(np.asarray(radii_m, dtype=np.float64)), parents_of(skeleton, num_people)
    if objects is not None:
        # The ends of objects come last, the first object's at the very end, so that -1 is its bone.
        things = -1 - np.arange(len(objects.names))
        everyone = (children + joints * np.arange(num_people)[:, None]).ravel()
        bones = np.concatenate([bones, np.stack(np.meshgrid(everyone, things, indexing="ij"), -1).reshape(-1, 2)])
        starts, ends = objects.ends_m[:, ::-1, 0], objects.ends_m[:, ::-1, 1]
        points = np.concatenate([points, starts, ends], axis=1)
        parents = np.concatenate([parents, *[len(parents) + np.arange(len(things))] * 2])
        radii = np.concatenate([radii, np.zeros(len(things)), objects.radii_m[::-1]])
    return (bones, *nearest_on_bones(points, bones, parents, radii))


def _found(bones: Indices, share: Array, gap_m: Array, skeleton: Skeleton) -> tuple[Array, Array]:
    """Return the degree to which points belong to a hand or foot (T, n, 2), and the weights of contact (T, n)."""
    joints = skeleton.num_joints
    hand, is_own = _hands(bones, share, skeleton), bones[:, 0] // joints == bones[:, 1] // joints
    away = gap_m - _HAND_M * (hand * _is_hand(skeleton)[bones % joints]).sum(axis=-1) * ~is_own
    weights = fade(away, *_TOUCH_M) * standing_out(bones, share, gap_m, skeleton)
    for rows, sides in _of_each_hand(bones, is_own, skeleton):
        of_hand = hand[:, rows, sides]
        nearest = (away[:, rows] + (1.0 - of_hand)).min(axis=1, keepdims=True)
        weights[:, rows] *= 1.0 + of_hand * np.expm1(-np.maximum(away[:, rows] - nearest, 0.0) / _NEXT_M)
    return hand, weights


def _clear(
    weights: Array,
    hand: Array,
    bones: Indices,
    contact: UserContact,
    skeleton: Skeleton,
    objects: MovingObjects | None,
) -> None:
    """Clear the found weights (T, n) that a stated contact replaces: its two bones, and all of its hand or foot."""
    both, when = contact.bones(skeleton, objects), slice(contact.start_frame, contact.stop_frame)
    weights[when, (np.sort(bones, axis=1) == np.sort(both)).all(axis=1)] = 0.0
    if contact.weight > 0:
        shares = np.array([contact.share_a, contact.share_b])
        for bone, lies in zip(both, _hands(np.array(both), shares, skeleton), strict=True):
            weights[when] *= 1.0 - lies * (hand[when] * (bones == bone)).sum(axis=-1)


def averaged(values: Array, sigma: float) -> Array:
    """Return values (T, ...) averaged by a Gaussian of `sigma` frames; a single frame is returned unchanged."""
    if len(values) < 2:
        return values
    from scipy.ndimage import gaussian_filter1d  # here: planning need not wait for it

    return np.asarray(gaussian_filter1d(values, sigma, axis=0, mode="nearest", truncate=3.0))


def stated_contacts(
    stated: Sequence[UserContact], num_frames: int, skeleton: Skeleton, objects: MovingObjects | None = None
) -> Contacts:
    """Return contacts exactly as stated, without found ones, averaging, and contacts with the floor."""
    held = [contact for contact in stated if not contact.is_of_floor]
    rows = [(frame, contact) for contact in held for frame in range(contact.start_frame, contact.stop_frame)]
    rows.sort(key=lambda row: row[0])
    bones = np.array([contact.bones(skeleton, objects) for _, contact in rows], dtype=np.int64).reshape(-1, 2)
    share = np.array([[c.share_a, c.share_b] for _, c in rows]).reshape(-1, 2)
    frame = np.array([frame for frame, _ in rows], dtype=np.intp)
    return _pack(frame, num_frames, bones, share, np.array([c.weight for _, c in rows]), skeleton, objects)


def _pack(
    frame: npt.NDArray[np.intp],
    num_frames: int,
    bones: Indices,
    share: Array,
    weights: Array,
    skeleton: Skeleton,
    objects: MovingObjects | None,
) -> Contacts:
    """Lay contacts of these frames (n,) out by frame: bones and places on them (n, 2), weights (n,)."""
    packed, s, t = packer(frame, num_frames), *share.T
    parents = parents_of(skeleton, 1 + int(bones.max(initial=0)) // skeleton.num_joints)
    thing = np.where(bones[:, 1] < 0, -1 - bones[:, 1], -1)
    places_m = np.zeros((len(bones), 3))
    if objects is not None:
        starts, ends = (objects.ends_m[frame, thing, end] for end in (0, 1))
        places_m = np.where((thing >= 0)[:, None], starts + t[:, None] * (ends - starts), 0.0)
    # A point of an object is given, so no joint contributes to it.
    second = np.where((thing >= 0)[:, None], 0.0, np.stack([t - 1.0, -t], axis=-1))
    people = np.where(bones < 0, bones[:, :1], bones)
    return Contacts(
        points=packed(np.stack([parents[people], people], axis=-1).reshape(-1, 4)),
        shares=packed(np.concatenate([np.stack([1.0 - s, s], axis=-1), second], axis=-1)),
        weights=packed(weights),
        hand=packed(_hands(bones, share, skeleton)),
        objects=packed(thing + 1) - 1,
        places_m=packed(places_m),
    )


def _of_each_hand(
    bones: Indices, is_own: npt.NDArray[np.bool_], skeleton: Skeleton
) -> Iterator[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]]:
    """Yield the pairs (pair, 2) of each bone that ends in a hand or foot, and its place in them (0 or 1).

    Contacts with other people, oneself and objects are separate: a hand in a hand may also lie on a box.
    """
    is_end = np.array([name.endswith(("wrist", "ankle", "toe")) for name in skeleton.joint_names])
    touched = np.where(bones[:, 1] < 0, 2, is_own)
    for bone in np.unique(bones[is_end[bones % skeleton.num_joints] & (bones >= 0)]):
        for kind in range(3):
            rows, sides = np.nonzero((bones == bone) & (touched == kind)[:, None])
            if len(rows):
                yield rows, sides


def _is_hand(skeleton: Skeleton) -> npt.NDArray[np.bool_]:
    return np.array([name.endswith("wrist") for name in skeleton.joint_names])


def _hands(bones: Indices, share: Array, skeleton: Skeleton) -> Array:
    """Return the degree to which points (T, n, 2) at a share of bones (n, 2) belong to a hand or foot."""
    is_end = np.array([name.endswith(("wrist", "ankle")) for name in skeleton.joint_names])
    is_foot = np.array([name.endswith("toe") for name in skeleton.joint_names])
    joints = bones % skeleton.num_joints
    return np.where(is_end[joints], fade(-share, -1.0, -_HAND_SHARE), is_foot[joints]) * (bones >= 0)


def packer(frame: npt.NDArray[np.intp], num_frames: int) -> Callable[[npt.NDArray[Any]], npt.NDArray[Any]]:
    """Return a function that arranges values (n, ...) by frame (num_frames, M, ...); their frames (n,) must not fall.

    M is the greatest number in a frame; the others are filled up with zeros.
    """
    counts = np.bincount(frame, minlength=num_frames)
    place = np.arange(len(frame)) - (np.cumsum(counts) - counts)[frame]

    def packed(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        laid = np.zeros((num_frames, int(counts.max(initial=0)), *values.shape[1:]), values.dtype)
        laid[frame, place] = values
        return laid

    return packed


def stencil_vectors(points: Indices, shares: Array, points_m: Array) -> Array:
    """Return the sums of shares of points (*batch, T, M, 3), metres.

    Args:
        points: Joints of each sum (T, M, k).
        shares: What each contributes (T, M, k).
        points_m: Joints (*batch, T, n, 3), metres.
    """
    batch = points_m.shape[:-3]
    flat = plain(points_m, np.float64).reshape(-1, *points_m.shape[-3:])
    return np.asarray(_sum_up(flat, plain(points), plain(shares)).reshape(*batch, *points.shape[:2], 3))


@compiled()
def _sum_up(points_m: Array, points: Indices, shares: Array) -> Array:
    count, frames, num_pairs = len(points_m), points.shape[0], points.shape[1]
    sums = np.zeros((count, frames, num_pairs, 3))
    for v in range(count):
        for t in range(frames):
            for e in range(num_pairs):
                for k in range(points.shape[2]):
                    for axis in range(3):
                        sums[v, t, e, axis] += shares[t, e, k] * points_m[v, t, points[t, e, k], axis]
    return sums
