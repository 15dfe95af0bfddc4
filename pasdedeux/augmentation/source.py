"""The source of an augmentation: the motion of its people, their bones and their floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations

import numpy as np

from pasdedeux.arrays import Array, Integers, merge_axes
from pasdedeux.augmentation.variations import check_bone_scales, leg_ratio
from pasdedeux.errors import InputError, check_positive
from pasdedeux.interaction.contacts import Contacts, find_contacts
from pasdedeux.interaction.floor import StandingSettings, find_standing, floor_under
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.interaction.objects import MovingObjects
from pasdedeux.interaction.surfaces import closest_joint_distance
from pasdedeux.kinematics import bone_directions, bone_lengths, local_rotations, place_bones
from pasdedeux.plausibility.capsules import body_height_m, capsule_model, radius_per_height
from pasdedeux.skeletons import BODY22, Skeleton

_LONGEST_JOINT_DISTANCE_M = 1e4
_ANKLES = BODY22.indices(["left_ankle", "right_ankle"])
_WAIST = BODY22.index("spine1")
_TOES = BODY22.indices(["left_toe", "right_toe"])
_WRISTS = BODY22.indices(["left_wrist", "right_wrist"])


@dataclass(frozen=True)
class Source:
    """The motion of one or more people over time, the template of every variant.

    The joints of all people make the points: person A's 22, then B's, and so on; n of them. Surfaces and the solver
    need `body22`; models may have another skeleton.

    Args:
        positions_m: World positions (frame, person, joint=22, 3), metres, Y up.
        rate_hz: Frames per second.
        name: Name of the take, used in messages.
        ground_m: Height of standing toe joints, metres, where it is known; otherwise it is found from everybody.
        objects: Objects that people handle; they move as captured, whatever the body sizes.
        skeleton: Skeleton of everybody.

    Raises:
        InputError: Wrong shape, no frames, a frame that is not finite or kilometres away, a rate that is not positive,
            objects of another number of frames.
    """

    positions_m: Array
    rate_hz: float
    name: str = "take"
    ground_m: float | None = None
    objects: MovingObjects | None = None
    skeleton: Skeleton = BODY22

    def __post_init__(self) -> None:
        """Check shape, finiteness and rate."""
        shape = self.positions_m.shape
        if len(shape) != 4 or not shape[1] or shape[2:] != (self.skeleton.num_joints, 3):
            raise InputError(
                f"{self.name}: positions have shape {shape}, expected (frames, people, {self.skeleton.num_joints}, "
                f"3): one person or more, all on {self.skeleton.name}"
            )
        if shape[0] == 0:
            raise InputError(f"{self.name}: the take has no frames, at least one is needed")
        is_bad = ~(np.abs(self.positions_m) < _LONGEST_JOINT_DISTANCE_M).all(axis=(1, 2, 3))
        if is_bad.any():
            raise InputError(
                f"{self.name}: frame {int(np.argmax(is_bad))} has a joint that is not finite or further than "
                f"{_LONGEST_JOINT_DISTANCE_M:g} m from the origin ({int(is_bad.sum())} such frames)"
            )
        check_positive(self.rate_hz, f"{self.name}: the frame rate")
        if self.objects is not None and self.objects.num_frames != self.num_frames:
            raise InputError(
                f"{self.name}: its objects have {self.objects.num_frames} frames, the people {self.num_frames}"
            )

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.positions_m)

    @property
    def num_people(self) -> int:
        """Number of people P."""
        return self.positions_m.shape[1]

    @property
    def num_points(self) -> int:
        """Joints of all people n, 22 P."""
        return self.num_people * self.skeleton.num_joints

    @cached_property
    def lengths_m(self) -> Array:
        """Length of each bone (P, 22), metres: the median over the frames, as a mapped joint may wander a little."""
        return np.asarray(np.median(bone_lengths(self.skeleton, self.positions_m), axis=0))

    @cached_property
    def directions(self) -> Array:
        """Unit direction of each bone (frame, P, 22, 3)."""
        return bone_directions(self.skeleton, self.positions_m)

    @cached_property
    def floor_m(self) -> float:
        """Height of standing toe joints, metres: one floor for everybody; carried people stand on nothing."""
        if self.ground_m is not None:
            return self.ground_m
        toes = self.positions_m[:, :, self.skeleton.indices(["left_toe", "right_toe"])]
        return floor_under(toes, find_standing(toes, rate_hz=self.rate_hz, settings=StandingSettings(away_share=1.0)))

    @cached_property
    def closest_m(self) -> float | None:
        """Smallest distance between joints of two people over the take, metres; None for one person."""
        couples = combinations(range(self.num_people), 2)
        closest = [closest_joint_distance(self.positions_m[:, both]).min() for both in map(list, couples)]
        return float(min(closest)) if closest else None

    @cached_property
    def rest_heights_m(self) -> Array:
        """Height of each joint above `floor_m` when its part of the body rests on the floor (P, 22), metres.

        An ankle's is that on a flat foot: the 10th percentile of the ankles' heights over their toes.  Other joints lie
        a radius over the floor, which the soles touch.
        """
        heights = self.radii_m - self.radii_m[:, _TOES[:1]]
        feet = self.positions_m[..., 1]
        flat = np.percentile(
            (feet[:, :, _ANKLES] - feet[:, :, _TOES]).swapaxes(0, 1).reshape(self.num_people, -1), 10.0, axis=1
        )
        heights[:, _ANKLES] = np.maximum(flat, 0.0)[:, None]
        return np.asarray(heights)

    @cached_property
    def radii_m(self) -> Array:
        """Radius of each person's bones (P, 22), named by child joints, metres; a root has the radius of a waist."""
        skeleton = self.skeleton
        radii = body_height_m(skeleton, self.lengths_m)[:, None] * radius_per_height(skeleton)
        if skeleton == BODY22:
            radii[:, skeleton.root] = radii[:, _WAIST]
        return np.asarray(radii)

    def contacts(self, stated: Sequence[UserContact] = ()) -> Contacts:
        """Find where people touch; see `find_contacts`."""
        return find_contacts(
            *(self.positions_m, self.radii_m, self.skeleton),
            rate_hz=self.rate_hz,
            stated=stated,
            own=_own_touch() if self.num_people == 1 else None,
            objects=self.objects,
        )

    def window(self, frames: slice, stated: Sequence[UserContact]) -> tuple[Source, list[UserContact]]:
        """Return some frames, and the stated contacts in them; the take itself for all frames."""
        within = (contact.within(frames.start, frames.stop) for contact in stated)
        contacts = [contact for contact in within if contact is not None]
        return (self if frames == slice(0, self.num_frames) else self.take_frames(frames)), contacts

    def take_frames(self, frames: slice, *, rate_hz: float | None = None) -> Source:
        """Return some frames with the bones, floor and feet of the whole take; thinned out, they have another rate."""
        objects = self.objects and self.objects.at(frames)
        part = replace(self, positions_m=self.positions_m[frames], objects=objects, rate_hz=rate_hz or self.rate_hz)
        # Measures of the whole take replace the part's own cached properties.
        whole = {name: getattr(self, name) for name in ("lengths_m", "floor_m", "rest_heights_m")}
        part.__dict__.update(whole)
        return part


@cache
def _own_touch() -> Integers:
    """Return the pairs of bones of one person that may touch: forearms, with bones far enough along the body."""
    return np.array([pair for pair in capsule_model(BODY22).within if set(pair) & set(_WRISTS)])


def points_of(people: Array) -> Array:
    """See people (*batch, P, 22, 3) as their points (*batch, n, 3)."""
    return merge_axes(people, -3, -1)


def complete_scales(source: Source, bone_scale: Array) -> Array:
    """Return scales (variant, P, 22) whose root entries are the leg ratios of the source's own legs."""
    skeleton = source.skeleton
    check_bone_scales(bone_scale, source.num_people, what=source.name, skeleton=skeleton)
    completed = np.array(bone_scale, dtype=np.float64)
    completed[..., skeleton.root] = leg_ratio(completed, source.lengths_m, skeleton)
    return completed


def reference_motion(source: Source, bone_scale: Array) -> Array:
    """Return r, the source's bone directions with the new lengths, root height scaled by the leg ratio.

    This is plain forward kinematics: retargeting that ignores the partner, the baseline of the quality columns and the
    motion that the smoothness term follows.  The height is scaled above the level of the standing toe joints, so that
    these stay in place: bones scale, the sole under the toe joint does not.

    Args:
        source: The template, T frames.
        bone_scale: Scales (variant, P, 22); the root's is the scale of the root height.

    Returns:
        Positions (variant, T, P, 22, 3), metres.
    """
    skeleton = source.skeleton
    root = np.repeat(source.positions_m[None, :, :, skeleton.root], len(bone_scale), axis=0)
    height = root[..., 1] - source.floor_m
    root[..., 1] = source.floor_m + height * bone_scale[:, None, :, skeleton.root]
    lengths = source.lengths_m * bone_scale
    return place_bones(skeleton, root, source.directions[None], lengths[:, None])


def scaled_lengths(source: Source, bone_scale: Array) -> Array:
    """Return the new bone lengths (variant, n), metres, of scales (variant, P, 22); 0 for the roots."""
    lengths = source.lengths_m * bone_scale
    lengths[..., source.skeleton.root] = 0.0
    return np.asarray(lengths.reshape(len(bone_scale), source.num_points))


def variant_rotations(rest_m: Array, bone_scale: Array, positions_m: Array, source_world_unitquat: Array) -> Array:
    """Return local rotations (T, P, 22, 4) that play a variant on its own scaled skeleton.

    Joints with several children (pelvis, upper spine) take the rotation that fits all of them best, so a hip or collar
    may be a little off where the girdle bends; all other bones are exact.

    Args:
        rest_m: body22 of each person in the source's rest pose (P, 22, 3), metres.
        bone_scale: Scales of the variant (P, 22).
        positions_m: The variant (T, P, 22, 3), metres.
        source_world_unitquat: World rotations of the source from its rest pose (T, P, 22, 4), whose twist is kept.
    """
    num_people = positions_m.shape[1]
    if rest_m.shape != (num_people, BODY22.num_joints, 3):
        raise InputError(f"rest poses have shape {rest_m.shape}, expected ({num_people}, {BODY22.num_joints}, 3)")
    return local_rotations(BODY22, scaled_rest(rest_m, bone_scale), positions_m, source_world_unitquat)


def scaled_rest(rest_m: Array, bone_scale: Array) -> Array:
    """Return rest poses (P, 22, 3), metres, with bones scaled by (P, 22), their roots where they were."""
    offsets = rest_m - rest_m[:, [max(parent, 0) for parent in BODY22.parents]]
    return place_bones(BODY22, rest_m[:, BODY22.root], offsets, bone_scale)
