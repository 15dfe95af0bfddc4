"""The energy of a variant, after Ho, Komura and Tai 2010: quadratic but for girdle and clearance.

With x = p - r (r: plain forward kinematics of the new skeleton) and d = q - r (q: the source), the energy of a take is

    E = w_L |L x - L_c d|^2                     Laplacian; own edges follow the new skeleton, cross edges the source
      + w_S |D2 x|^2                            smoothness of the difference, not of the motion (which would flatten it)
      + w_R |x|^2                               reference
      + sum w_C (k |z - v|^2 + (1 - k) (|z| - |v|)^2)   contacts keep the distance of their surfaces; see `contacts`
      + sum w_F |D1 (x - d)|^2                  what stands moves as the source does, wherever it stands (horizontal);
                                                w_F rises with the square of how long it does, or it would creep
      + sum w_H |y - h|^2                       joints near the floor keep their height above it
      + sum w_K max(0, c - n . B x)^2           near bones come no deeper into each other; see `clearance`
      + w_B sum |(b2 / l2) - (b1 / l1)|^2       spine bends as r's does; b: change of a bone's vector, l: source length
      + sum w_G (|p_i - p_j| - |r_i - r_j|)^2   girdle and hips stay rigid
    subject to exact bone lengths.

All weights come from the source alone, so one matrix serves every variant of a take, and the right-hand side is linear
in d.  Weights are per frame at 30 Hz; temporal terms are rescaled so that they mean the same at any rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation import weights
from pasdedeux.augmentation.bulk_kernels import add_stencils
from pasdedeux.augmentation.clearance import clearance_limits, find_clearance
from pasdedeux.augmentation.mesh import build_mesh
from pasdedeux.augmentation.problem import MeshProblem, Targets, girdle_pairs
from pasdedeux.augmentation.settings import AugmentationSettings
from pasdedeux.augmentation.source import Source, complete_scales, points_of, reference_motion, scaled_lengths
from pasdedeux.augmentation.support import floor_weights, lasting_s, stance_weights
from pasdedeux.augmentation.variations import persons_of
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.skeletons import BODY22

_MESH_SMOOTHING_S = 0.25
"""Averaging of the mesh over time; the published method takes each frame alone, and motion jumps where edges appear."""
_WEIGHTS_RATE_HZ = 30.0

_STANCE_S = (1.0, 5.0)
"""Stances are stiffer the longer they last, between these two durations."""

_SPINE = ("spine1", "spine2", "spine3", "neck", "head")
_SHORTEST_SPINE_BONE_M = 0.03


def build_problem(
    source: Source, settings: AugmentationSettings | None = None, *, user_contacts: Sequence[UserContact] = ()
) -> MeshProblem:
    """Find the terms of a take and add them up to its quadratic form."""
    mesh = build_mesh(source, smoothing_s=_MESH_SMOOTHING_S)
    frames = source.num_frames
    rate = source.rate_hz / _WEIGHTS_RATE_HZ

    contacts = source.contacts(user_contacts)
    contact_weights = weights.of_contacts(contacts)
    standing = stance_weights(source, user_contacts).reshape(frames, -1)
    stands = np.sqrt(standing[1:] * standing[:-1])
    stiff = np.clip(lasting_s(stands, source.rate_hz), *_STANCE_S) / _STANCE_S[0]
    stance = weights.STANCE * rate**2 * stiff**2 * stands
    floor = weights.FLOOR * floor_weights(source, user_contacts).reshape(frames, -1)
    count = source.num_points
    anchor = np.full(count, weights.REFERENCE)
    if settings is not None and settings.fixed_person is not None:
        anchor.reshape(source.num_people, -1)[persons_of(settings.fixed_person, source.num_people)] += weights.FIXED
    smoothness = weights.SMOOTHNESS * rate**4

    laplacian = mesh.laplacian
    shared = weights.LAPLACIAN * np.swapaxes(laplacian, -1, -2) @ laplacian
    add_stencils(contacts.points, contacts.shares, contact_weights, shared)
    bends = bending_rows(source)
    shared += weights.BENDING * bends.T @ bends
    shared[:, range(count), range(count)] += anchor
    matrix = np.stack([shared, shared])
    diagonal, lag1, lag2 = temporal_couplings(stance, smoothness, frames)
    diagonal[1] += floor
    matrix[..., range(count), range(count)] += diagonal
    return MeshProblem(
        source=source,
        mesh=mesh,
        matrix=matrix,
        lag1=lag1,
        lag2=lag2,
        contacts=contacts,
        contact_weights=contact_weights,
        stance=stance,
        floor=floor,
        smoothness=smoothness,
        anchor=anchor,
        clearance=find_clearance(source, weights.CLEARANCE, weights.CLEARANCE_SELF),
        coupling=weights.LAPLACIAN * np.swapaxes(laplacian, -1, -2) @ mesh.cross_laplacian,
    )


def temporal_couplings(stance: Array, smoothness: float, frames: int) -> tuple[Array, Array, Array]:
    """Return what terms between frames add to the quadratic form.

    That is its diagonal (group=2, T, n) and its couplings between frames one (group, T-1, n) and two (group, T-2, n)
    apart.

    Args:
        stance: Weights of each point's horizontal velocity between frames (T-1, n).
        smoothness: Weight of the second difference.
        frames: T.
    """
    count = stance.shape[-1]
    lag1 = np.zeros((2, max(frames - 1, 0), count))
    lag2 = np.zeros((2, max(frames - 2, 0), count))
    diagonal = np.zeros((2, frames, count))
    if frames > 1:
        diagonal[0, 1:] += stance
        diagonal[0, :-1] += stance
        lag1[0] -= stance
    if frames > 2:
        diagonal[:, :-2] += smoothness
        diagonal[:, 1:-1] += 4.0 * smoothness
        diagonal[:, 2:] += smoothness
        lag1[:, :-1] -= 2.0 * smoothness
        lag1[:, 1:] -= 2.0 * smoothness
        lag2 += smoothness
    return diagonal, lag1, lag2


def build_targets(problem: MeshProblem, bone_scale: Array) -> Targets:
    """Return the reference motion and the targets of a batch of variants (variant, P, 22)."""
    source = problem.source
    bone_scale = complete_scales(source, bone_scale)
    reference = reference_motion(source, bone_scale)
    points = points_of(reference)
    difference = points_of(source.positions_m)[None] - points
    pairs = points[:, :, girdle_pairs(source.num_people)]
    vectors = problem.contacts.vectors(points_of(source.positions_m))
    return Targets(
        bone_scale=bone_scale,
        reference=points,
        difference=difference,
        height=_floor_heights(source, bone_scale, reference),
        lengths_m=scaled_lengths(source, bone_scale),
        girdle_m=np.linalg.norm(pairs[..., 0, :] - pairs[..., 1, :], axis=-1),
        clearance_m=clearance_limits(problem.clearance, points),
        contact_m=np.repeat(vectors[None], len(bone_scale), axis=0),
    )


def right_hand_side(problem: MeshProblem, targets: Targets) -> Array:
    """Return b (variant, T, n, axis=3) of the normal equations K x = b of the quadratic terms."""
    rhs = np.matmul(problem.coupling, targets.difference)
    rhs += (problem.anchor - weights.REFERENCE)[:, None] * targets.difference
    if problem.num_frames > 1:
        change = problem.stance[..., None] * np.diff(targets.difference, axis=1)
        change[..., 1] = 0.0
        rhs[:, 1:] += change
        rhs[:, :-1] -= change
    rhs[..., 1] += problem.floor * targets.height
    return np.asarray(rhs)


def _floor_heights(source: Source, bone_scale: Array, reference: Array) -> Array:
    """Height targets less r's height (variant, T, n): the source's, but a foot's higher end rises with its length."""
    heights = np.repeat(source.positions_m[None, ..., 1], len(bone_scale), axis=0)
    for ankle, toe in (("left_ankle", "left_toe"), ("right_ankle", "right_toe")):
        a, t = BODY22.index(ankle), BODY22.index(toe)
        rise = source.positions_m[:, :, a, 1] - source.positions_m[:, :, t, 1]
        added = (bone_scale[:, None, :, t] - 1.0) * rise
        heights[..., a] += np.where(rise > 0, added, 0.0)
        heights[..., t] -= np.where(rise < 0, added, 0.0)
    difference = heights - reference[..., 1]
    return np.asarray(difference.reshape(*difference.shape[:2], -1))


def bending_rows(source: Source) -> Array:
    """Return the difference of vectors over lengths of neighbouring spine bones, as rows (m, n)."""
    rows = []
    for person in range(source.num_people):
        for first, second in pairwise(BODY22.indices(_SPINE)):
            row = np.zeros(source.num_points)
            for joint, sign in ((second, 1.0), (first, -1.0)):
                length = max(source.lengths_m[person, joint], _SHORTEST_SPINE_BONE_M)
                start = person * BODY22.num_joints
                row[start + joint] += sign / length
                row[start + BODY22.parents[joint]] -= sign / length
            rows.append(row)
    return np.array(rows)
