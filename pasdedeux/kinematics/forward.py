"""Forward kinematics, bone lengths, and rotations recovered from positions."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array, Integers, plain
from pasdedeux.kinematics.alignment import best_rotation
from pasdedeux.kinematics.forward_kernel import carry_out
from pasdedeux.kinematics.rotations import (
    conjugate,
    identity_unitquat,
    multiply,
    normalise,
    rotate,
    rotmat_from_unitquat,
    swing_between,
    unitquat_from_rotmat,
)
from pasdedeux.skeletons import Skeleton


def forward_kinematics(
    skeleton: Skeleton, rest_offsets_m: Array, root_translation_m: Array, local_unitquat: Array
) -> tuple[Array, Array]:
    """Return world positions and world rotations of all joints.

    Args:
        skeleton: Tree of J joints.
        rest_offsets_m: Offset of each joint from its parent in the parent's frame, (J, 3) or (*batch, J, 3), metres.
            The root's own offset is ignored.
        root_translation_m: World position of the root, (*batch, 3), metres.
        local_unitquat: Rotation of each joint against its parent, (*batch, J, 4), x, y, z, w.

    Returns:
        World positions (*batch, J, 3) in metres and world rotations (*batch, J, 4).
    """
    local, joints = plain(local_unitquat, np.float64), skeleton.num_joints
    batch = local.shape[:-2]
    roots = np.empty((*batch, 3))
    roots[...] = root_translation_m
    offsets = np.asarray(rest_offsets_m, dtype=np.float64)
    if offsets.ndim > 2:
        offsets = np.broadcast_to(offsets, (*batch, joints, 3))
    bones = [(skeleton.parents[joint], joint) for joint in skeleton.order if joint != skeleton.root]
    positions, world = carry_out(
        np.array(bones, dtype=np.int64).reshape(-1, 2),
        skeleton.root,
        plain(offsets).reshape(-1, joints, 3),
        roots.reshape(-1, 3),
        local.reshape(-1, joints, 4),
    )
    return positions.reshape(*batch, joints, 3), world.reshape(local.shape)


def bone_lengths(skeleton: Skeleton, positions: Array) -> Array:
    """Return the length (*batch, J) of the bone that ends in each joint, metres; 0 for the root."""
    parents, children = _ends_of(skeleton)
    lengths = np.zeros(positions.shape[:-1])
    lengths[..., children] = np.linalg.norm(positions[..., children, :] - positions[..., parents, :], axis=-1)
    return lengths


def bone_directions(skeleton: Skeleton, positions: Array) -> Array:
    """Return the unit direction (*batch, J, 3) of the bone ending in each joint; 0 for the root and for empty bones."""
    parents, children = _ends_of(skeleton)
    directions = np.zeros(positions.shape)
    directions[..., children, :] = normalise(positions[..., children, :] - positions[..., parents, :])
    return directions


def place_bones(skeleton: Skeleton, root_m: Array, directions: Array, lengths_m: Array) -> Array:
    """Return positions (*batch, J, 3) from root (*batch, 3), directions (*batch, J, 3) and lengths (*batch, J) in m."""
    offsets = directions * lengths_m[..., None]
    positions = np.empty(offsets.shape)
    for joint in skeleton.order:
        parent = skeleton.parents[joint]
        if parent < 0:
            positions[..., joint, :] = root_m
        else:
            np.add(positions[..., parent, :], offsets[..., joint, :], out=positions[..., joint, :])
    return positions


def local_rotations(
    skeleton: Skeleton, rest_m: Array, positions: Array, reference_world_unitquat: Array | None = None
) -> Array:
    """Return local rotations from the rest pose to posed bones: swing by the bones, twist by a reference.

    A joint with one child gets its reference rotation, swung until the bone fits.  A joint with several children gets
    the rotation of least squares (Kabsch), held to the reference where the children do not determine it.  A joint
    without children keeps its reference relative to its parent.

    Args:
        skeleton: Tree of J joints.
        rest_m: Rest positions (J, 3), or broadcast to the posed ones, metres.
        positions: Posed positions (*batch, J, 3), metres.
        reference_world_unitquat: World rotations from the rest pose (*batch, J, 4) whose twist is kept; identity
            (swing only) when not given.

    Returns:
        Local unit quaternions (*batch, J, 4).
    """
    batch = positions.shape[:-2]
    world = identity_unitquat(*batch, skeleton.num_joints)
    if reference_world_unitquat is not None:
        world = np.array(reference_world_unitquat, dtype=np.float64)
    for joint in skeleton.order:
        children = skeleton.children(joint)
        parent = skeleton.parents[joint]
        if reference_world_unitquat is None and parent >= 0:
            world[..., joint, :] = world[..., parent, :]
        if not children:
            if reference_world_unitquat is not None and parent >= 0:
                correction = multiply(world[..., parent, :], conjugate(reference_world_unitquat[..., parent, :]))
                world[..., joint, :] = multiply(correction, reference_world_unitquat[..., joint, :])
            continue
        rest = rest_m[..., list(children), :] - rest_m[..., joint, None, :]
        posed = positions[..., list(children), :] - positions[..., joint, None, :]
        if len(children) > 1:
            world[..., joint, :] = _refine_rotation(world[..., joint, :], rest, posed)
        else:
            carried = rotate(world[..., joint, :], rest[..., 0, :])
            world[..., joint, :] = multiply(swing_between(carried, posed[..., 0, :]), world[..., joint, :])
    return local_from_world(skeleton, world)


def local_from_world(skeleton: Skeleton, world_unitquat: Array) -> Array:
    """Return local rotations (*batch, J, 4) of world rotations."""
    local = np.array(world_unitquat)
    for parent, child in skeleton.bones:
        local[..., child, :] = multiply(conjugate(world_unitquat[..., parent, :]), world_unitquat[..., child, :])
    return local


def _refine_rotation(start: Array, rest: Array, posed: Array) -> Array:
    """Fit rotations (*batch, 4) so that `rest` (k, 3) turns into `posed` (*batch, k, 3); weakly held to `start`."""
    scale = 1e-3 * np.sqrt(np.mean(rest**2, axis=(-2, -1), keepdims=True) + 1e-12)
    axes = np.broadcast_to(np.eye(3) * scale, (*posed.shape[:-2], 3, 3))
    turned = np.swapaxes(rotmat_from_unitquat(start), -1, -2) * scale
    source = np.concatenate([np.broadcast_to(rest, posed.shape), axes], axis=-2)
    target = np.concatenate([posed, turned], axis=-2)
    return unitquat_from_rotmat(best_rotation(source, target))


def _ends_of(skeleton: Skeleton) -> tuple[Integers, Integers]:
    """Return parents and children of all bones."""
    parents, children = np.array(skeleton.bones, np.int64).reshape(-1, 2).T
    return parents, children
