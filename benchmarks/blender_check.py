"""Load BVH files with their npz, and GLB files, of `export` and `retarget`, into Blender and check them.

Run by hand, `make blender FILES=out`, never by pytest.

Blender's module is large and under the GPL, so it is no dependency: `pip install bpy numpy usd-core` elsewhere.
"""

# ruff: noqa: T201
from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

_TOLERANCE_M = 1e-3
_LEG, _ARM = ("hip", "knee", "ankle", "toe"), ("collar", "shoulder", "elbow", "wrist")
_BODY22 = ["pelvis", "spine1", "spine2", "spine3", "neck", "head"]
_BODY22 += [f"{side}_{joint}" for limb in (_LEG, _ARM) for side in ("left", "right") for joint in limb]
_FROM_BLENDER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Blender's Z is up and its -Y to the front; ours are Y and +Z."""


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Hold back what Blender prints, from Python and from C."""
    with tempfile.TemporaryFile("w+") as said, contextlib.redirect_stdout(io.StringIO()):
        kept = os.dup(1)
        os.dup2(said.fileno(), 1)
        try:
            yield
        finally:
            os.dup2(kept, 1)
            os.close(kept)


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


def check_file(path: Path) -> None:
    """Check one file against its npz; an AssertionError names the difference."""
    arrays = dict(np.load(path.with_suffix(".npz")))
    names, parents, truth = arrays["joint_names"].tolist(), arrays["parents"].tolist(), arrays["positions_m"]
    if "bvh_metres_per_unit" in arrays:
        metres = float(arrays["bvh_metres_per_unit"])
    else:
        units = path.with_name(f"{path.stem.rpartition('_')[0]}_units.txt").read_text(encoding="utf-8")
        metres = 0.01 if "centimetres" in units.split(" and ")[0] else 1.0
    ends = {at for at, up in enumerate(parents) if up >= 0 and names[at].startswith(f"{names[up]}_end")}
    rig, said = load(path, metres)
    assert "zero length" not in said, said
    assert [bone.name for bone in rig.data.bones if bone.parent is None] == [names[parents.index(-1)]]
    assert sorted(bone.name for bone in rig.data.bones) == sorted(n for at, n in enumerate(names) if at not in ends)
    rest = {bone.name: _FROM_BLENDER @ np.array(bone.head_local) for bone in rig.data.bones}
    for at, up in enumerate(parents):
        if up >= 0 and at not in ends:
            off = rest[names[at]] - rest[names[up]] - arrays["rest_offset_m"][at]
            assert np.abs(off).max() < _TOLERANCE_M, f"{names[at]} rests {off} m from where it is said to"
    pose = str(arrays.get("rest_pose", "standing"))
    if pose == "standing":
        joints = arrays["body22_joint"].tolist() if "body22_joint" in arrays else names[: len(_BODY22)]
        check_t_pose({name: rest[joint] for name, joint in zip(_BODY22, joints, strict=True) if joint in rest})
    worst, stretch = 0.0, 0.0
    for frame in range(len(truth)):
        bpy.context.scene.frame_set(frame + 1)
        points = np.empty((len(names), 3))
        for at, name in enumerate(names):
            bone = rig.pose.bones[names[parents[at]] if at in ends else name]
            points[at] = _FROM_BLENDER @ np.array(bone.tail if at in ends else bone.head)
            worst = max(worst, float(np.linalg.norm(points[at] - truth[frame, at])))
        for at, up in enumerate(parents):
            if up >= 0 and at not in ends:
                length = np.linalg.norm(points[at] - points[up])
                stretch = max(stretch, abs(float(length - np.linalg.norm(arrays["rest_offset_m"][at]))))
    assert worst < _TOLERANCE_M, f"a joint is {1e3 * worst:.2f} mm from where the npz has it"
    assert stretch < _TOLERANCE_M, f"a bone changes its length by {1e3 * stretch:.2f} mm"
    print(
        f"{path}: root {names[parents.index(-1)]}, rest pose {pose}, {len(truth)} frames, joints within "
        f"{1e3 * worst:.4f} mm, bones within {1e3 * stretch:.4f} mm"
    )


def check_glb(path: Path) -> None:
    """Check that every joint of every frame of a GLB is at its node, and that each person has a skin."""
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    tree, binary = json.loads(data[20 : 20 + size]), data[28 + size :]

    def values(accessor: int) -> np.ndarray:
        entry = tree["accessors"][accessor]
        view = tree["bufferViews"][entry["bufferView"]]
        return np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(entry["count"], -1)

    (moving,) = tree["animations"]
    tracks = {
        (channel["target"]["node"], channel["target"]["path"]): values(moving["samplers"][channel["sampler"]]["output"])
        for channel in moving["channels"]
    }
    times = values(moving["samplers"][0]["input"])[:, 0]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    rate = 1 if len(times) < 2 else round(1 / float(times[1] - times[0]))
    bpy.context.scene.render.fps = rate
    with contextlib.redirect_stdout(io.StringIO()):
        bpy.ops.import_scene.gltf(filepath=str(path))
    rigs = sorted((item for item in bpy.data.objects if item.type == "ARMATURE"), key=lambda item: item.name)
    assert len(rigs) == len(tree["skins"]), [rig.name for rig in rigs]
    bodies = [item for item in bpy.data.objects if item.type == "MESH" and item.find_armature() in rigs]
    assert len(bodies) == len(rigs), "a body without a skin"
    worst = 0.0
    for frame, time in enumerate(times):
        bpy.context.scene.frame_set(int(np.floor(time * rate + 1e-3)), subframe=0.0)
        for rig, skin in zip(rigs, tree["skins"], strict=True):
            for joint, at in nodes_at(tree, tracks, frame, skin["skeleton"]).items():
                bone = rig.pose.bones[tree["nodes"][joint]["name"]]
                place = _FROM_BLENDER @ np.array((rig.matrix_world @ bone.matrix).translation)
                worst = max(worst, float(np.linalg.norm(place - at)))
    assert worst < _TOLERANCE_M, f"a joint is {1e3 * worst:.2f} mm from where the file has it"
    print(f"{path}: {len(rigs)} people, {len(times)} frames, joints within {1e3 * worst:.4f} mm")
    if len(times) > 1:
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "copy.glb"
            copy.write_bytes(data)
            run_lines_of_docs(copy)
            places = [
                {
                    tree["nodes"][joint]["name"]: at
                    for joint, at in nodes_at(tree, tracks, frame, skin["skeleton"]).items()
                }
                for frame in range(len(times))
                for skin in tree["skins"]
            ]
            for suffix in (".fbx", ".usdc"):
                check_converted(copy.with_suffix(suffix), tree["asset"]["extras"]["rate_hz"], places, len(rigs))


def run_lines_of_docs(path: Path) -> None:
    """Convert a GLB by the script of the docs."""
    page = (Path(__file__).parents[1] / "docs" / "formats-and-units.md").read_text(encoding="utf-8")
    (lines,) = [text.partition("```")[0] for text in page.split("```python\n")[1:] if "import bpy" in text]
    assert lines.count('"waltz.glb"') == 1
    with quiet():
        exec(compile(lines.replace('"waltz.glb"', repr(str(path))), "docs", "exec"), {})


def check_converted(path: Path, rate_hz: float, places: list[dict[str, np.ndarray]], num_people: int) -> None:
    """Check that a converted file has the rate of the GLB, and the same joints in every frame."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    with quiet():
        if path.suffix == ".fbx":
            bpy.ops.import_scene.fbx(filepath=str(path), ignore_leaf_bones=False)
            found_hz = scene.render.fps / scene.render.fps_base
        else:
            script = f"from pxr import Usd; print(Usd.Stage.Open({str(path)!r}).GetTimeCodesPerSecond())"
            # In a process of its own: Blender holds a USD library too.
            result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
            found_hz = float(result.stdout)
            bpy.ops.wm.usd_import(filepath=str(path))
    assert abs(found_hz - rate_hz) < 1e-3, f"{path.suffix} has {found_hz} Hz in place of {rate_hz}"
    rigs = sorted((item for item in bpy.data.objects if item.type == "ARMATURE"), key=lambda item: item.name)
    assert len(rigs) == num_people
    first = round(min(action.frame_range[0] for action in bpy.data.actions))
    last = round(max(action.frame_range[1] for action in bpy.data.actions))
    assert last - first + 1 == len(places) // num_people, f"{path.suffix} has frames {first} to {last}"
    worst = 0.0
    for frame in range(last - first + 1):
        scene.frame_set(first + frame)
        for person, rig in enumerate(rigs):
            for name, at in places[frame * num_people + person].items():
                place = _FROM_BLENDER @ np.array((rig.matrix_world @ rig.pose.bones[name].matrix).translation)
                worst = max(worst, float(np.linalg.norm(place - at)))
    assert worst < _TOLERANCE_M, f"{path.suffix}: a joint is {1e3 * worst:.2f} mm from where the GLB has it"
    print(f"  {path.suffix}: {last - first + 1} frames at {found_hz:g} Hz, joints within {1e3 * worst:.4f} mm")


def nodes_at(tree: dict, tracks: dict, frame: int, root: int) -> dict[int, np.ndarray]:
    """Return the places of the nodes below a root, at a frame."""
    places: dict[int, np.ndarray] = {}
    stack = [(root, np.eye(3), np.zeros(3))]
    while stack:
        node, turn, start = stack.pop()
        entry = tree["nodes"][node]
        move = tracks[node, "translation"][frame] if (node, "translation") in tracks else np.array(entry["translation"])
        x, y, z, w = tracks[node, "rotation"][frame]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        places[node] = start + turn @ move
        turn = turn @ (np.eye(3) + 2 * w * cross + 2 * cross @ cross)
        stack += [(child, turn, places[node]) for child in entry.get("children", ())]
    return places


def check_t_pose(rest: dict[str, np.ndarray]) -> None:
    """Check that a person stands upright, faces +Z and has the arms out along X."""
    assert rest["head" if "head" in rest else "neck"][1] > rest["spine2"][1] > rest["left_knee"][1]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        assert rest[f"{side}_hip"][1] > rest[f"{side}_knee"][1] > rest[f"{side}_ankle"][1]
        if f"{side}_toe" in rest:
            assert rest[f"{side}_toe"][2] > rest[f"{side}_ankle"][2] + 0.05, "feet point to +Z"
        arm = rest[f"{side}_wrist"] - rest[f"{side}_shoulder"]
        assert sign * arm[0] > 0.3
        assert abs(arm[1:]).max() < _TOLERANCE_M, "arms out along X"


if __name__ == "__main__":
    paths = [
        path for given in map(Path, sys.argv[1:]) for path in (sorted(given.glob("*")) if given.is_dir() else [given])
    ]
    files = {suffix: [path for path in paths if path.suffix == suffix] for suffix in (".bvh", ".glb")}
    assert any(files.values()), f"there is no BVH or GLB file in {' '.join(sys.argv[1:]) or 'nothing'}"
    for file in files[".bvh"]:
        if file.with_suffix(".npz").exists():
            check_file(file)
        else:
            rig, contents = load(file, 0.01)
            assert "zero length" not in contents, contents
            print(f"{file}: {len(rig.data.bones)} bones, no npz to compare with")
    for file in files[".glb"]:
        check_glb(file)
