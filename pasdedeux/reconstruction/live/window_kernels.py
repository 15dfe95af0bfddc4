"""The fit of whole tracks, in one kernel for a window of few frames: the same energy and steps as `fit_bones`.

A bone couples only with bones that carry it.  So unknowns are ordered by bones, leaves first, each in all frames of the
window.  Eliminating a bone then changes only rows of the bones that carry it.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array, Flags
from pasdedeux.compiled import compiled, inner_kernel
from pasdedeux.fitting.bones import directions_of, place_along_bones, tangents_of, topology_of, turn_bones
from pasdedeux.fitting.levenberg import FIRST_DAMPING, LARGEST_DAMPING, SMALLEST_CURVATURE, SMALLEST_DAMPING
from pasdedeux.fitting.observed_pose import DEPTH_HOLD, HALF_WEIGHT
from pasdedeux.skeletons import OP14

_JOINTS, _ROOT = OP14.num_joints, OP14.root
_SHAPE = topology_of((OP14,))
_PARENTS, _ORDER, _ROOTS, _STARTS = _SHAPE.parents, _SHAPE.order, _SHAPE.roots, _SHAPE.starts
_NUM_CARRIED = _SHAPE.carries.sum(axis=1)
_DEPTH = (_SHAPE.carries.sum(axis=0) - 1.0).astype(np.int64)
"""Number of bones between a joint's own and the root.  The root has 3 unknowns, a bone 2."""
_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")
_NUM_COLUMNS = 2 * int(_DEPTH.max()) + 3


@compiled()
def fit_window(
    held: Array,
    guess: Array,
    image: Array,
    distance: Array,
    weights: Array,
    noise: Array,
    is_kept: Flags,
    bones: Array,
    firmness: Array,
    smoothness: Array,
    lengths: Array,
    max_iterations: int,
    tolerance: float,
) -> Array:
    """Return the fitted poses (T, 14, 3) of a window that follows held poses.

    Args:
        held: Poses before the window, which stay (H, 14, 3).
        guess: First guess (T, 14, 3), metres.
        image: Joints (T, 14, 2), metres at the depth of z = 0.
        distance: Distance (T,) of z = 0 from a pinhole.
        weights: (T, 14); 0 where not seen.
        noise: Standard deviation of the image of each joint (14,).
        is_kept: Frames (T,) in which joints far from the image have less weight.
        bones: Vectors to which bones are drawn (T, 14, 3).
        firmness: Their weights (T,).
        smoothness: Weight of each second difference (H + T - 2,).
        lengths: Bone lengths (14,).
        max_iterations: Largest number of accepted or refused steps.
        tolerance: Stop when a step lowers the energy by less than this share.
    """
    frames, first = guess.shape[0], held.shape[0]
    targets, over = np.zeros(guess.shape), np.zeros(weights.shape)
    for t in range(frames):
        for joint in range(_JOINTS):
            targets[t, joint, 2] = guess[t, joint, 2]
            if weights[t, joint] > 0.0:
                squared = 0.0
                for axis in range(2):
                    targets[t, joint, axis] = image[t, joint, axis] * (1.0 - guess[t, joint, 2] / distance[t])
                    squared += (targets[t, joint, axis] - guess[t, joint, axis]) ** 2
                over[t, joint] = weights[t, joint] / noise[joint] ** 2
                if is_kept[t]:
                    over[t, joint] /= 1.0 + squared / (HALF_WEIGHT * noise[joint]) ** 2
    coupling = np.zeros((frames, frames))
    for t in range(-first, frames - 2):
        for i in range(max(-t, 0), 3):
            for j in range(max(-t, 0), 3):
                coupling[t + i, t + j] += smoothness[first + t] * _difference(i) * _difference(j)
    roots, directions = np.empty((frames, 1, 3)), directions_of(guess, _PARENTS)
    for t in range(frames):
        for axis in range(3):
            roots[t, 0, axis] = guess[t, _ROOT, axis]
    poses = place_along_bones(roots, directions, lengths, _PARENTS, _ORDER, _ROOTS)
    energy, pull = _pull_of(held, poses, targets, over, bones, firmness, smoothness)
    damping = FIRST_DAMPING
    for _ in range(max_iterations):
        tangents = tangents_of(directions)
        basis = np.zeros((frames, _JOINTS, 3, 3))
        for t in range(frames):
            for joint in range(_JOINTS):
                for axis in range(3):
                    for i in range(2):
                        basis[t, joint, axis, i] = lengths[joint] * tangents[t, joint, axis, i]
                    if joint == _ROOT:
                        for i in range(3):
                            basis[t, joint, axis, i] = 1.0 if i == axis else 0.0
        rows = _curvature(basis, directions, lengths, pull, over, firmness, coupling, damping)
        step = np.empty((frames, _STARTS[-1]))
        moved_energy = np.inf
        if _solve(rows, basis, pull, step):
            moved_roots, moved_directions = roots.copy(), turn_bones(directions, tangents, step, _PARENTS, _STARTS)
            for t in range(frames):
                for axis in range(3):
                    moved_roots[t, 0, axis] += step[t, _STARTS[_ROOT] + axis]
            moved = place_along_bones(moved_roots, moved_directions, lengths, _PARENTS, _ORDER, _ROOTS)
            moved_energy, moved_pull = _pull_of(held, moved, targets, over, bones, firmness, smoothness)
        if moved_energy <= energy:
            is_converged = energy - moved_energy <= tolerance * energy
            roots, directions, poses = moved_roots, moved_directions, moved
            energy, pull = moved_energy, moved_pull
            damping = max(0.1 * damping, SMALLEST_DAMPING)
        else:
            damping *= 10.0
            is_converged = damping > LARGEST_DAMPING
        if is_converged:
            break
    return poses


@compiled()
def guess_pose(image: Array, distance: float, depth: Array, bones: Array) -> Array:
    """Return a pose (14, 3) with these depths of bones (14,), the mid-hip at z = 0.

    x and y follow the image (14, 2), or the bones (14, 3) where a joint is not seen.
    """
    pose = np.zeros((_JOINTS, 3))
    for joint in _ORDER[1:]:
        pose[joint, 2] = pose[_PARENTS[joint], 2] + depth[joint]
    middle = 0.5 * (pose[_LEFT_HIP, 2] + pose[_RIGHT_HIP, 2])
    for joint in _ORDER:
        pose[joint, 2] -= middle
        for axis in range(2):
            if np.isfinite(image[joint, axis]):
                pose[joint, axis] = image[joint, axis] * (1.0 - pose[joint, 2] / distance)
            elif joint != _ROOT:
                pose[joint, axis] = pose[_PARENTS[joint], axis] + bones[joint, axis]
    return pose


@inner_kernel()
def _difference(at: int) -> float:
    """Return the factor of one of three frames in their second difference."""
    return -2.0 if at == 1 else 1.0


@inner_kernel()
def _pull_of(
    held: Array, poses: Array, targets: Array, over: Array, bones: Array, firmness: Array, smoothness: Array
) -> tuple[float, Array]:
    """Return the energy, and half its gradient summed over the joints that each bone carries (T, 14, 3)."""
    frames, first = poses.shape[0], held.shape[0]
    energy, pull = 0.0, np.empty(targets.shape)
    for t in range(frames):
        for joint in range(_JOINTS):
            for axis in range(3):
                off = poses[t, joint, axis] - targets[t, joint, axis]
                pull[t, joint, axis] = (over[t, joint] if axis < 2 else DEPTH_HOLD) * off
                energy += pull[t, joint, axis] * off
    for t in range(-first, frames - 2):
        for joint in range(_JOINTS):
            for axis in range(3):
                bent = 0.0
                for i in range(3):
                    pose = poses[t + i] if t + i >= 0 else held[first + t + i]
                    bent += _difference(i) * pose[joint, axis]
                energy += smoothness[first + t] * bent * bent
                for i in range(max(-t, 0), 3):
                    pull[t + i, joint, axis] += _difference(i) * smoothness[first + t] * bent
    for joint in _ORDER[:0:-1]:
        for t in range(frames):
            for axis in range(3):
                bone = poses[t, joint, axis] - poses[t, _PARENTS[joint], axis]
                off = bone - bones[t, joint, axis]
                pull[t, _PARENTS[joint], axis] += pull[t, joint, axis]
                pull[t, joint, axis] += firmness[t] * off
                energy += firmness[t] * off * off
    return energy, pull


@inner_kernel()
def _curvature(
    basis: Array,
    directions: Array,
    lengths: Array,
    pull: Array,
    over: Array,
    firmness: Array,
    coupling: Array,
    damping: float,
) -> Array:
    """Return the rows of each bone in the columns of itself and of the bones that carry it (14, 3 T, columns T)."""
    frames = over.shape[0]
    carried = over.copy()
    for joint in _ORDER[:0:-1]:
        for t in range(frames):
            carried[t, _PARENTS[joint]] += carried[t, joint]
    rows = np.zeros((_JOINTS, 3 * frames, _NUM_COLUMNS * frames))
    for joint in range(_JOINTS):
        size, start, above = 3 if joint == _ROOT else 2, 0, joint
        while above >= 0:
            other = 3 if above == _ROOT else 2
            for t in range(frames):
                for s in range(max(t - 2, 0), min(t + 3, frames)):
                    flat = _NUM_CARRIED[joint] * coupling[t, s]
                    deep = flat
                    if s == t:
                        hold = firmness[t] if above == joint and joint != _ROOT else 0.0
                        flat += carried[t, joint] + hold
                        deep += _NUM_CARRIED[joint] * DEPTH_HOLD + hold
                    for i in range(size):
                        for j in range(other):
                            rows[joint, size * t + i, start + other * s + j] = (
                                flat * basis[t, joint, 0, i] * basis[s, above, 0, j]
                                + flat * basis[t, joint, 1, i] * basis[s, above, 1, j]
                                + deep * basis[t, joint, 2, i] * basis[s, above, 2, j]
                            )
            start += other * frames
            above = _PARENTS[above]
        for t in range(frames):
            along = 0.0
            for axis in range(3):
                along -= pull[t, joint, axis] * directions[t, joint, axis]
            bending = max(along * lengths[joint], 0.0) if joint != _ROOT else 0.0
            for i in range(size * t, size * t + size):
                rows[joint, i, i] = (1.0 + damping) * (rows[joint, i, i] + bending) + SMALLEST_CURVATURE
    return rows


@inner_kernel()
def _solve(rows: Array, basis: Array, pull: Array, step: Array) -> bool:
    """Solve for the step (T, n) by Cholesky, in place; return whether a factor exists."""
    frames = step.shape[0]
    known = np.zeros((_JOINTS, 3 * frames))
    for joint in _ORDER[::-1]:
        size, width = 3 if joint == _ROOT else 2, (2 * _DEPTH[joint] + 3) * frames
        for t in range(frames):
            for i in range(size):
                for axis in range(3):
                    known[joint, size * t + i] += basis[t, joint, axis, i] * pull[t, joint, axis]
        for row in range(size * frames):
            pivot = rows[joint, row, row]
            if not pivot > 0.0:
                return False
            factor = rows[joint, row, :width]
            for column in range(row, width):
                factor[column] /= np.sqrt(pivot)
            known[joint, row] /= np.sqrt(pivot)
            for column in range(row + 1, size * frames):
                share, rest, changed = factor[column], factor[column:], rows[joint, column, column:width]
                for k in range(rest.shape[0]):
                    changed[k] -= share * rest[k]
                known[joint, column] -= share * known[joint, row]
        start, above = size * frames, _PARENTS[joint]
        for column in range(size * frames, width):
            if column - start == 2 * frames and above != _ROOT:
                start, above = column, _PARENTS[above]
            changed = rows[above, column - start, column - start : width - start]
            for row in range(0, size * frames, 2):  # in twos, which takes half the time
                upper, lower = rows[joint, row, column:width], rows[joint, row + 1, column:width]
                first, second = upper[0], lower[0]
                for k in range(changed.shape[0]):
                    changed[k] -= first * upper[k] + second * lower[k]
                known[above, column - start] -= first * known[joint, row] + second * known[joint, row + 1]
    for joint in _ORDER:
        size, width = 3 if joint == _ROOT else 2, (2 * _DEPTH[joint] + 3) * frames
        for row in range(size * frames - 1, -1, -1):
            value = known[joint, row]
            start, above = 0, joint
            for column in range(row + 1, width):
                if column - start == 2 * frames and above != _ROOT:
                    start, above = column, _PARENTS[above]
                value -= rows[joint, row, column] * known[above, column - start]
            known[joint, row] = value / rows[joint, row, row]
            step[row // size, _STARTS[joint] + row % size] = -known[joint, row]
    return True
