"""Layers of networks as functions of named weights: dense, graph convolution over space and time, graph GRU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from torch.nn.functional import pad

from pasdedeux.skeletons import BODY22

__all__ = [
    "Shapes",
    "dense",
    "divergence",
    "draw_latent",
    "first_values",
    "graph_gru",
    "mlp",
    "shapes_of_dense",
    "shapes_of_graph_gru",
    "shapes_of_mlp",
    "shapes_of_st_gcn",
    "st_gcn",
]

Narrow = npt.NDArray[np.float32]
Tensors = Mapping[str, torch.Tensor]
Shapes = dict[str, tuple[int, ...]]

_JOINTS = BODY22.num_joints
_LAST_LAYER = "out/1"


def _adjacency() -> torch.Tensor:
    """Return the skeleton's graph with every joint its own neighbour, normalised on both sides (22, 22)."""
    graph = torch.eye(_JOINTS)
    for parent, child in BODY22.bones:
        graph[parent, child] = graph[child, parent] = 1.0
    root = graph.sum(1).rsqrt()
    return root[:, None] * graph * root


_GRAPH = _adjacency()


def first_values(shapes: Shapes, generator: np.random.Generator) -> dict[str, Narrow]:
    """Return weights to begin with: matrices uniform within 1 / sqrt(inputs), biases 0, masks of edges 1.

    The last layer of a graph GRU begins at 0, so that what it decodes begins as no change at all.
    """
    values = {}
    for name, shape in shapes.items():
        if name.endswith("/edges"):
            values[name] = np.ones(shape, np.float32)
        elif len(shape) == 1 or name.endswith(f"/{_LAST_LAYER}/matrix"):
            values[name] = np.zeros(shape, np.float32)
        else:
            reach = 1.0 / np.sqrt(shape[0])
            values[name] = generator.uniform(-reach, reach, shape).astype(np.float32)
    return values


def shapes_of_dense(name: str, inputs: int, outputs: int) -> Shapes:
    """Return the shapes of a dense layer's weights."""
    return {f"{name}/matrix": (inputs, outputs), f"{name}/bias": (outputs,)}


def dense(weights: Tensors, name: str, x: torch.Tensor) -> torch.Tensor:
    """Return x W + b over the last axis."""
    return x @ weights[f"{name}/matrix"] + weights[f"{name}/bias"]


def shapes_of_mlp(name: str, sizes: Sequence[int]) -> Shapes:
    """Return the shapes of dense layers from each size to the next."""
    shapes: Shapes = {}
    for layer, (inputs, outputs) in enumerate(pairwise(sizes)):
        shapes |= shapes_of_dense(f"{name}/{layer}", inputs, outputs)
    return shapes


def mlp(weights: Tensors, name: str, x: torch.Tensor, count: int) -> torch.Tensor:
    """Return x through `count` dense layers, rectified between them."""
    for layer in range(count):
        x = dense(weights, f"{name}/{layer}", torch.relu(x) if layer else x)
    return x


def shapes_of_st_gcn(name: str, inputs: int, width: int, num_blocks: int, kernel: int) -> Shapes:
    """Return the shapes of `st_gcn`'s weights."""
    shapes: Shapes = {}
    for block in range(num_blocks):
        at = f"{name}/{block}"
        shapes |= {f"{at}/edges": (_JOINTS, _JOINTS)} | shapes_of_dense(f"{at}/space", inputs, width)
        shapes |= shapes_of_dense(f"{at}/time", kernel * width, width) | shapes_of_dense(f"{at}/past", inputs, width)
        inputs = width
    return shapes


def st_gcn(weights: Tensors, name: str, x: torch.Tensor, num_blocks: int, kernel: int) -> torch.Tensor:
    """Return features (W, 22, width) of motions (W, T, 22, inputs), the mean over time [Yan et al. 2018].

    A block is a graph convolution with a learned mask of edges, a convolution over `kernel` frames, and a residual;
    each block but the first looks at every second frame of the one before.
    """
    for block in range(num_blocks):
        at = f"{name}/{block}"
        step = 2 if block else 1
        near = (_GRAPH * weights[f"{at}/edges"]) @ x
        here = torch.relu(dense(weights, f"{at}/space", near))
        padded = pad(here, (0, 0, 0, 0, kernel // 2, kernel // 2))
        # Slices beside each other and not `unfold`, whose backward pass is a quarter of a training step.
        beside = torch.cat([padded[:, first : first + x.shape[1] : step] for first in range(kernel)], -1)
        x = torch.relu(dense(weights, f"{at}/time", beside) + dense(weights, f"{at}/past", x[:, ::step]))
    return x.mean(1)


def shapes_of_graph_gru(name: str, inputs: int, hidden: int, outputs: int) -> Shapes:
    """Return the shapes of `graph_gru`'s weights; `inputs` is what it is given, without its own last output."""
    shapes: Shapes = {f"{name}/edges": (_JOINTS, _JOINTS)} | shapes_of_dense(f"{name}/begin", inputs, hidden)
    for source, size in (("in", inputs), ("hidden", hidden)):
        shapes |= shapes_of_dense(f"{name}/{source}", size, 3 * hidden)
    return (
        shapes
        | {f"{name}/last/matrix": (outputs, 3 * hidden)}
        | shapes_of_mlp(f"{name}/out", (hidden, hidden, outputs))
    )


def graph_gru(weights: Tensors, name: str, known: torch.Tensor, num_frames: int) -> torch.Tensor:
    """Return outputs of frame after frame (W, T, 22, outputs), each the last one and what is added to it.

    Gated recurrent units of all joints whose states are mixed along a learned graph [Li et al. 2020, DMGNN].

    Args:
        weights: The weights; columns of gates are in the order reset, update, candidate.
        name: Name of the layer.
        known: What it is given, the same in every frame (W, 22, inputs).
        num_frames: T.
    """
    graph = _GRAPH * weights[f"{name}/edges"]
    state = torch.tanh(dense(weights, f"{name}/begin", known))
    given, into = dense(weights, f"{name}/in", known), weights[f"{name}/last/matrix"]
    last = known.new_zeros(*known.shape[:-1], into.shape[0])
    outputs = []
    for _ in range(num_frames):
        seen = (given + last @ into).chunk(3, -1)
        kept = dense(weights, f"{name}/hidden", graph @ state).chunk(3, -1)
        reset, update = torch.sigmoid(seen[0] + kept[0]), torch.sigmoid(seen[1] + kept[1])
        state = update * state + (1.0 - update) * torch.tanh(seen[2] + reset * kept[2])
        last = last + mlp(weights, f"{name}/out", state, 2)
        outputs.append(last)
    return torch.stack(outputs, 1)


def draw_latent(found: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """Return z of means and logarithms of variances (..., 2 Z) and unit noise (..., Z)."""
    mean, log_variance = found.chunk(2, -1)
    return mean + noise * torch.exp(0.5 * log_variance)


def divergence(found: torch.Tensor) -> torch.Tensor:
    """Return the KL divergence from the unit normal, summed over latent axes, mean over the batch."""
    mean, log_variance = found.chunk(2, -1)
    return 0.5 * (mean**2 + torch.exp(log_variance) - 1.0 - log_variance).sum(-1).mean()
