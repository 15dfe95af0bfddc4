"""The people of a video as they are seen, and their places for given unknowns of the scene."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Integers
from pasdedeux.interaction.surfaces import Gaps, surface_gaps
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import conjugate, rotate
from pasdedeux.plausibility.capsules import body_height_m, capsule_model
from pasdedeux.reconstruction.rays import camera_turns
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.skeletons import OP14

ANKLES = np.array([leg[2] for leg in OP14.legs])
_ACROSS = np.array([1.0, 1.0, 0.0])


class Unknown(IntEnum):
    """Indices of the unknowns of the whole scene; `SeenPeople` has those of people.

    Pitch of the camera (rad), log of its height (m), log of its focal length over the assumed one, and the slope of the
    floor caused by errors of poses in depth.
    """

    PITCH = 0
    HEIGHT = 1
    LENS = 2
    TILT = 3


class By(IntEnum):
    """Indices of the derivatives in `PlacedPeople.joints`: by a frame's log distance, by log size, by log lens."""

    DISTANCE = 1
    SIZE = 2
    LENS = 3


def up_axis(pitch_rad: float) -> Array:
    """Return the direction upwards (3,) in the axes of a camera of this pitch."""
    return np.array([0.0, np.cos(pitch_rad), np.sin(pitch_rad)])


def up_axis_slope(pitch_rad: float) -> Array:
    """Return the derivative (3,) of `up_axis` by the pitch."""
    return up_axis(pitch_rad + 0.5 * np.pi)


def rays_through(plane: Array, lens_factor: float) -> Array:
    """Return unit directions (n, 3) from the camera through points (n, 2) of an image one focal length away."""
    rays = np.concatenate([plane / lens_factor, -np.ones((len(plane), 1))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def by_lens(rays: Array) -> Array:
    """Return the derivatives (n, 3) of `rays_through` by the log of the focal length."""
    return np.asarray(rays * (rays[:, :2] ** 2).sum(axis=1)[:, None] - rays * _ACROSS)


def beside(*columns: npt.ArrayLike) -> Any:
    """Return columns (n,), or numbers for all rows, side by side (n, k)."""
    return np.stack(np.broadcast_arrays(*columns), axis=-1)


@dataclass(frozen=True)
class SeenPerson:
    """A person at the initial place and size; the image is one focal length away.

    Args:
        track: Camera axes, mid-hip before the camera.
    """

    track: ReconstructedTrack

    @cached_property
    def shown(self) -> Integers:
        """Frames that are not bridged, counted from the first (n,)."""
        return np.flatnonzero(~self.track.is_bridged)

    @cached_property
    def distance_m(self) -> Array:
        """Distance of the mid-hip from the camera (frame,)."""
        return np.asarray(np.linalg.norm(self.track.root_m, axis=-1))

    @cached_property
    def plane(self) -> Array:
        """Mid-hip in the image (frame, 2)."""
        return np.asarray(self.track.root_m[:, :2] / -self.track.root_m[:, 2:])

    @cached_property
    def image(self) -> Array:
        """Joints in the image (frame, 14, 2)."""
        return np.asarray(self.track.positions_m[..., :2] / -self.track.positions_m[..., 2:])

    @cached_property
    def relative_m(self) -> Array:
        """Joints about the mid-hip (frame, 14, 3), in axes of a camera turned to it."""
        towards = -self.track.root_m / self.distance_m[:, None]
        back = conjugate(camera_turns(towards))[:, None]
        return rotate(back, self.track.positions_m - self.track.root_m[:, None])

    @cached_property
    def stature_m(self) -> float:
        """Stature, estimated from the legs."""
        return float(body_height_m(OP14, np.median(bone_lengths(OP14, self.track.positions_m), axis=0)))

    @cached_property
    def radii_m(self) -> Array:
        """Radius of the body at each joint (14,)."""
        return np.asarray(capsule_model(OP14).radii_m(np.array([self.stature_m]))[0])


@dataclass(frozen=True)
class Couple:
    """Two people who share some frames.

    Args:
        sides: The number of each person, and the shared frames (n,), counted from that person's first.
    """

    sides: tuple[tuple[int, Integers], ...]

    @property
    def people(self) -> tuple[int, int]:
        """Numbers of the two."""
        return self.sides[0][0], self.sides[1][0]

    @property
    def num_frames(self) -> int:
        """Number of shared frames."""
        return len(self.sides[0][1])


@dataclass(frozen=True)
class SeenPeople:
    """Everybody in a video, and the indices of their unknowns."""

    people: tuple[SeenPerson, ...]

    @property
    def rate_hz(self) -> float:
        """Frames per second, the same for everybody."""
        return self.people[0].track.track.rate_hz

    @property
    def sizes(self) -> Integers:
        """Indices of the logs of the sizes (person,)."""
        return len(Unknown) + np.arange(len(self.people))

    @property
    def ankles(self) -> Integers:
        """Indices of the offsets of the ankles, metres (person,)."""
        return self.sizes + len(self.people)

    @cached_property
    def starts(self) -> Integers:
        """Index of the log of the first distance of each person; last, the number of unknowns (person + 1,)."""
        counts = [len(person.distance_m) for person in self.people]
        return np.asarray(self.ankles[-1] + 1 + np.concatenate([[0], np.cumsum(counts)]))

    @cached_property
    def mean_distance_m(self) -> float:
        """Mean initial distance over all people and frames."""
        return float(np.mean(np.concatenate([person.distance_m for person in self.people])))

    @cached_property
    def couples(self) -> list[Couple]:
        """All pairs of people that share a frame."""
        couples = []
        for numbers in combinations(range(len(self.people)), 2):
            tracks = [self.people[number].track.track for number in numbers]
            frames = np.intersect1d(tracks[0].frames, tracks[1].frames)
            if len(frames):
                at = [frames - track.first_frame for track in tracks]
                couples.append(Couple(tuple(zip(numbers, at, strict=True))))
        return couples

    def distances(self, number: int) -> Integers:
        """Return the indices of the logs of a person's distances (frame,)."""
        return np.arange(self.starts[number], self.starts[number + 1])


@dataclass(frozen=True)
class PlacedPeople:
    """Everybody in the places given by the unknowns.

    Args:
        seen: The people.
        x: Unknowns (n,).
        side: 1.0 if the floor is below the camera, -1.0 if above it, as before a stage.
    """

    seen: SeenPeople
    x: Array
    side: float

    @property
    def height_m(self) -> float:
        """Height of the camera over the floor; negative below it."""
        return self.side * float(np.exp(self.x[Unknown.HEIGHT]))

    @cached_property
    def sizes(self) -> Array:
        """Size of each person over the initial one (person,)."""
        return np.exp(self.x[self.seen.sizes])

    @cached_property
    def joints(self) -> list[Array]:
        """Joints and mid-hip of each person and their derivatives (4, frame, 15, 3), camera axes, metres.

        The derivatives are by the frame's distance, by the log of the size and by the log of the focal length.
        """
        return [self._joints(number) for number in range(len(self.seen.people))]

    def _joints(self, number: int) -> Array:
        person, x = self.seen.people[number], self.x
        ray = rays_through(person.plane, float(np.exp(x[Unknown.LENS])))
        root = (person.distance_m * np.exp(x[self.seen.distances(number)]))[:, None] * ray
        relative = rotate(camera_turns(-ray)[:, None], person.relative_m) * self.sizes[number]
        # A longer lens turns rays, and people with them, towards the axis.
        root_by_lens = np.linalg.norm(root, axis=1, keepdims=True) * by_lens(ray)
        turned = (relative[..., :2] * ray[:, None, :2]).sum(axis=-1) * ray[:, 2:]
        # Every joint stays on its own ray, whatever the lens.
        depth = root[:, 2:] + relative[..., 2]
        depths = np.stack(np.broadcast_arrays(depth, root[:, 2:], relative[..., 2], root_by_lens[:, 2:] + turned))
        image = -person.image * np.exp(-x[Unknown.LENS])
        joints = depths[..., None] * np.concatenate([image, np.ones((*depth.shape, 1))], axis=-1)
        joints[By.LENS] -= joints[0] * _ACROSS
        roots = np.stack([root, root, np.zeros(root.shape), root_by_lens])
        return np.concatenate([joints, roots[:, :, None]], axis=2)

    @cached_property
    def gaps(self) -> dict[tuple[int, int], Gaps]:
        """Gaps between the bodies of two people in shared frames, by their numbers."""
        return {
            couple.people: surface_gaps(
                np.stack([self.joints[number][0, at, :-1] for number, at in couple.sides], axis=1),
                self.radii_m(couple),
                OP14,
            )
            for couple in self.seen.couples
        }

    def radii_m(self, couple: Couple) -> Array:
        """Return the radii (person=2, 14) of two people at their sizes."""
        return np.stack([self.seen.people[number].radii_m * self.sizes[number] for number in couple.people])
