"""Compiled inner loops of the proposals."""

from __future__ import annotations

import math

from pasdedeux.compiled import compiled
from pasdedeux.kinematics.rotation_kernels import multiply, rotvec_from_unitquat, unitquat_from_rotvec


@compiled()
def move_blocks(parameters, blocks, factors, noise, turn, shift, length_change, tied, num_joints):  # type: ignore[no-untyped-def]
    """Move blocks of `parameters` in place: roots turn in the world and shift, bones turn and change their length.

    Args:
        parameters: Parameters (108,).
        blocks: Blocks that move, (n,).
        factors: Factor on their deviations, (n,).
        noise: Standard normal numbers (n, 6); a bone needs three.
        turn: Standard deviations of the blocks' turns, (34,).
        shift: Those of the roots' shifts, (2,).
        length_change: That of the bones' lengths.
        tied: Length parameter of each block and of its counterpart, (34, 2); the second is -1 where it has none.
        num_joints: Joints of a person.
    """
    for at in range(blocks.shape[0]):
        block = blocks[at]
        person, joint = block // num_joints, block % num_joints
        start = person * (3 + 3 * num_joints)
        size = factors[at] * turn[block]
        if joint == 0:
            turn_by = unitquat_from_rotvec((size * noise[at, 0], size * noise[at, 1], size * noise[at, 2]))
            before = unitquat_from_rotvec((parameters[start], parameters[start + 1], parameters[start + 2]))
            after = rotvec_from_unitquat(multiply(turn_by, before))
            parameters[start], parameters[start + 1], parameters[start + 2] = after
            for axis in range(3):
                parameters[start + 3 + axis] += factors[at] * shift[person] * noise[at, 3 + axis]
            continue
        start += 3 + 3 * joint
        parameters[start] += size * noise[at, 0]
        parameters[start + 1] += size * noise[at, 1]
        for side in range(2):
            if tied[block, side] >= 0:
                parameters[tied[block, side]] += factors[at] * length_change * noise[at, 2]


@compiled()
def log_normal_ratio(count, square, here, there, is_bound):  # type: ignore[no-untyped-def]
    """Return log N(-x; 0, there) - log N(x; 0, here) of an x of `count` numbers whose square is here^2 times `square`.

    With `is_bound`, the greatest over all deviations from `there` on: it peaks at here^2 square / count.
    """
    if is_bound:
        there = max(there, here * math.sqrt(square / count))
    ratio = here / there
    return count * math.log(ratio) + 0.5 * square * (1.0 - ratio * ratio)


@compiled()
def log_ratio_of_steps(blocks, noise, turn, shift, turn_there, shift_there, is_bound, num_joints):  # type: ignore[no-untyped-def]
    """Return log Q(back) - log Q(forth) of one displacement; lengths and factors, the same both ways, cancel.

    Args:
        blocks: Blocks that moved, (n,).
        noise: The displacement in units of the deviations it was drawn with, (n, 6).
        turn: Those deviations of turns, (34,).
        shift: Those of shifts, (2,).
        turn_there: Deviations of turns at the other end, (34,).
        shift_there: Deviations of shifts there, (2,).
        is_bound: Give the greatest value for deviations there of at least so much instead.
        num_joints: Joints of a person.
    """
    total = 0.0
    for at in range(blocks.shape[0]):
        block = blocks[at]
        person = block // num_joints
        square = noise[at, 0] ** 2 + noise[at, 1] ** 2
        if block % num_joints == 0:
            moved = noise[at, 3] ** 2 + noise[at, 4] ** 2 + noise[at, 5] ** 2
            total += log_normal_ratio(3.0, moved, shift[person], shift_there[person], is_bound)
            total += log_normal_ratio(3.0, square + noise[at, 2] ** 2, turn[block], turn_there[block], is_bound)
        else:
            total += log_normal_ratio(2.0, square, turn[block], turn_there[block], is_bound)
    return total
