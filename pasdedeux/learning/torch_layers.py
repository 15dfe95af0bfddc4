"""Layers of networks as functions of named weights: dense, graph convolution over space and time, graph GRU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from torch.nn.functional import layer_norm, pad, scaled_dot_product_attention

from pasdedeux.skeletons import Skeleton

Narrow = npt.NDArray[np.float32]
Tensors = Mapping[str, torch.Tensor]
Shapes = dict[str, tuple[int, ...]]

NUM_SINES = 8
"""Numbers that say which frame it is, where nothing else needs more."""
_LAST_LAYER = "out/1"
_NUM_HEADS = 4


@lru_cache(maxsize=4)
def _graph(skeleton: Skeleton) -> torch.Tensor:
    """Return the skeleton's graph with every joint its own neighbour, normalised on both sides (J, J)."""
    graph = torch.eye(skeleton.num_joints)
    for parent, child in skeleton.bones:
        graph[parent, child] = graph[child, parent] = 1.0
    root = graph.sum(1).rsqrt()
    return root[:, None] * graph * root


def first_values(shapes: Shapes, generator: np.random.Generator) -> dict[str, Narrow]:
    """Return weights to begin with: matrices uniform within 1 / sqrt(inputs), biases 0, masks of edges 1.

    The last layer of what decodes begins at 0, so that what it decodes begins as no change at all.
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


def tensors(arrays: Mapping[str, Narrow]) -> dict[str, torch.Tensor]:
    """Return arrays as tensors that share their memory."""
    return {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in arrays.items()}


def sines(num_frames: int, size: int = NUM_SINES) -> torch.Tensor:
    """Return which frame it is as sines and cosines (T, size) of 10000^(-2 k / size) t [Vaswani et al. 2017]."""
    rates = 10000.0 ** (-2.0 * torch.arange(size // 2) / size)
    phases = torch.arange(num_frames)[:, None] * rates
    return torch.cat([phases.sin(), phases.cos()], -1)


def shapes_of_look_at(name: str, width: int) -> Shapes:
    """Return the shapes of `look_at`'s weights."""
    shapes = shapes_of_mlp(f"{name}/wide", (width, 2 * width, width))
    for part in ("query", "key", "value", "mixed"):
        shapes |= shapes_of_dense(f"{name}/{part}", width, width)
    return shapes


def look_at(weights: Tensors, name: str, x: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """Return tokens (W, T, width) after they looked at others (W, S, width), or themselves [Vaswani et al. 2017].

    Attention of four heads and two dense layers, each added and normalised.
    """

    def heads(part: str, tokens: torch.Tensor) -> torch.Tensor:
        return dense(weights, f"{name}/{part}", tokens).unflatten(-1, (_NUM_HEADS, -1)).transpose(1, 2)

    found = scaled_dot_product_attention(heads("query", x), heads("key", seen), heads("value", seen))
    width = x.shape[-1:]
    x = layer_norm(x + dense(weights, f"{name}/mixed", found.transpose(1, 2).flatten(2)), width)
    return layer_norm(x + mlp(weights, f"{name}/wide", x, 2), width)


def shapes_of_gru(name: str, inputs: int, hidden: int) -> Shapes:
    """Return the shapes of `gru`'s weights."""
    return shapes_of_dense(f"{name}/in", inputs, 3 * hidden) | shapes_of_dense(f"{name}/hidden", hidden, 3 * hidden)


def gru(weights: Tensors, name: str, x: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
    """Return the next state (W, hidden) of a gated recurrent unit that is given x (W, inputs) [Cho et al. 2014]."""
    return _next_state(dense(weights, f"{name}/in", x), dense(weights, f"{name}/hidden", state), state)


def _next_state(given: torch.Tensor, kept: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
    """Return the state after gates, in the order reset, update, candidate, of what is given and of the state before."""
    of_given, of_state = given.chunk(3, -1), kept.chunk(3, -1)
    reset, update = torch.sigmoid(of_given[0] + of_state[0]), torch.sigmoid(of_given[1] + of_state[1])
    return update * state + (1.0 - update) * torch.tanh(of_given[2] + reset * of_state[2])


def shapes_of_st_gcn(name: str, joints: int, inputs: int, width: int, num_blocks: int, kernel: int) -> Shapes:
    """Return the shapes of `st_gcn`'s weights."""
    shapes: Shapes = {}
    for block in range(num_blocks):
        at = f"{name}/{block}"
        shapes |= {f"{at}/edges": (joints, joints)} | shapes_of_dense(f"{at}/space", inputs, width)
        shapes |= shapes_of_dense(f"{at}/time", kernel * width, width) | shapes_of_dense(f"{at}/past", inputs, width)
        inputs = width
    return shapes


def st_gcn(
    weights: Tensors,
    name: str,
    skeleton: Skeleton,
    x: torch.Tensor,
    num_blocks: int,
    kernel: int,
    *,
    is_pooled: bool = True,
) -> torch.Tensor:
    """Return features (W, J, width) of motions (W, T, J, inputs), the mean over time [Yan et al. 2018].

    A block is a graph convolution with a learned mask of edges, a convolution over `kernel` frames, and a residual;
    each block but the first looks at every second frame of the one before.  What is not pooled keeps all frames,
    (W, T, J, width).
    """
    for block in range(num_blocks):
        at = f"{name}/{block}"
        step = 2 if block and is_pooled else 1
        near = (_graph(skeleton).to(x.device) * weights[f"{at}/edges"]) @ x
        here = torch.relu(dense(weights, f"{at}/space", near))
        padded = pad(here, (0, 0, 0, 0, kernel // 2, kernel // 2))
        # Slices beside each other and not `unfold`, whose backward pass is a quarter of a training step.
        beside = torch.cat([padded[:, first : first + x.shape[1] : step] for first in range(kernel)], -1)
        x = torch.relu(dense(weights, f"{at}/time", beside) + dense(weights, f"{at}/past", x[:, ::step]))
    return x.mean(1) if is_pooled else x


def shapes_of_graph_gru(name: str, joints: int, inputs: int, hidden: int, outputs: int) -> Shapes:
    """Return the shapes of `graph_gru`'s weights; `inputs` is what it is given, without its own last output."""
    shapes: Shapes = {f"{name}/edges": (joints, joints)} | shapes_of_dense(f"{name}/begin", inputs, hidden)
    for source, size in (("in", inputs), ("hidden", hidden)):
        shapes |= shapes_of_dense(f"{name}/{source}", size, 3 * hidden)
    return (
        shapes
        | {f"{name}/last/matrix": (outputs, 3 * hidden)}
        | shapes_of_mlp(f"{name}/out", (hidden, hidden, outputs))
    )


def graph_gru(weights: Tensors, name: str, skeleton: Skeleton, known: torch.Tensor, num_frames: int) -> torch.Tensor:
    """Return outputs of frame after frame (W, T, J, outputs), each the last one and what is added to it.

    Gated recurrent units of all joints whose states are mixed along a learned graph [Li et al. 2020, DMGNN].

    Args:
        weights: The weights; columns of gates are in the order reset, update, candidate.
        name: Name of the layer.
        skeleton: Skeleton of J joints.
        known: What it is given, the same in every frame (W, J, inputs).
        num_frames: T.
    """
    graph = _graph(skeleton).to(known.device) * weights[f"{name}/edges"]
    state = torch.tanh(dense(weights, f"{name}/begin", known))
    given, into = dense(weights, f"{name}/in", known), weights[f"{name}/last/matrix"]
    last = known.new_zeros(*known.shape[:-1], into.shape[0])
    outputs = []
    for _ in range(num_frames):
        state = _next_state(given + last @ into, dense(weights, f"{name}/hidden", graph @ state), state)
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
