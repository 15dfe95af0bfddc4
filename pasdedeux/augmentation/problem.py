"""What `terms` builds: the quadratic problem of a take, and the targets of a batch of its variants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.clearance import Clearance
from pasdedeux.augmentation.contacts import added_by_girth
from pasdedeux.augmentation.mesh import InteractionMesh
from pasdedeux.augmentation.settings import AugmentationSettings
from pasdedeux.augmentation.source import NUM_POINTS, Source
from pasdedeux.augmentation.spans import Spans
from pasdedeux.augmentation.weights import Weights
from pasdedeux.skeletons import BODY22

__all__ = ["AXIS_GROUP", "GIRDLE_PAIRS", "Problem", "Targets", "contact_matrix"]

Array = npt.NDArray[np.float64]

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
GIRDLE_PAIRS: npt.NDArray[np.int64] = np.array(
    [[joint + offset for joint in BODY22.indices(pair)] for offset in (0, BODY22.num_joints) for pair in _GIRDLE_NAMES]
)
"""Pairs of points (pair, 2) whose distance stays that of the new skeleton, both people."""


@dataclass(frozen=True)
class Problem:
    """What all variants of a take share: the source and the quadratic form of its energy.

    Args:
        source: The template, T frames.
        settings: Settings used.
        mesh: Interaction mesh of the source.
        matrix: Quadratic form within a frame (group=2, T, 44, 44), temporal terms included.
        lag1: Coupling of each point at frames t and t+1 (group=2, T-1, 44).
        lag2: Coupling at frames t and t+2 (group=2, T-2, 44).
        contact: Graded contact weights (T, 22 of A, 22 of B); the matrix holds all of them.
        directed: The part of them that keeps the vector (T, 22, 22).
        spans: The rest, which keeps the distance.
        stance: Weights of the horizontal velocity of each foot joint between frames (T-1, 44); 0 for other joints.
        floor: Weights of the height of each point (T, 44).
        smoothness: Weight of the second difference at this rate.
        anchor: Weight of each point's pull towards r or, held fixed, the source (44,).
        clearance: Bones that may not come deeper into each other.
        coupling: Matrix C (T, 44, 44) of the right-hand side's part C d within a frame.
    """

    source: Source
    settings: AugmentationSettings
    mesh: InteractionMesh
    matrix: Array
    lag1: Array
    lag2: Array
    contact: Array
    directed: Array
    spans: Spans
    stance: Array
    floor: Array
    smoothness: float
    anchor: Array
    clearance: Clearance
    coupling: Array

    @property
    def weights(self) -> Weights:
        """Weights of the terms."""
        return self.settings.weights

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self.source.num_frames

    @cached_property
    def axis_matrix(self) -> Array:
        """The quadratic form within a frame for each axis (3, T, 44, 44), without contacts that keep their distance."""
        return np.asarray(self.matrix[list(AXIS_GROUP)] - contact_matrix(self.contact - self.directed))

    @cached_property
    def touching(self) -> tuple[npt.NDArray[np.intp], ...]:
        """Frame, joint of A and joint of B of every contact whose vector weighs anything."""
        return np.nonzero(self.directed)

    @cached_property
    def contact_shift(self) -> Array | None:
        """What the new girth adds to the vector of each of `touching` (m, 3), metres, along it; None as in the source.

        So surfaces, not joints, stay as far apart as they were.
        """
        if self.settings.girth == (1.0, 1.0):
            return None
        frame, first, second = self.touching
        added = added_by_girth(self.source, self.settings.girth)
        vectors = self.source.positions_m[frame, 0, first] - self.source.positions_m[frame, 1, second]
        units = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
        return np.asarray(units * added[first, second][:, None])

    @cached_property
    def push(self) -> Array | None:
        """The right-hand side's part that the new girth brings (3, T, 44), the same for all variants."""
        if self.contact_shift is None:
            return None
        frame, first, second = self.touching
        pull = self.directed[frame, first, second][:, None] * self.contact_shift
        push = np.zeros((self.num_frames, NUM_POINTS, 3))
        np.add.at(push, (frame, first), pull)
        np.add.at(push, (frame, second + BODY22.num_joints), -pull)
        return np.ascontiguousarray(np.moveaxis(push, -1, 0))


@dataclass(frozen=True)
class Targets:
    """What belongs to a batch of variants: their reference motion and the targets of their terms.

    Args:
        bone_scale: Scales (variant, 2, 22).
        reference: r (variant, T, 44, 3), metres.
        difference: d = q - r (variant, T, 44, 3), metres.
        height: Target of the vertical part of x for the floor term (variant, T, 44), metres.
        lengths_m: New bone lengths (variant, 44), metres; 0 for the roots.
        girdle_m: Distances of the girdle pairs in r (variant, T, pair), metres.
        clearance_m: Least n . B x of near bones (variant, T, M), metres.
    """

    bone_scale: Array
    reference: Array
    difference: Array
    height: Array
    lengths_m: Array
    girdle_m: Array
    clearance_m: Array

    @property
    def num_variants(self) -> int:
        """Number of variants."""
        return len(self.bone_scale)

    def select(self, variants: Sequence[int]) -> Targets:
        """Return the targets of some of the variants."""
        return Targets(**{name.name: getattr(self, name.name)[list(variants)] for name in fields(self)})


def contact_matrix(contact: Array) -> Array:
    """Quadratic form (T, 44, 44) of sum w_ij |x_i - x_j|^2 over pairs of A and B."""
    half = BODY22.num_joints
    matrix = np.zeros((len(contact), NUM_POINTS, NUM_POINTS))
    matrix[:, :half, half:] = -contact
    matrix[:, half:, :half] = -np.swapaxes(contact, -1, -2)
    matrix[:, range(half), range(half)] = contact.sum(axis=2)
    matrix[:, range(half, NUM_POINTS), range(half, NUM_POINTS)] = contact.sum(axis=1)
    return matrix
