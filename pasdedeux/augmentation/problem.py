"""Data that `terms` builds: the quadratic problem of a take, and the targets of a batch of its variants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.augmentation.bulk_kernels import add_stencils
from pasdedeux.augmentation.clearance import Clearance
from pasdedeux.augmentation.mesh import InteractionMesh
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.weights import CONTACT_DIRECTION
from pasdedeux.interaction.contacts import Contacts
from pasdedeux.skeletons import BODY22

AXIS_GROUP = (0, 1, 0)
"""Which of the two matrices an axis x, y, z uses: horizontal 0, vertical 1."""

_GIRDLE_NAMES = (
    ("left_hip", "right_hip"),
    ("left_hip", "spine1"),
    ("right_hip", "spine1"),
    ("left_collar", "right_collar"),
    ("left_collar", "neck"),
    ("right_collar", "neck"),
    ("left_shoulder", "neck"),
    ("right_shoulder", "neck"),
)


@lru_cache(maxsize=8)
def girdle_pairs(num_people: int) -> Integers:
    """Return pairs of points (pair, 2), for all people, that keep their distance in the new skeleton."""
    girdle = np.array([BODY22.indices(pair) for pair in _GIRDLE_NAMES])
    return np.concatenate([girdle + person * BODY22.num_joints for person in range(num_people)])


@dataclass(frozen=True)
class MeshProblem:
    """Data shared by all variants of a take: the source and the quadratic form of its energy.

    Args:
        source: The template, T frames.
        mesh: Interaction mesh of the source.
        matrix: Quadratic form within a frame (group=2, T, n, n), temporal terms included.
        lag1: Coupling of each point at frames t and t+1 (group=2, T-1, n).
        lag2: Coupling at frames t and t+2 (group=2, T-2, n).
        contacts: Points that keep their distance.
        contact_weights: Their graded weights (T, M); the matrix holds all of them.
        stance: Weights of the horizontal velocity of each joint between frames (T-1, n).
        floor: Weights of the height of each point (T, n).
        smoothness: Weight of the second difference at this rate.
        anchor: Weight of each point's pull towards r or, held fixed, the source (n,).
        clearance: Bones that may not come deeper into each other.
        coupling: Matrix C (T, n, n) of the right-hand side's part of the mesh within a frame.
    """

    source: Source
    mesh: InteractionMesh
    matrix: Array
    lag1: Array
    lag2: Array
    contacts: Contacts
    contact_weights: Array
    stance: Array
    floor: Array
    smoothness: float
    anchor: Array
    clearance: Clearance
    coupling: Array

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self.source.num_frames

    @property
    def contact_direction(self) -> Array:
        """Share of each contact's weight that keeps its direction (T, M): all of it where a hand holds an object."""
        holds = np.where(self.contacts.objects >= 0, self.contacts.hand[..., 0], 0.0)
        return np.asarray(CONTACT_DIRECTION + (1.0 - CONTACT_DIRECTION) * holds)

    @cached_property
    def free_matrix(self) -> Array:
        """The quadratic form within a frame for each axis (3, T, n, n), without contacts that keep their distance."""
        free = np.zeros(self.matrix.shape[1:])
        away = (self.contact_direction - 1.0) * self.contact_weights
        add_stencils(self.contacts.points, self.contacts.shares, away, free)
        return np.asarray(self.matrix[list(AXIS_GROUP)] + free)


@dataclass(frozen=True)
class Targets:
    """Data of a batch of variants: their reference motion and the targets of their terms.

    Args:
        bone_scale: Scales (variant, P, 22).
        reference: r (variant, T, n, 3), metres.
        difference: d = q - r (variant, T, n, 3), metres.
        height: Target of the vertical part of x for the floor term (variant, T, n), metres.
        lengths_m: New bone lengths (variant, n), metres; 0 for the roots.
        girdle_m: Distances of the girdle pairs in r (variant, T, pair), metres.
        clearance_m: Least n . B x of near bones (variant, T, M), metres.
        contact_m: Vectors of the contacts as in the source (variant, T, M, 3), metres.
    """

    bone_scale: Array
    reference: Array
    difference: Array
    height: Array
    lengths_m: Array
    girdle_m: Array
    clearance_m: Array
    contact_m: Array

    @property
    def num_variants(self) -> int:
        """Number of variants."""
        return len(self.bone_scale)

    def select(self, variants: Sequence[int]) -> Targets:
        """Return the targets of some of the variants."""
        return Targets(**{name.name: getattr(self, name.name)[list(variants)] for name in fields(self)})
