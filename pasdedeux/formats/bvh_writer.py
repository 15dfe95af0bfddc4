"""Writing BVH motion files."""

from __future__ import annotations

import numpy as np

from pasdedeux.formats.euler import euler_from_unitquat
from pasdedeux.kinematics import Motion

_ROTATION_ORDER = "ZXY"
"""Rotation channels of every joint, outermost first."""


def write_bvh(motion: Motion, *, units_per_metre: float = 100.0, decimals: int = 6) -> str:
    """Return a motion as BVH text: lengths in file units (centimetres by default), angles in degrees, Y up.

    A leaf named `<parent>_end` that never turns is written as an End Site; every other leaf gets an End Site without
    offset.  `read_bvh` returns the same motion, to half a unit of the last decimal.
    """
    skeleton = motion.skeleton
    offsets = motion.rest_offsets_m * units_per_metre
    names = [name.replace("{", "(").replace("}", ")") for name in skeleton.joint_names]
    channels = " ".join(f"{axis}rotation" for axis in _ROTATION_ORDER)
    lines = ["HIERARCHY"]
    columns: list[int] = []

    def vector(values: np.ndarray) -> str:
        return " ".join(f"{value:.{decimals}f}" for value in values)

    def is_end_site(joint: int) -> bool:
        parent = skeleton.parents[joint]
        return (
            parent >= 0
            and not skeleton.children(joint)
            and skeleton.joint_names[joint].startswith(f"{skeleton.joint_names[parent]}_end")
            and bool(np.all(np.abs(motion.local_unitquat[:, joint, :3]) < 1e-12))
        )

    # A stack instead of recursion: (joint, depth) opens a joint, (-1, depth) closes a block.
    stack = [(skeleton.root, 0)]
    while stack:
        joint, depth = stack.pop()
        pad = "\t" * depth
        if joint < 0:
            lines.append(f"{pad}}}")
            continue
        children = skeleton.children(joint)
        if is_end_site(joint):
            lines += [f"{pad}End Site", f"{pad}{{", f"{pad}\tOFFSET {vector(offsets[joint])}", f"{pad}}}"]
            continue
        is_root = joint == skeleton.root
        lines += [
            f"{pad}{'ROOT' if is_root else 'JOINT'} {names[joint]}",
            f"{pad}{{",
            f"{pad}\tOFFSET {vector(np.zeros(3) if is_root else offsets[joint])}",
            f"{pad}\tCHANNELS " + (f"6 Xposition Yposition Zposition {channels}" if is_root else f"3 {channels}"),
        ]
        columns.append(joint)
        if not children:
            lines += [f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET {vector(np.zeros(3))}", f"{pad}\t}}"]
        stack.append((-1, depth))
        stack.extend((child, depth + 1) for child in reversed(children))

    angles = np.rad2deg(np.unwrap(euler_from_unitquat(motion.local_unitquat[:, columns], _ROTATION_ORDER), axis=0))
    values = np.concatenate(
        [motion.root_translation_m * units_per_metre, angles.reshape(motion.num_frames, -1)], axis=1
    )
    values = np.round(values, decimals) + 0.0  # no "-0"
    lines += ["MOTION", f"Frames: {motion.num_frames}", f"Frame Time: {1.0 / motion.rate_hz!r}"]
    row = " ".join([f"%.{decimals}f"] * values.shape[1])
    lines += [row % tuple(frame) for frame in values]
    return "\n".join(lines) + "\n"
