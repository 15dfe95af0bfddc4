"""The surface of round cones: a smooth union, its mesh, and the weights of joints at vertices."""

from __future__ import annotations

import math

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.bodies.shape import Cones
from pasdedeux.compiled import compiled, inner_kernel

_SMOOTH_M = 0.006
"""Width of the smooth union; at equal distance from two cones, the surface is ln 2 times this farther out."""
_BLENDS = 8.0
"""Cones farther than the nearest by so many widths are ignored: exp(-8) of a width is 2 micrometres."""
_ROUNDED_M = 1e-12
"""Margin of bounds for rounding."""
NUM_VERTICES = 4000
"""Approximate number of vertices of a body, by default."""
_VERTICES_PER_SQUARE = 1.15
"""Vertices from marching cubes per area of a voxel's side, including the effect of overlapping cones."""
_MOST_VOXELS = 300
"""Largest length of a body in voxels: a joint far away must not fill the memory."""
_STEPS, _STEP_M = 2, 1e-4
"""Number of Newton steps of each vertex onto the surface, and the step of finite differences."""
_NEAR = 2.0
"""Voxels within so many sides of the surface are computed: an edge that crosses it has both ends within one side, and
the coarse values are wrong by at most 0.87 sides."""
_SOFT = 0.8
"""Width of the change from one bone to the next, in radii."""
_MAX_JOINTS, _LEAST = 4, 0.01
"""Largest number of joints of a vertex, and smallest weight of each."""


def _packed(cones: Cones) -> Array:
    """Return cones packed for kernels (cone, 15).

    Start, unit axis, length, both radii, sine and cosine of the side's slope; middle and radius of a ball around it.
    """
    along = cones.ends_m[:, 1] - cones.ends_m[:, 0]
    lengths = np.linalg.norm(along, axis=-1)
    start, end = cones.radii_m.T
    sine = np.clip((start - end) / np.maximum(lengths, 1e-9), -1.0, 1.0)
    ball = 0.5 * lengths + cones.radii_m.max(axis=-1)
    unit, cosine = along / np.maximum(lengths, 1e-9)[:, None], np.sqrt(1.0 - sine**2)
    return np.column_stack(
        [cones.ends_m[:, 0], unit, lengths, start, end, sine, cosine, cones.ends_m.mean(axis=1), ball]
    )


@inner_kernel()
def _distance(x: float, y: float, z: float, cones: Array, cone: int) -> float:
    """Return the signed distance of a point to a round cone, metres."""
    px, py, pz = x - cones[cone, 0], y - cones[cone, 1], z - cones[cone, 2]
    square = px * px + py * py + pz * pz
    along = px * cones[cone, 3] + py * cones[cone, 4] + pz * cones[cone, 5]
    off = math.sqrt(max(square - along * along, 0.0))
    length, sine, cosine = cones[cone, 6], cones[cone, 9], cones[cone, 10]
    place = along * cosine - off * sine  # along the side of the cone
    if place <= 0.0 or sine >= 1.0:
        return math.sqrt(square) - cones[cone, 7]
    if place >= cosine * length:
        return math.sqrt(off * off + (along - length) ** 2) - cones[cone, 8]
    return off * cosine + along * sine - cones[cone, 7]


@inner_kernel()
def _scan(x: float, y: float, z: float, cones: Array, width: float, near: Array, active: Integers) -> int:
    """Write the cones that count at a point, and their distances; return their number.

    The first of `active` should be a cone that counts nearby, so that most others are excluded by their balls alone.
    """
    least = _distance(x, y, z, cones, active[0])
    for cone in range(len(cones)):
        dx, dy, dz = x - cones[cone, 11], y - cones[cone, 12], z - cones[cone, 13]
        bound = least + _BLENDS * width + cones[cone, 14]  # outside its ball, a cone is too far away to count
        near[cone] = math.inf
        if bound > 0.0 and dx * dx + dy * dy + dz * dz < bound * bound:
            near[cone] = _distance(x, y, z, cones, cone)
            least = min(least, near[cone])
    count = 0
    for cone in range(len(cones)):
        if near[cone] < least + _BLENDS * width:
            active[count] = cone
            count += 1
    return count


@inner_kernel()
def _blend(count: int, active: Integers, near: Array, power: Array, is_beside: Flags, width: float) -> float:
    """Return the smooth union of the cones that count at a point; `power` (cone,) is scratch memory."""
    least = near[active[0]]
    for at in range(1, count):
        least = min(least, near[active[at]])
    if count == 1:
        return least
    every = 0.0
    for at in range(count):
        power[at] = math.exp((least - near[active[at]]) / width)
        every += power[at]
    distance, most = least, width * math.log(every) + _ROUNDED_M
    for at in range(count):
        if near[active[at]] - most > distance:  # no blend brings this one to the front
            continue
        total = 0.0
        for other in range(count):
            if is_beside[active[at], active[other]]:
                total += power[other]
        distance = min(distance, near[active[at]] - width * math.log(total))
    return distance


@compiled()
def surface_field(points: Array, cones: Array, is_beside: Flags, width: float, far: float = math.inf) -> Array:
    """Return the smooth union of round cones at points (n, 3): about the distance to its surface, negative inside.

    Cones that meet blend.  With d the distance to a cone, d_k those to cones beside it and itself, d_min the least
    of all, the field is the least of d - width ln sum_k exp((d_min - d_k) / width) over the cones.

    Args:
        points: Metres.
        cones: As `_packed` (cone, 15), metres.
        is_beside: Whether two of them blend (cone, cone).
        width: Width of the blend, metres.
        far: Points farther from the surface than this may get the value of the point before, if that is as far on the
            same side: values change by no more than the distance between two points.
    """
    values, spare = np.empty(len(points)), 0.0
    near, power, active = np.empty(len(cones)), np.empty(len(cones)), np.zeros(len(cones), dtype=np.int64)
    for row in range(len(points)):
        if spare > 0.0:
            way = points[row] - points[row - 1]
            spare -= math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        if spare > 0.0:
            values[row] = values[row - 1]
            continue
        count = _scan(points[row, 0], points[row, 1], points[row, 2], cones, width, near, active)
        values[row] = _blend(count, active, near, power, is_beside, width)
        spare = abs(values[row]) - far
    return values


@compiled()
def carry_onto(points: Array, cones: Array, is_beside: Flags, width: float, step: float) -> Array:
    """Move points (n, 3) onto the surface of `surface_field`, in place; return its unit normals there (n, 3).

    Args:
        points: Metres, near the surface.
        cones: As `_packed` (cone, 15), metres.
        is_beside: Whether two of them blend (cone, cone).
        width: Width of the blend, metres.
        step: Largest length of a Newton step, metres.
    """
    normals, slope = np.empty(points.shape), np.empty(3)
    near, power, active = np.empty(len(cones)), np.empty(len(cones)), np.zeros(len(cones), dtype=np.int64)
    for row in range(len(points)):
        point = points[row]
        for number in range(_STEPS + 1):
            count = _scan(point[0], point[1], point[2], cones, width, near, active)
            value = _blend(count, active, near, power, is_beside, width)
            size = 0.0
            for axis in range(3):
                point[axis] += _STEP_M
                for at in range(count):
                    near[active[at]] = _distance(point[0], point[1], point[2], cones, active[at])
                point[axis] -= _STEP_M
                slope[axis] = (_blend(count, active, near, power, is_beside, width) - value) / _STEP_M
                size += slope[axis] ** 2
            if number < _STEPS:
                length = max(-step, min(step, value / max(size, 0.25)))
                for axis in range(3):
                    point[axis] -= length * slope[axis]
        for axis in range(3):
            normals[row, axis] = slope[axis] / max(math.sqrt(size), 1e-9)
    return normals


@compiled()
def _weigh(
    points: Array, cones: Array, is_beside: Flags, joints: Integers, least: Array, width: Array, num_joints: int
) -> Array:
    """Return the unnormalised weights of joints (n, J) at points (n, 3); weights below `_LEAST` are 0.

    Args:
        points: Metres.
        cones: As `_packed` (cone, 15), metres.
        is_beside: Whether two of them meet (cone, cone).
        joints: Joint of each (cone,).
        least: Smallest distance; smaller ones are raised to it (cone,), metres.
        width: Width of the change to the next cone, for each nearest cone (cone,), metres.
        num_joints: J.
    """
    weights = np.zeros((len(points), num_joints))
    for row in range(len(points)):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        nearest, nearest_m = 0, math.inf
        for cone in range(len(cones)):
            dx, dy, dz = x - cones[cone, 11], y - cones[cone, 12], z - cones[cone, 13]
            bound = nearest_m + cones[cone, 14] + _ROUNDED_M  # outside its ball, a cone is farther than the nearest
            if bound > 0.0 and dx * dx + dy * dy + dz * dz < bound * bound:
                away = max(_distance(x, y, z, cones, cone), least[cone])
                if away < nearest_m:
                    nearest, nearest_m = cone, away
        for cone in range(len(cones)):
            if is_beside[nearest, cone]:
                beyond = (max(_distance(x, y, z, cones, cone), least[cone]) - nearest_m) / width[nearest]
                weights[row, joints[cone]] += math.exp(-beyond * beyond)
        for joint in range(num_joints):
            if weights[row, joint] < _LEAST:
                weights[row, joint] = 0.0
    return weights


def mesh_of(cones: Cones, num_vertices: int = NUM_VERTICES) -> tuple[Array, Integers, Array]:
    """Return vertices (n, 3), metres, faces (m, 3), outside counterclockwise, and unit normals (n, 3) of the surface.

    Marching cubes (Lewiner et al. 2003) on voxels near the surface; each vertex is then carried onto it.
    """
    from skimage.measure import marching_cubes  # here: planning does not need it

    shape = (_packed(cones), cones.is_beside, _SMOOTH_M)
    lengths, widest = np.linalg.norm(cones.ends_m[:, 1] - cones.ends_m[:, 0], axis=-1), cones.radii_m.max(axis=-1)
    area = float(np.sum(np.pi * cones.radii_m.sum(axis=-1) * lengths))
    extent = float(np.ptp(cones.ends_m.reshape(-1, 3), axis=0).max())
    voxel = max(math.sqrt(_VERTICES_PER_SQUARE * area / num_vertices), extent / _MOST_VOXELS)
    low = (cones.ends_m.min(axis=1) - widest[:, None]).min(axis=0) - 2.0 * voxel
    high = (cones.ends_m.max(axis=1) + widest[:, None]).max(axis=0) + 2.0 * voxel
    coarse = np.indices(np.ceil((high - low) / (2.0 * voxel)).astype(int)).transpose(1, 2, 3, 0) + 0.25
    far = _NEAR * voxel + _STEP_M
    blocks = surface_field(low + 2.0 * voxel * coarse.reshape(-1, 3), *shape, far).reshape(coarse.shape[:3])
    corners = np.indices((2, 2, 2)).reshape(3, -1).T
    near = (2 * np.argwhere(np.abs(blocks) < _NEAR * voxel)[:, None] + corners).reshape(-1, 3)
    eight = (blocks.shape[0], 2, blocks.shape[1], 2, blocks.shape[2], 2)
    volume = np.broadcast_to(blocks[:, None, :, None, :, None], eight).reshape(2 * np.array(blocks.shape))
    volume[tuple(near.T)] = surface_field(low + voxel * near, *shape, math.inf)
    vertices, faces, *_ = marching_cubes(volume, 0.0, gradient_direction="descent", allow_degenerate=False)
    points = low + voxel * vertices.astype(np.float64)
    normals = carry_onto(points, *shape, voxel)
    return points, faces.astype(np.int64), normals


def joint_weights(points: Array, cones: Cones, num_joints: int) -> Array:
    """Return the weights of joints (n, J) at points (n, 3): at most four joints each, summing to 1.

    The weight of a cone is a Gaussian of its distance beyond that of the nearest cone.  Only cones that meet the
    nearest count, so that an arm beside the body does not move the trunk.
    """
    least, width = -0.5 * cones.radii_m.min(axis=-1), _SOFT * cones.radii_m.mean(axis=-1)
    weights = _weigh(points, _packed(cones), cones.is_beside, cones.joints, least, width, num_joints)
    if num_joints > _MAX_JOINTS:
        fourth = num_joints - _MAX_JOINTS
        is_more = np.flatnonzero((weights > 0.0).sum(axis=1) > _MAX_JOINTS)
        kept = np.partition(weights[is_more], fourth, axis=1)[:, fourth, None]
        weights[is_more] = np.where(weights[is_more] < kept, 0.0, weights[is_more])
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
