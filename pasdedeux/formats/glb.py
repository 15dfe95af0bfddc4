"""Writing binary glTF: skinned bodies, animated, all in one scene.

A file is one buffer and a tree of plain JSON.  The package pygltflib 1.16 would need as many lines to build the tree,
and it does not pack the buffer.  The tests read files back with it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import conjugate, rotate

_FLOAT, _UINT, _USHORT = 5126, 5125, 5123
_COLOURS = ((0.82, 0.33, 0.27), (0.25, 0.47, 0.75), (0.35, 0.62, 0.35), (0.75, 0.6, 0.25))
_SWAP_M = 1e-4
"""Joints whose offset changes by more are animated in translation, beside rotation."""


@dataclass(frozen=True)
class Skin:
    """A surface in the rest pose of a motion, with the joints that move its vertices.

    Args:
        points_m: Vertices (n, 3), metres.
        normals: Unit normals at them (n, 3).
        faces: Vertices of each triangle (m, 3), counterclockwise from outside.
        joints: Joints that move each vertex (n, 4).
        weights: Weights of these joints (n, 4); rows sum to 1.
    """

    points_m: Array
    normals: Array
    faces: Integers
    joints: Integers
    weights: Array


@dataclass(frozen=True)
class GlbPerson:
    """A person of a scene.

    Args:
        name: Name of the figure.
        motion: The motion.
        skin: Its surface.
        positions_m: Positions of the joints (frame, J, 3), metres, if bones change their lengths; else None.
    """

    name: str
    motion: Motion
    skin: Skin
    positions_m: Array | None = None


@dataclass(frozen=True)
class GlbCamera:
    """A camera of a scene, which looks along its own -z, y up.

    Args:
        name: Its name.
        position_m: Its position (3,).
        world_from_camera_unitquat: Its rotation (4,).
        height_rad: Vertical field of view.
        aspect: Width over height of its image.
    """

    name: str
    position_m: Array
    world_from_camera_unitquat: Array
    height_rad: float
    aspect: float


class _Buffer:
    """The one buffer of a file, and the accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: Array, kind: str, *, is_bounded: bool = False) -> int:
        """Add rows of values and return the number of their accessor."""
        code = {"f": _FLOAT, "u": _UINT if values.dtype.itemsize == 4 else _USHORT}[values.dtype.kind]
        self.data += bytes(-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes})
        self.data += np.ascontiguousarray(values).tobytes()
        accessor = {"bufferView": len(self.views) - 1, "componentType": code, "count": len(values), "type": kind}
        if is_bounded:
            flat = values.reshape(len(values), -1)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_glb(
    people: Sequence[GlbPerson], *, copyright_text: str, facts: dict[str, Any], cameras: Sequence[GlbCamera] = ()
) -> bytes:
    """Return people in one scene as binary glTF: metres, Y up, a skin over joints for each person.

    Args:
        people: The people, with the same number of frames and the same rate.
        copyright_text: Licence and credit.
        facts: Further facts for the `extras` of the asset.
        cameras: The cameras that saw them.
    """
    buffer, nodes = _Buffer(), list[dict[str, Any]]()
    rate_hz = people[0].motion.rate_hz
    times = buffer.add(
        np.arange(people[0].motion.num_frames, dtype="<f4") / np.float32(rate_hz), "SCALAR", is_bounded=True
    )
    meshes, skins, samplers, channels = (list[dict[str, Any]]() for _ in range(4))
    roots: list[int] = []
    for number, person in enumerate(people):
        motion, skeleton, first = person.motion, person.motion.skeleton, len(nodes)
        rest = motion.rest_positions_m()
        moved = _translations(person)
        for joint, name in enumerate(skeleton.joint_names):
            node: dict[str, Any] = {
                "name": name,
                "translation": moved[0, joint].tolist(),
                "rotation": motion.local_unitquat[0, joint].tolist(),
            }
            if below := [first + child for child in skeleton.children(joint)]:
                node["children"] = below
            nodes.append(node)
            tracks: list[tuple[str, str, Array]] = [("rotation", "VEC4", motion.local_unitquat[:, joint])]
            if joint == skeleton.root or np.abs(moved[:, joint] - moved[0, joint]).max() > _SWAP_M:
                tracks.append(("translation", "VEC3", moved[:, joint]))
            for path, kind, values in tracks:
                channels.append({"sampler": len(samplers), "target": {"node": first + joint, "path": path}})
                samplers.append({"input": times, "output": buffer.add(values.astype("<f4"), kind)})
        bind = np.tile(np.eye(4, dtype="<f4"), (skeleton.num_joints, 1, 1))
        bind[:, 3, :3] = -rest  # column by column
        meshes.append({"name": person.name, "primitives": [_primitive(buffer, person.skin, number % len(_COLOURS))]})
        skins.append(
            {
                "name": person.name,
                "joints": list(range(first, first + skeleton.num_joints)),
                "skeleton": first + skeleton.root,
                "inverseBindMatrices": buffer.add(bind.reshape(-1, 16), "MAT4"),
            }
        )
        nodes.append({"name": f"{person.name} body", "mesh": number, "skin": number})
        nodes.append({"name": person.name, "children": [first + skeleton.root, len(nodes) - 1]})
        roots.append(len(nodes) - 1)
    for number, camera in enumerate(cameras):
        roots.append(len(nodes))
        turn = camera.world_from_camera_unitquat.tolist()
        nodes.append(
            {"name": camera.name, "camera": number, "translation": camera.position_m.tolist(), "rotation": turn}
        )
    tree = {
        "asset": {"version": "2.0", "generator": "pasdedeux", "copyright": copyright_text, "extras": facts},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "nodes": nodes,
        **({"cameras": [_camera(camera) for camera in cameras]} if cameras else {}),
        "meshes": meshes,
        "skins": skins,
        "materials": [
            {"name": f"colour {at}", "pbrMetallicRoughness": {"baseColorFactor": [*rgb, 1.0], "metallicFactor": 0.0}}
            for at, rgb in enumerate(_COLOURS)
        ],
        "animations": [{"name": "motion", "samplers": samplers, "channels": channels}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    text = json.dumps(tree, ensure_ascii=False, separators=(",", ":")).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", bytes(buffer.data) + bytes(-len(buffer.data) % 4))]
    body = b"".join(struct.pack("<I4s", len(data), name) + data for name, data in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def _camera(camera: GlbCamera) -> dict[str, Any]:
    lens = {"yfov": camera.height_rad, "aspectRatio": camera.aspect, "znear": 0.05}
    return {"name": camera.name, "type": "perspective", "perspective": lens}


def _translations(person: GlbPerson) -> Array:
    """Return the translation of each joint in its parent's frame (frame, J, 3)."""
    motion, skeleton = person.motion, person.motion.skeleton
    moved = np.tile(motion.rest_offsets_m, (motion.num_frames, 1, 1))
    moved[:, skeleton.root] = motion.root_translation_m
    if person.positions_m is not None:
        world = motion.world()[1]
        for parent, child in skeleton.bones:
            bone = person.positions_m[:, child] - person.positions_m[:, parent]
            moved[:, child] = rotate(conjugate(world[:, parent]), bone)
    return moved


def _primitive(buffer: _Buffer, skin: Skin, material: int) -> dict[str, Any]:
    """Add a surface with its joints and weights, and return the primitive."""
    attributes = {
        "POSITION": buffer.add(skin.points_m.astype("<f4"), "VEC3", is_bounded=True),
        "NORMAL": buffer.add(skin.normals.astype("<f4"), "VEC3"),
        "JOINTS_0": buffer.add(skin.joints.astype("<u2"), "VEC4"),
        "WEIGHTS_0": buffer.add(skin.weights.astype("<f4"), "VEC4"),
    }
    indices = buffer.add(skin.faces.astype("<u4").reshape(-1), "SCALAR")
    return {"attributes": attributes, "indices": indices, "material": material}
