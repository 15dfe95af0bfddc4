"""A body: a mesh in the rest pose of a skeleton, and its skin, which follows the joints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.bodies.shape import cones_of
from pasdedeux.bodies.surface import NUM_VERTICES, joint_weights, mesh_of
from pasdedeux.kinematics import Motion, bone_lengths, forward_kinematics, local_rotations, place_bones
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat
from pasdedeux.plausibility.capsules import standing_m
from pasdedeux.skeletons import Skeleton


@dataclass(frozen=True)
class Body:
    """A watertight mesh in a rest pose; each vertex moves with up to four joints.

    Args:
        rest_m: Joints in the rest pose (J, 3), metres.
        vertices_m: Vertices in the rest pose (n, 3), metres.
        faces: Vertices of each triangle (m, 3), counterclockwise from outside.
        normals: Unit normals of the surface at the vertices (n, 3).
        weights: How much of each vertex moves with each joint (n, J); rows sum to 1.
    """

    rest_m: Array
    vertices_m: Array
    faces: Integers
    normals: Array
    weights: Array

    def posed(self, world_unitquat: Array, positions_m: Array) -> Array:
        """Return the vertices (n, 3), metres, in a pose: linear blend skinning.

        Args:
            world_unitquat: Rotation of each joint from the rest pose (J, 4).
            positions_m: Positions of the joints (J, 3), metres.
        """
        turns = rotmat_from_unitquat(world_unitquat)
        shifts = positions_m - np.einsum("jab,jb->ja", turns, self.rest_m)
        blended = self._skin @ np.concatenate([turns, shifts[..., None]], axis=-1).reshape(-1, 12)
        matrices = blended.reshape(-1, 3, 4)
        return np.einsum("nab,nb->na", matrices[..., :3], self.vertices_m) + matrices[..., 3]

    def turns(self, skeleton: Skeleton, positions_m: Array) -> Array:
        """Return rotations from the rest pose (*batch, J, 4) that fit positions (*batch, J, 3), metres."""
        local = local_rotations(skeleton, self.rest_m, positions_m)
        offsets = self.rest_m - self.rest_m[[max(parent, 0) for parent in skeleton.parents]]
        return forward_kinematics(skeleton, offsets, positions_m[..., skeleton.root, :], local)[1]

    def strongest(self) -> tuple[Integers, Array]:
        """Return the joints of each vertex (n, 4), strongest first, and their weights (n, 4); rows sum to 1."""
        joints = np.argsort(-self.weights, axis=1, kind="stable")[:, :4]
        weights = np.take_along_axis(self.weights, joints, axis=1)
        return np.where(weights > 0.0, joints, 0), weights

    @cached_property
    def _skin(self) -> Any:
        from scipy.sparse import csr_array

        return csr_array(self.weights)


def body_of(skeleton: Skeleton, rest_m: Array, radii_m: Array, *, num_vertices: int = NUM_VERTICES) -> Body:
    """Return the body of a working skeleton in its rest pose.

    Its surface lies within 1 cm of the capsules, except head, hands, heels and flanks, which lie outside.

    Args:
        skeleton: pair17, op14 or body22; for joints with other names, only the capsules are covered.
        rest_m: Positions of the joints in the rest pose (J, 3), metres.
        radii_m: Radius of the capsule around the bone that ends in each joint (J,), metres; 0 for none.
        num_vertices: Approximate number of vertices.
    """
    cones = cones_of(skeleton, np.asarray(rest_m, dtype=np.float64), radii_m)
    vertices, faces, normals = mesh_of(cones, num_vertices)
    return Body(rest_m, vertices, faces, normals, joint_weights(vertices, cones, skeleton.num_joints))


def standing_rest_m(skeleton: Skeleton, positions_m: Array) -> Array:
    """Return a T-pose (J, 3), metres, with the median bone lengths of positions (frame, J, 3), root at 0.

    Args:
        skeleton: pair17, op14 or body22.
        positions_m: Metres.
    """
    stand = standing_m(skeleton)
    parents = [max(parent, 0) for parent in skeleton.parents]
    directions = normalise(stand - stand[parents], fallback=np.array([0.0, 1.0, 0.0]))
    lengths = np.median(bone_lengths(skeleton, positions_m), axis=0)
    return place_bones(skeleton, np.zeros(3), directions, lengths)


def standing_motion(skeleton: Skeleton, positions_m: Array, rate_hz: float) -> Motion:
    """Return a motion of positions (frame, J, 3) of pair17, op14 or body22 whose rest pose is a T-pose.

    Bones have their median lengths; rotations are swings, and the best fit where a joint has several children.
    """
    rest = standing_rest_m(skeleton, positions_m)
    return Motion(
        skeleton=skeleton,
        rest_offsets_m=rest - rest[[max(parent, 0) for parent in skeleton.parents]],
        root_translation_m=positions_m[:, skeleton.root],
        local_unitquat=local_rotations(skeleton, rest, positions_m),
        rate_hz=rate_hz,
    )
