"""Contacts of people: points of two bones whose surfaces meet.

A body is capsules round its bones, an object is capsules; people touch where the surface of one meets that of the
other, anywhere along a bone.  A contact is a point of a bone of one person and one of another's, of one's own or of an
object: a bone is named by its child joint, the point by the share of the bone from its parent joint.  It is found where
two surfaces are nearest, or stated; its weight fades with the distance of the surfaces and nothing switches.  This is
what "in contact" means everywhere.

Not all that is near is a contact.  On bodies of other sizes distances to neighbouring bones cannot all stay what they
were, and would pull a hand off the place where it lies.  So a hand or foot touches the bone nearest to it, and other
bones touch where they are closest to each other, not at a joint beyond which the next bone is closer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from string import ascii_uppercase
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from numba import njit
from pydantic import Field, field_validator, model_validator
from scipy.ndimage import gaussian_filter1d

from pasdedeux.errors import InputError
from pasdedeux.interaction.objects import FLOOR, MovingObjects
from pasdedeux.kinematics.rotation_kernels import closest_on_segments, dot, length, row_of, subtract
from pasdedeux.settings import Settings
from pasdedeux.skeletons import BODY22, Skeleton

__all__ = [
    "TOUCH_M",
    "Contacts",
    "Gaps",
    "Letter",
    "UserContact",
    "check_contacts",
    "closest_joint_distance",
    "fade",
    "find_contacts",
    "nearest_on_bones",
    "packer",
    "parents_of",
    "standing_out",
    "stated_contacts",
    "stencil_vectors",
    "surface_gaps",
]

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

Letter = Annotated[str, Field(pattern="^[A-Z]$")]
"""A person of a take: A is the first."""

TOUCH_M = (0.02, 0.08)
"""Distance of surfaces: in contact up to the first (cloth, flesh, capsules that taper less than limbs do), not beyond
the second."""
_HAND_M = 0.08
"""How far a hand reaches beyond the wrist, in which the working skeletons end: middle of the palm."""
_HAND_SHARE = 0.5
"""From here on along a forearm or shank a point becomes one of the hand or foot."""
_NEXT_M = 0.015
"""A hand or foot touches the nearest bone; the weight of another falls by 1/e for every such length it is farther."""
_BESIDE_M = 0.005
"""Where a next bone is closer by this, a pair of bones weighs 1/e."""
_AT_END = 0.2
"""Within this share of a bone from its end, a pair that is closest there gives way to the next bone."""
_SMOOTHING_S = 0.1
"""Standard deviation of the averaging of weights and points over time."""
_SMALLEST_WEIGHT = 1e-2
"""Contacts that weigh less are left out."""


def closest_joint_distance(pair_m: Array) -> Array:
    """Return the distance (*batch,) of the closest joints of A and B of pairs (*batch, person=2, joint, 3), metres.

    NaN joints are left out.
    """
    difference = pair_m[..., 0, :, None, :] - pair_m[..., 1, None, :, :]
    return np.asarray(np.nanmin(np.linalg.norm(difference, axis=-1), axis=(-2, -1)))


def fade(value: Array, full: float, none: float) -> Array:
    """Return 1 up to `full`, 0 from `none` on, and a smooth step (3t^2 - 2t^3) between."""
    t = np.clip((none - value) / (none - full), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


@dataclass(frozen=True)
class Gaps:
    """How far the surfaces of two people are apart, bone by bone; a bone is named by its child joint.

    Args:
        gap_m: (*batch, bone of A, bone of B), metres; negative where they pass through each other.
        share: Where on each of the two bones they are closest (*batch, bone of A, bone of B, 2): 0 at the parent
            joint, 1 at the child.
        bones: Child joints of the bones (bone,).
    """

    gap_m: Array
    share: Array
    bones: Indices

    @property
    def closest_m(self) -> Array:
        """The gap (*batch,) of the two people."""
        return np.asarray(self.gap_m.min(axis=(-2, -1)))


def surface_gaps(pair_m: Array, radii_m: Array, skeleton: Skeleton) -> Gaps:
    """Return the distances of the surfaces of two people.

    Args:
        pair_m: Pairs (*batch, person=2, joint, 3), metres; NaN gives NaN.
        radii_m: Radius of the bone that ends in each joint (person=2, joint), metres.
        skeleton: Whose joints.
    """
    bones, half = np.array([child for _, child in skeleton.bones]), skeleton.num_joints
    flat = np.ascontiguousarray(pair_m, dtype=np.float64).reshape(-1, 2 * half, 3)
    pairs = np.stack(np.broadcast_arrays(bones[:, None], bones + half), axis=-1).reshape(-1, 2)
    share, gap = nearest_on_bones(flat, pairs, parents_of(skeleton, 2), np.ravel(np.asarray(radii_m, dtype=np.float64)))
    shape = (*np.shape(pair_m)[:-3], len(bones), len(bones))
    return Gaps(gap.reshape(shape), share.reshape(*shape, 2), bones)


def parents_of(skeleton: Skeleton, num_people: int) -> Indices:
    """Return the parent of each joint of all people (P J,), joints numbered through; a root is its own."""
    parents = np.maximum(np.array(skeleton.parents), skeleton.root * (np.array(skeleton.parents) < 0))
    return np.concatenate([parents + person * skeleton.num_joints for person in range(num_people)])


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_on_bones(points: Array, pairs: Indices, parents: Indices, radii: Array) -> tuple[Array, Array]:
    """Return where on their bones (T, pair, 2) the nearest points are, 0 at the parent, and the gap of the surfaces.

    Args:
        points: Joints (T, n, 3), metres.
        pairs: Child joints of two bones (pair, 2).
        parents: Parent of each joint (n,).
        radii: Radius of the bone that ends in each joint (n,), metres.
    """
    share, gap = np.empty((len(points), len(pairs), 2)), np.empty((len(points), len(pairs)))
    for at in range(len(points)):
        for row in range(len(pairs)):
            one, other = pairs[row, 0], pairs[row, 1]
            a, b = row_of(points[at], parents[one]), row_of(points[at], parents[other])
            u, v, g = subtract(row_of(points[at], one), a), subtract(row_of(points[at], other), b), subtract(a, b)
            # Parallel bones: half way is as good as any, and does not jump.
            s, t = closest_on_segments(dot(u, u), dot(v, v), dot(u, v), dot(u, g), dot(v, g), 0.5)
            apart = (g[0] + s * u[0] - t * v[0], g[1] + s * u[1] - t * v[1], g[2] + s * u[2] - t * v[2])
            share[at, row, 0], share[at, row, 1] = s, t
            gap[at, row] = length(apart) - radii[one] - radii[other]
    return share, gap


def standing_out(bones: Indices, share: Array, gap_m: Array, skeleton: Skeleton) -> Array:
    """Return how much two bones meet by themselves (T, pair), from 0 to 1.

    Where they are closest at a joint and the next bone from there is closer, it is that bone which meets the other.

    Args:
        bones: Child joints of two bones (pair, 2), joints of all people numbered through.
        share: Where on them the nearest points are (T, pair, 2).
        gap_m: Gaps of the surfaces (T, pair), metres.
        skeleton: Whose joints.
    """
    weight = np.ones(gap_m.shape)
    for side in (0, 1):
        for end in (0, 1):
            closest = gap_m[:, _beside(bones, side, end, skeleton)].min(axis=-1)
            at_end = fade(np.abs(share[..., side] - end), 0.0, _AT_END)
            weight *= 1.0 + at_end * np.expm1((closest - gap_m) / _BESIDE_M)
    return weight


def _beside(bones: Indices, side: int, end: int, skeleton: Skeleton) -> Indices:
    """Return which pairs have a next bone, at the beginning (0) or end of the pair's, and the pair itself (pair, k)."""
    joints, places = skeleton.num_joints, {pair: place for place, pair in enumerate(map(tuple, bones.tolist()))}
    meeting = [[edge[1] for edge in skeleton.bones if joint in edge] for joint in range(joints)]
    found = []
    for pair in places:
        person, child = divmod(pair[side], joints)
        joint = child if end else skeleton.parents[child]
        others = (person * joints + bone for bone in (meeting[joint] if person >= 0 else [child]))
        found.append(
            [places[other] for other in ((pair[0], b) if side else (b, pair[1]) for b in others) if other in places]
        )
    most = max(map(len, found), default=1)
    filled = [[*rows, *[place] * (most - len(rows))] for place, rows in enumerate(found)]
    return np.array(filled, dtype=np.int64).reshape(-1, most)


class UserContact(Settings):
    """A contact that is stated, in place of what is found between the two bones."""

    joint_a: str = Field(description="Joint of the first person in which the bone ends, by its name in body22")
    joint_b: str | None = Field(None, description="Joint of the second person in which the bone ends")
    object: str | None = Field(
        None,
        min_length=1,
        description="What is touched in place of a second person: an object of the take by its name, or floor",
    )
    share_a: float = Field(1.0, ge=0, le=1, description="Where on the first bone: 0 at its beginning, 1 at the joint")
    share_b: float = Field(1.0, ge=0, le=1, description="The same on the second bone, or from an object's start to end")
    person_a: Letter = Field("A", description="The first person")
    person_b: Letter = Field("B", description="The second person, who may be the first")
    start_frame: int = Field(0, ge=0, description="First frame")
    stop_frame: int = Field(description="Frame after the last")
    weight: float = Field(1.0, ge=0, le=10, description="1 in contact, 0 not in contact whatever the distance")

    @field_validator("joint_a", "joint_b")
    @classmethod
    def _is_a_joint(cls, joint: str | None) -> str | None:
        if joint is not None and joint not in BODY22.joint_names:
            raise ValueError(f"joint '{joint}' is not in body22: {', '.join(BODY22.joint_names)}")
        return joint

    @model_validator(mode="after")
    def _has_frames(self) -> UserContact:
        if (self.joint_b is None) == (self.object is None):
            raise ValueError("joint_b or object is needed, and not both")
        if self.joint_a == self.joint_b and self.person_a == self.person_b:
            raise ValueError(f"{self.person_a}'s {self.joint_a} touches nothing but itself")
        if self.stop_frame <= self.start_frame:
            raise ValueError(f"frames {self.start_frame} to {self.stop_frame} are none")
        return self

    @property
    def is_of_floor(self) -> bool:
        """Whether the floor is touched."""
        return self.object == FLOOR

    @property
    def persons(self) -> tuple[int, ...]:
        """Numbers of the people, one where something is touched."""
        letters = self.person_a if self.object else self.person_a + self.person_b
        return tuple(map(ascii_uppercase.index, letters))

    def bones(self, skeleton: Skeleton, objects: MovingObjects | None) -> tuple[int, int]:
        """Return the child joints of the two bones, the joints of all people numbered through; -1, ... for objects."""
        first = self.persons[0] * skeleton.num_joints + skeleton.index(self.joint_a)
        if self.joint_b is not None:
            return first, self.persons[1] * skeleton.num_joints + skeleton.index(self.joint_b)
        assert objects is not None
        assert self.object is not None
        return first, -1 - objects.names.index(self.object)

    def within(self, start: int, stop: int) -> UserContact | None:
        """Return the part of it in frames `start` to `stop`, counted from `start`; None where there is none."""
        first, last = max(self.start_frame, start), min(self.stop_frame, stop)
        changed = {"start_frame": first - start, "stop_frame": last - start}
        return self.model_copy(update=changed) if first < last else None


def check_contacts(
    stated: Sequence[UserContact], *, name: str, num_frames: int, num_people: int, objects: MovingObjects | None
) -> None:
    """Refuse contacts of frames, people or objects that a take does not have.

    Raises:
        InputError: With the contact in words, and what is there.
    """
    things = (*(objects.names if objects else ()), FLOOR)
    for contact in stated:
        other = contact.object or f"{contact.person_b}'s {contact.joint_b}"
        said = f"{name}: contact of {contact.person_a}'s {contact.joint_a} and {other}"
        if max(contact.persons) >= num_people:
            raise InputError(f"{said}, but the people are {', '.join(ascii_uppercase[:num_people])}")
        if contact.object and contact.object not in things:
            raise InputError(f"{said}, but what there is to be touched is {', '.join(things)}")
        if contact.stop_frame > num_frames:
            raise InputError(
                f"{said} over frames {contact.start_frame} to {contact.stop_frame}; allowed are frames within 0 to "
                f"{num_frames}"
            )


@dataclass(frozen=True)
class Contacts:
    """The contacts of each frame, up to M of them, filled up with contacts of no weight.

    Args:
        points: Ends of the first bone and of the second (T, M, 4), the joints of all people numbered through.
        shares: What the ends contribute to the vector from the second point to the first (T, M, 4).
        weights: From 0 to 1, or as stated (T, M).
        hand: How much the two points are of a hand or foot (T, M, 2), from 0 to 1.
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
        """Which of them count as contacts where there must be a yes or no (T, M): at half weight and more."""
        return np.asarray(self.weights >= 0.5)

    @property
    def num_hands(self) -> Indices:
        """How many of the two points are of a hand or foot (T, M), where there must be a number."""
        return np.asarray((self.hand >= 0.5).sum(axis=-1))

    def bones(self) -> Indices:
        """Return the child joints of the two bones (T, M, 2), numbered through; -1, -2, ... for objects."""
        bones = np.array(self.points[..., 1::2])
        bones[..., 1] = np.where(self.objects >= 0, -1 - self.objects, bones[..., 1])
        return bones

    def vectors(self, points_m: Array) -> Array:
        """Return the vectors from second to first point (*batch, T, M, 3) of joints (*batch, T, P J, 3), metres."""
        return np.asarray(stencil_vectors(self.points, self.shares, points_m) - self.places_m)

    def spread(self, pulls: Array, num_points: int) -> Array:
        """Return what pulls at the contacts' vectors (T, M, 3) pull at the joints (T, P J, 3)."""
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
    touch_m: tuple[float, float] = TOUCH_M,
    stated: Sequence[UserContact] = (),
    own: Indices | None = None,
    objects: MovingObjects | None = None,
) -> Contacts:
    """Find where people touch each other, and objects; weights and points are averaged over a moment.

    Args:
        people_m: Motion of everybody (T, person, joint, 3), metres.
        radii_m: Radius of the bone that ends in each joint (person, joint), metres.
        skeleton: Whose joints.
        rate_hz: Frames per second.
        touch_m: Distance of the surfaces: full weight up to the first, none from the second on; hands reach beyond
            their wrists.
        stated: Contacts that replace what is found between two bones, and all that is found of a hand or foot; names
            are those of the skeleton.
        own: Bones with which people may touch themselves (n, 2), by child joint, the hand's first; there a hand does
            not reach beyond its wrist, or arms that hang would touch the thighs.
        objects: What else may be touched, by every bone.
    """
    (frames, num_people), joints = people_m.shape[:2], skeleton.num_joints
    children = np.array([child for _, child in skeleton.bones])
    each = np.stack(np.broadcast_arrays(children[:, None], children), axis=-1).reshape(-1, 2)
    bones = np.concatenate(
        [each + joints * np.array(both) for both in combinations(range(num_people), 2)]
        + [own + joints * person for person in range(num_people) if own is not None]
        + [np.zeros((0, 2), np.int64)]
    )
    points = np.ascontiguousarray(people_m, dtype=np.float64).reshape(frames, -1, 3)
    radii, parents = np.ravel(np.asarray(radii_m, dtype=np.float64)), parents_of(skeleton, num_people)
    if objects is not None:
        # Their ends come last, the first object's at the very end: -1 is its bone.
        things = -1 - np.arange(len(objects.names))
        everyone = (children + joints * np.arange(num_people)[:, None]).ravel()
        bones = np.concatenate([bones, np.stack(np.meshgrid(everyone, things, indexing="ij"), -1).reshape(-1, 2)])
        starts, ends = objects.ends_m[:, ::-1, 0], objects.ends_m[:, ::-1, 1]
        points = np.concatenate([points, starts, ends], axis=1)
        parents = np.concatenate([parents, *[len(parents) + np.arange(len(things))] * 2])
        radii = np.concatenate([radii, np.zeros(len(things)), objects.radii_m[::-1]])
    share, gap = nearest_on_bones(points, bones, parents, radii)
    hand, is_own = _hands(bones, share, skeleton), bones[:, 0] // joints == bones[:, 1] // joints
    away = gap - _HAND_M * (hand * _is_hand(skeleton)[bones % joints]).sum(axis=-1) * ~is_own
    weights = fade(away, *touch_m) * standing_out(bones, share, gap, skeleton)
    for rows, sides in _of_each_hand(bones, is_own, skeleton):
        of_hand = hand[:, rows, sides]
        nearest = (away[:, rows] + (1.0 - of_hand)).min(axis=1, keepdims=True)
        weights[:, rows] *= 1.0 + of_hand * np.expm1(-np.maximum(away[:, rows] - nearest, 0.0) / _NEXT_M)
    places = {frozenset(pair): place for place, pair in enumerate(bones.tolist())}
    told = []
    for contact in (one for one in stated if not one.is_of_floor):
        both, shares = contact.bones(skeleton, objects), np.array([contact.share_a, contact.share_b])
        when = slice(contact.start_frame, contact.stop_frame)
        if frozenset(both) in places:
            weights[when, places[frozenset(both)]] = 0.0
        if contact.weight > 0:
            for bone, lies in zip(both, _hands(np.array(both), shares, skeleton), strict=True):
                weights[when] *= 1.0 - lies * (hand[when] * (bones == bone)).sum(axis=-1)
        weight = np.zeros(frames)
        weight[when] = contact.weight
        told.append((both, shares, weight))
    is_near = weights.max(axis=0, initial=0.0) > _SMALLEST_WEIGHT
    bones, share, weights = bones[is_near], share[:, is_near], weights[:, is_near]
    if frames > 1 and weights.size:
        sigma = _SMOOTHING_S * rate_hz
        moved = gaussian_filter1d(weights[..., None] * share, sigma, axis=0, mode="nearest", truncate=3.0)
        weights = gaussian_filter1d(weights, sigma, axis=0, mode="nearest", truncate=3.0)
        share = np.clip(moved / np.maximum(weights, 1e-9)[..., None], 0.0, 1.0)
    if told:
        weight = np.stack([weight for *_, weight in told], axis=-1)
        if frames > 1:
            weight = gaussian_filter1d(weight, _SMOOTHING_S * rate_hz, axis=0, mode="nearest", truncate=3.0)
        weights = np.concatenate([weights, weight], axis=1)
        at = np.array([shares for _, shares, _ in told])
        share = np.concatenate([share, np.broadcast_to(at, (frames, *at.shape))], axis=1)
        bones = np.concatenate([bones, np.array([ends for ends, *_ in told])])
    frame, column = np.nonzero(weights > _SMALLEST_WEIGHT)
    return _pack(frame, frames, bones[column], share[frame, column], weights[frame, column], skeleton, objects)


def stated_contacts(
    stated: Sequence[UserContact], num_frames: int, skeleton: Skeleton, objects: MovingObjects | None = None
) -> Contacts:
    """Return contacts just as they are stated, without those found, without averaging and without the floor's."""
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
    # A point of an object is given, so nobody's joints contribute to it.
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
    """Yield for each bone that ends in a hand or foot the pairs (pair, 2) it is in, and as which of the two.

    What is touched of other people, of oneself and of objects comes apart: a hand in a hand may lie on a box, too.
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
    """Return how much points (T, n, 2) at a share of bones (n, 2) are of a hand or foot."""
    is_end = np.array([name.endswith(("wrist", "ankle")) for name in skeleton.joint_names])
    is_foot = np.array([name.endswith("toe") for name in skeleton.joint_names])
    joints = bones % skeleton.num_joints
    return np.where(is_end[joints], fade(-share, -1.0, -_HAND_SHARE), is_foot[joints]) * (bones >= 0)


def packer(frame: npt.NDArray[np.intp], num_frames: int) -> Callable[[npt.NDArray[Any]], npt.NDArray[Any]]:
    """Return what lays values (n, ...) of these frames (n,), which rise, out by frame (num_frames, M, ...).

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
    flat = np.ascontiguousarray(points_m).reshape(-1, *points_m.shape[-3:])
    return np.asarray(_sum_up(flat, points, shares).reshape(*batch, *points.shape[:2], 3))


@njit(cache=True, nogil=True)
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
