"""BVH files of made-up rigs, and a plain reading of any file as it is written: the oracle of the reader."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Node:
    """A joint of a BVH file; parents come before their children, -1 is none."""

    name: str
    parent: int
    offset: tuple[float, ...]
    channels: tuple[str, ...]


_BODY = {
    "Hips": ("", (0, 95, 0)),
    "Spine": ("Hips", (0, 10, 0)), "Chest": ("Spine", (0, 20, 0)), "Neck": ("Chest", (0, 20, 0)),
    "Head": ("Neck", (0, 9, 1)),
    **{
        side + joint: (side + parent if parent in ("Arm", "ForeArm", "UpLeg", "Leg", "Foot") else parent, offset)
        for side, x in (("Left", 1), ("Right", -1))
        for joint, parent, offset in (
            ("Arm", "Chest", (18 * x, 11, 0)), ("ForeArm", "Arm", (28 * x, 0, 0)), ("Hand", "ForeArm", (26 * x, 0, 0)),
            ("UpLeg", "Hips", (9 * x, -4, 0)), ("Leg", "UpLeg", (0, -42, 0)), ("Foot", "Leg", (0, -41, 0)),
            ("Toe", "Foot", (0, -6, 13)),
        )
    },
}  # fmt: skip


def body_nodes(*, above: Sequence[str], kinds: Sequence[int], rng: np.random.Generator, prefix: str = "") -> list[Node]:
    """Return a person below nodes of these names; joints have 0, 3 or 6 channels in turn, in any order."""
    tree = {name: (above[at - 1] if at else "", (3.0 * at, 1.0, 2.0)) for at, name in enumerate(above)}
    for name, (parent, offset) in _BODY.items():
        tree[prefix + name] = (prefix + parent if parent else "".join(above[-1:]), offset)
    names = list(tree)
    nodes = []
    for at, (name, (parent, offset)) in enumerate(tree.items()):
        kind = 6 if at == len(above) else kinds[at % len(kinds)]
        channels = [f"{axis}rotation" for axis in "XYZ"][: min(kind, 3)]
        channels += [f"{axis}position" for axis in "XYZ"] if kind == 6 else []
        order = rng.permutation(len(channels))
        parent_at = names.index(parent) if parent else -1
        nodes.append(Node(name, parent_at, offset, tuple(channels[place] for place in order)))
    return nodes


def bvh_of(nodes: Sequence[Node], values: np.ndarray) -> str:
    """Return a BVH file at 120 Hz, a line for each word of the hierarchy and each row (frame, columns) of numbers."""

    def block(at: int) -> list[str]:
        node = nodes[at]
        inside = [line for child, other in enumerate(nodes) if other.parent == at for line in block(child)]
        offset = " ".join(f"{value:.9f}" for value in node.offset)
        channels = f"CHANNELS {' '.join([str(len(node.channels)), *node.channels])}"
        return [
            f"{'JOINT' if node.parent >= 0 else 'ROOT'} {node.name}",
            "{",
            f"OFFSET {offset}",
            channels,
            *inside,
            "}",
        ]

    written: list[int] = []

    def walk(at: int) -> None:
        written.append(at)
        for child, node in enumerate(nodes):
            if node.parent == at:
                walk(child)

    walk(0)
    starts = np.cumsum([0, *(len(node.channels) for node in nodes)])
    columns = [column for at in written for column in range(starts[at], starts[at + 1])]
    rows = [" ".join(f"{value:.9f}" for value in row) for row in np.asarray(values)[:, columns]]
    return "\n".join(["HIERARCHY", *block(0), "MOTION", f"Frames: {len(rows)}", "Frame Time: 0.008333", *rows]) + "\n"


def bvh_of_several(files: Sequence[str], *, has_common_root: bool) -> str:
    """Return one file of the people of several that have as many frames: with roots of their own, or below a node."""
    trees, tables = zip(*(file.removeprefix("HIERARCHY\n").split("MOTION\n") for file in files), strict=True)
    if has_common_root:
        trees = ("ROOT scene { OFFSET 0 0 0 CHANNELS 0\n", *(tree.replace("ROOT", "JOINT", 1) for tree in trees), "}\n")
    rows = map(" ".join, zip(*(table.splitlines()[2:] for table in tables), strict=True))
    return "HIERARCHY\n" + "".join(trees) + "\n".join(["MOTION", *tables[0].splitlines()[:2], *rows]) + "\n"


def world_of_file(text: str) -> dict[str, np.ndarray]:
    """Return the place (frame, 3) of every joint of a file by its numbers as they are written, frame by frame."""
    tree, _, motion = text.partition("MOTION")
    tokens = re.findall(r"ROOT|JOINT|End Site|OFFSET|CHANNELS|[{}]|\S+", tree.partition("HIERARCHY")[2])
    rows = np.array([line.split() for line in motion.strip().split("\n")[2:]], dtype=float)
    world: dict[str, np.ndarray] = {}
    stack: list[tuple[np.ndarray, list[Rotation]]] = [(np.zeros((len(rows), 3)), [Rotation.identity()] * len(rows))]
    column, name, offset = 0, "", np.zeros(3)
    at = 0
    while at < len(tokens):
        token = tokens[at]
        at += 1
        if token in ("ROOT", "JOINT", "End Site"):
            parent, words = name, []
            while tokens[at] != "{":
                words.append(tokens[at])
                at += 1
            name = " ".join(words) if token != "End Site" else f"{parent}_end"
        elif token == "OFFSET":
            offset = np.array(tokens[at : at + 3], dtype=float)
            at += 3
            if name.endswith("_end"):
                world[name] = place_of(stack[-1], np.tile(offset, (len(rows), 1)))
                stack.append(stack[-1])
        elif token == "CHANNELS":
            count = int(tokens[at])
            channels = tokens[at + 1 : at + 1 + count]
            at += 1 + count
            local = np.tile(offset, (len(rows), 1))
            turn = [Rotation.identity()] * len(rows)
            for channel in channels:
                if channel.endswith("position"):
                    local[:, "XYZ".index(channel[0])] = rows[:, column]
                else:
                    steps = [Rotation.from_euler(channel[0], angle, degrees=True) for angle in rows[:, column]]
                    turn = [before * step for before, step in zip(turn, steps, strict=True)]
                column += 1
            world[name] = place_of(stack[-1], local)
            turned = [above * below for above, below in zip(stack[-1][1], turn, strict=True)]
            stack.append((world[name], turned))
        elif token == "}":
            stack.pop()
    return world


def place_of(parent: tuple[np.ndarray, list[Rotation]], local: np.ndarray) -> np.ndarray:
    """Return the places (frame, 3) of points in the frames of a parent."""
    places, turns = parent
    return np.array([place + turn.apply(point) for place, turn, point in zip(places, turns, local, strict=True)])
