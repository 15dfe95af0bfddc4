"""Loads what `pasdedeux reconstruct` wrote into Blender itself; run by hand, `make blender FILES=out`, never by pytest.

Blender's module is large and under the GPL, so it is no dependency: `pip install bpy numpy` in an environment apart.
"""

# ruff: noqa: T201
from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np

_TOLERANCE_M = 1e-3
_FROM_BLENDER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Blender's Z is up and its -Y to the front; ours are Y and +Z."""


def load(path: Path, metres_per_unit: float) -> tuple[bpy.types.Object, str]:
    """Return the armature of a BVH file, and what Blender said about it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with tempfile.TemporaryFile("w+") as said:
        kept = os.dup(1)
        os.dup2(said.fileno(), 1)  # Blender's importer prints from Python and from C
        with contextlib.redirect_stdout(said):
            bpy.ops.import_anim.bvh(
                filepath=str(path), global_scale=metres_per_unit, axis_forward="-Z", axis_up="Y", update_scene_fps=True
            )
        os.dup2(kept, 1)
        said.seek(0)
        return bpy.context.object, said.read()


def check(path: Path) -> None:
    """Check one file beside its npz; an AssertionError says what is wrong."""
    made = np.load(path.with_suffix(".npz"))
    names, truth = made["joint_names"].tolist(), made["positions_m"]
    units = path.with_name(f"{path.stem.rpartition('_')[0]}_units.txt").read_text(encoding="utf-8")
    metres = 0.01 if "centimetres" in units.split(" and ")[0] else 1.0
    rig, said = load(path, metres)
    assert "zero length" not in said, said
    roots = [bone.name for bone in rig.data.bones if bone.parent is None]
    assert roots == ["Hips"], roots
    joints = [name for name in names if not name.endswith("_end")]
    assert sorted(bone.name for bone in rig.data.bones) == sorted(joints)
    assert min(bone.length for bone in rig.data.bones) > 0.01
    rest = {bone.name: _FROM_BLENDER @ np.array(bone.head_local) for bone in rig.data.bones}
    assert rest["Head"][1] > rest["Spine"][1] > rest["Hips"][1] > rest["LeftLeg"][1] > rest["LeftFoot"][1]
    assert rest["LeftToeBase"][2] > rest["LeftFoot"][2] + 0.05, "feet point to +Z"
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        shoulder, hand = rest[f"{side}Arm"], rest[f"{side}Hand"]
        assert sign * (hand - shoulder)[0] > 0.3
        assert abs((hand - shoulder)[1:]).max() < _TOLERANCE_M, "arms out along X"
    worst = 0.0
    for frame in range(len(truth)):
        bpy.context.scene.frame_set(frame + 1)
        for at, name in enumerate(names):
            bone = rig.pose.bones[name.removesuffix("_end")]
            point = bone.tail if name.endswith("_end") else bone.head
            worst = max(worst, float(np.linalg.norm(_FROM_BLENDER @ np.array(point) - truth[frame, at])))
    assert worst < _TOLERANCE_M, f"a joint is {1e3 * worst:.2f} mm from where the npz has it"
    print(f"{path}: Hips root, T-pose, {len(truth)} frames, joints within {1e3 * worst:.4f} mm")


if __name__ == "__main__":
    for file in sorted(Path(sys.argv[1]).glob("*.bvh")):
        check(file)
