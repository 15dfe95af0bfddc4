"""ONNX networks with the inputs and outputs of detectors: they see the brightest place of an image."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OFFSETS_PX = np.stack([np.linspace(-20, 20, 17), np.linspace(-60, 60, 17)], axis=-1)
"""Where the keypoints of a person are, from the bright place, in pixels of the network's image."""


def rtmo(*, scores: tuple[float, ...] = (0.9, 0.1), num_keypoints: int = 17, size: int = 192) -> bytes:
    """One person at the brightest place for each score."""
    count = len(scores)
    offsets = np.zeros((1, count, num_keypoints, 3), np.float32)
    offsets[..., :2] = OFFSETS_PX[:num_keypoints]
    offsets[..., 2] = 0.8
    dets = np.zeros((1, count, 5), np.float32)
    dets[0, :, 4] = scores
    zero = np.zeros((1, 1, 1, 1), np.float32)
    nodes = [
        *_place(),
        helper.make_node("Concat", ["x", "y", "zero"], ["place"], axis=3),
        helper.make_node("Add", ["place", "offsets"], ["keypoints"]),
        helper.make_node("Identity", ["fixed"], ["dets"]),
    ]
    shapes = {"dets": [1, count, 5], "keypoints": [1, count, num_keypoints, 3]}
    return _model(nodes, (size, size), shapes, {"offsets": offsets, "fixed": dets, "zero": zero})


def yolox(*, size: int = 192) -> bytes:
    """A box 80 x 140 round the brightest place, a person, and one of another class."""
    corners = np.array([[[-40, -70, 40, 70, 0.9], [-9, -9, 9, 9, 0.9]]], np.float32)
    mask = np.array([[[1, 1, 1, 1, 0]]], np.float32)
    nodes = [
        *_place(),
        helper.make_node("Concat", ["x", "y", "x", "y", "x"], ["four"], axis=3),
        helper.make_node("Reshape", ["four", "flat"], ["centre"]),
        helper.make_node("Mul", ["centre", "mask"], ["moved"]),
        helper.make_node("Add", ["moved", "corners"], ["dets"]),
        helper.make_node("Identity", ["classes"], ["labels"]),
    ]
    constants = {"corners": corners, "mask": mask, "flat": np.array([1, 1, 5]), "classes": np.array([[0, 7]])}
    return _model(nodes, (size, size), {"dets": [1, 2, 5], "labels": [1, 2]}, constants)


def rtmpose(*, num_keypoints: int = 17) -> bytes:
    """Every keypoint at the brightest place of a box 192 x 256."""
    height, width = 256, 192
    nodes = [helper.make_node("ReduceMean", ["input"], ["grey"], axes=[1], keepdims=0)]
    for name, axis in (("x", 1), ("y", 2)):
        nodes += [
            helper.make_node("ReduceMax", ["grey"], [f"line_{name}"], axes=[axis], keepdims=0),
            helper.make_node("Reshape", [f"line_{name}", f"column_{name}"], [f"thin_{name}"]),
            helper.make_node("Concat", [f"thin_{name}", f"low_{name}"], [f"twice_{name}"], axis=2),
            helper.make_node("Reshape", [f"twice_{name}", f"flat_{name}"], [f"one_{name}"]),
            helper.make_node("Expand", [f"one_{name}", f"all_{name}"], [f"simcc_{name}"]),
        ]
    constants = {}
    for name, side in (("x", width), ("y", height)):
        constants |= {
            f"column_{name}": np.array([1, side, 1]),
            f"low_{name}": np.full((1, side, 1), -9, np.float32),
            f"flat_{name}": np.array([1, 1, 2 * side]),
            f"all_{name}": np.array([1, num_keypoints, 2 * side]),
        }
    shapes = {"simcc_x": [1, num_keypoints, 2 * width], "simcc_y": [1, num_keypoints, 2 * height]}
    return _model(nodes, (width, height), shapes, constants)


def movenet(*, score: float = 0.9) -> bytes:
    """One of six people, every keypoint at the brightest place of an image of any size, as MoveNet has them."""
    nodes = [
        helper.make_node("Cast", ["input"], ["floats"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["floats"], ["grey"], axes=[3], keepdims=0),
        helper.make_node("Shape", ["input"], ["shape"]),
    ]
    for name, over, axis in (("y", 2, 1), ("x", 1, 2)):
        nodes += [
            helper.make_node("ReduceMax", ["grey"], [f"line_{name}"], axes=[over], keepdims=1),
            helper.make_node("ArgMax", [f"line_{name}"], [f"index_{name}"], axis=axis, keepdims=1),
            helper.make_node("Cast", [f"index_{name}"], [f"at_{name}"], to=TensorProto.FLOAT),
            helper.make_node("Gather", ["shape", f"axis_{name}"], [f"whole_{name}"]),
            helper.make_node("Cast", [f"whole_{name}"], [f"side_{name}"], to=TensorProto.FLOAT),
            helper.make_node("Div", [f"at_{name}", f"side_{name}"], [f"share_{name}"]),
        ]
    nodes += [
        helper.make_node("Concat", [*["share_y", "share_x", "sure"] * 17, *["box"] * 4, "sure"], ["one"], axis=2),
        helper.make_node("Concat", ["one", "nobody"], ["output_0"], axis=1),
    ]
    constants = {
        "axis_y": np.array([1]),
        "axis_x": np.array([2]),
        "sure": np.full((1, 1, 1), score, np.float32),
        "box": np.zeros((1, 1, 1), np.float32),
        "nobody": np.zeros((1, 5, 56), np.float32),
    }
    taken = helper.make_tensor_value_info("input", TensorProto.INT32, [1, "height", "width", 3])
    given = helper.make_tensor_value_info("output_0", TensorProto.FLOAT, [1, 6, 56])
    values = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "tiny", [taken], [given], values)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8).SerializeToString()


def half() -> bytes:
    """A network of 16-bit floats, which are not read."""
    names = ("input", "dets", "keypoints")
    taken, *given = (helper.make_tensor_value_info(name, TensorProto.FLOAT16, [1, 3, 8, 8]) for name in names)
    nodes = [helper.make_node("Identity", ["input"], [name]) for name in names[1:]]
    graph = helper.make_graph(nodes, "half", [taken], given)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8).SerializeToString()


def _place() -> list[onnx.NodeProto]:
    """Return the nodes that give x and y (1, 1, 1, 1) of the brightest pixel."""
    nodes = [helper.make_node("ReduceMean", ["input"], ["grey"], axes=[1], keepdims=1)]
    for name, over, axis in (("x", 2, 3), ("y", 3, 2)):
        nodes += [
            helper.make_node("ReduceMax", ["grey"], [f"line_{name}"], axes=[over], keepdims=1),
            helper.make_node("ArgMax", [f"line_{name}"], [f"index_{name}"], axis=axis, keepdims=1),
            helper.make_node("Cast", [f"index_{name}"], [name], to=TensorProto.FLOAT),
        ]
    return nodes


def _model(
    nodes: list[onnx.NodeProto],
    size: tuple[int, int],
    shapes: dict[str, list[int]],
    constants: dict[str, np.ndarray],
) -> bytes:
    kinds = {"labels": TensorProto.INT64}
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, [1, 3, size[1], size[0]])],
        [
            helper.make_tensor_value_info(name, kinds.get(name, TensorProto.FLOAT), shape)
            for name, shape in shapes.items()
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8).SerializeToString()
