"""Layers that several networks share: dense, graph convolution over space and time, graph GRU, latents."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from pasdedeux.learning.model import Arrays, check_arrays
from pasdedeux.skeletons import Skeleton

Narrow = npt.NDArray[np.float32]
Batch = Mapping[str, Tensor]

NUM_SINES = 8
"""Size of the encoding of frame numbers if nothing else requires more."""


class WindowNetwork(nn.Module):
    """The network of one variational autoencoder of windows.

    Batches hold `template_m`, `motion_m` (W, T, 2, J, 3), metres, `condition` (W, n), and unit noise `noise_...`.
    """

    def noise_shapes(self, num_frames: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the unit noise that a window takes, by name."""
        raise NotImplementedError

    def loss(self, batch: Batch) -> Tensor:
        """Return the loss of a batch."""
        raise NotImplementedError

    def forward(self, batch: Batch, *, is_posterior: bool = False) -> Tensor:
        """Return how far both move from the template (W, T, 2, J, 3), metres.

        z comes from the batch's noise (0 is the mean of the prior), or is the encoders' mean for the answer.
        """
        raise NotImplementedError

    def displacement(self, batch: Mapping[str, Narrow], *, is_posterior: bool = False) -> Narrow:
        """Return `forward` of arrays, on one thread."""
        torch.set_num_threads(1)
        with torch.no_grad():
            return np.asarray(self({name: torch.tensor(a) for name, a in batch.items()}, is_posterior=is_posterior))


def restore_network(name: str, build: Callable[[], WindowNetwork], arrays: Arrays) -> WindowNetwork:
    """Return a network with the parameters that a model's arrays hold.

    Raises:
        InputError: They are of another size.
    """
    with torch.device("meta"):  # shapes alone: nothing is allocated for sizes that the arrays do not have
        shapes = {key: tuple(values.shape) for key, values in build().state_dict().items()}
    check_arrays(name, arrays, shapes)
    network = build()
    network.load_state_dict({key: torch.tensor(arrays[key], dtype=torch.float32) for key in shapes})
    return network


def mlp(*sizes: int, rectifier: type[nn.Module] = nn.ReLU) -> nn.Sequential:
    """Return dense layers from each size to the next, rectified between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [rectifier(), nn.Linear(inputs, outputs)]
    return nn.Sequential(*layers[1:])


def activity(network: WindowNetwork, batch: Batch) -> dict[str, float]:
    """Return the share of outputs above 0 while a loss is computed, percent, by the name of the rectifier."""
    parts: dict[str, list[float]] = defaultdict(list)
    hooks = [
        layer.register_forward_hook(
            lambda _, __, output, name=name: parts[name].append(float((output > 0.0).float().mean()))
        )
        for name, layer in network.named_modules()
        if isinstance(layer, nn.ReLU | nn.GELU)
    ]
    with torch.no_grad():
        network.loss(batch)
    for hook in hooks:
        hook.remove()
    return {name: 100.0 * float(np.mean(shares)) for name, shares in parts.items()}


def initialise(network: nn.Module, generator: np.random.Generator) -> None:
    """Draw first parameters: matrices uniform within 1 / sqrt(inputs), biases 0, masks of edges and scales of norms 1.

    The last layer of a decoder, `out`, starts at 0, so that the decoded change is 0 at first.
    """
    for name, parameter in network.named_parameters():
        value = np.zeros(parameter.shape, np.float32)
        if name.endswith("edges") or (parameter.ndim == 1 and name.endswith("weight")):
            value += 1.0
        elif parameter.ndim > 1 and not name.endswith(("out.weight", "out.2.weight")):
            reach = 1.0 / np.sqrt(value.shape[-1])
            value = generator.uniform(-reach, reach, value.T.shape).astype(np.float32).T
        parameter.data.copy_(torch.from_numpy(value))


def sines(num_frames: int, size: int = NUM_SINES) -> Tensor:
    """Return frame numbers as sines and cosines (T, size) of 10000^(-2 k / size) t [Vaswani et al. 2017]."""
    rates = 10000.0 ** (-2.0 * torch.arange(size // 2) / size)
    phases = torch.arange(num_frames)[:, None] * rates
    return torch.cat([phases.sin(), phases.cos()], -1)


def _graph(skeleton: Skeleton) -> Tensor:
    """Return the skeleton's graph with every joint its own neighbour, normalised on both sides (J, J)."""
    graph = torch.eye(skeleton.num_joints)
    for parent, child in skeleton.bones:
        graph[parent, child] = graph[child, parent] = 1.0
    root = graph.sum(1).rsqrt()
    return root[:, None] * graph * root


class _LearnedGraph(nn.Module):
    """A skeleton's graph with a learned mask of its edges."""

    graph: Tensor

    def __init__(self, skeleton: Skeleton) -> None:
        super().__init__()
        self.register_buffer("graph", _graph(skeleton), persistent=False)
        self.edges = nn.Parameter(torch.empty(skeleton.num_joints, skeleton.num_joints))

    def forward(self, x: Tensor) -> Tensor:
        """Return the mix (..., J, n) of each joint's neighbours."""
        return (self.graph * self.edges) @ x


class _StGcnBlock(nn.Module):
    """A graph convolution, a convolution over `kernel` frames, of which every `step`-th is kept, and a residual.

    Layer norm stands for the batch norm of ST-GCN: it needs no running figures, and without either layers die.
    """

    def __init__(self, skeleton: Skeleton, inputs: int, width: int, kernel: int, step: int) -> None:
        super().__init__()
        self.kernel, self.step = kernel, step
        self.mix = _LearnedGraph(skeleton)
        self.space = nn.Linear(inputs, width)
        self.time = nn.Linear(kernel * width, width)
        self.past = nn.Linear(inputs, width)
        self.spread, self.moved = (nn.Sequential(nn.LayerNorm(width), nn.ReLU()) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        here = self.spread(self.space(self.mix(x)))
        padded = pad(here, (0, 0, 0, 0, self.kernel // 2, self.kernel // 2))
        # Slices beside each other and not `unfold`, whose backward pass is a quarter of a training step.
        beside = torch.cat([padded[:, first : first + x.shape[1] : self.step] for first in range(self.kernel)], -1)
        return self.moved(self.time(beside) + self.past(x[:, :: self.step]))


class StGcn(nn.Module):
    """Features (W, J, width) of motions (W, T, J, inputs), the mean over time [Yan et al. 2018].

    Each block but the first keeps every second frame of the one before.  Without pooling all frames are kept, (W, T, J,
    width).
    """

    def __init__(
        self, skeleton: Skeleton, inputs: int, width: int, num_blocks: int, kernel: int, *, is_pooled: bool = True
    ) -> None:
        super().__init__()
        self.is_pooled = is_pooled
        self.blocks = nn.Sequential(
            *(
                _StGcnBlock(skeleton, width if block else inputs, width, kernel, 2 if block and is_pooled else 1)
                for block in range(num_blocks)
            )
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return the features."""
        x = self.blocks(x)
        return x.mean(1) if self.is_pooled else x


class GraphGru(nn.Module):
    """Outputs frame by frame (W, T, J, outputs), each the previous one plus a change.

    Gated recurrent units of all joints whose states are mixed along a learned graph [Li et al. 2020, DMGNN]; columns of
    gates are in the order reset, update, candidate.
    """

    def __init__(self, skeleton: Skeleton, inputs: int, hidden: int, outputs: int, each: int = 0) -> None:
        super().__init__()
        self.mix = _LearnedGraph(skeleton)
        self.begin = nn.Linear(inputs, hidden)
        self.given = nn.Linear(inputs, 3 * hidden)
        self.hidden = nn.Linear(hidden, 3 * hidden)
        self.last = nn.Linear(outputs, 3 * hidden, bias=False)
        if each:
            self.each = nn.Linear(each, 3 * hidden, bias=False)
        self.out = mlp(hidden, hidden, outputs, rectifier=nn.GELU)

    def forward(self, known: Tensor, num_frames: int, each: Tensor | None = None) -> Tensor:
        """Unroll over frames, given inputs of all frames (W, J, inputs) and of each frame (W, T, J, each)."""
        state, given = torch.tanh(self.begin(known)), self.given(known)
        frames = [given] * num_frames if each is None else (given[:, None] + self.each(each)).unbind(1)
        last = known.new_zeros(*known.shape[:-1], self.last.in_features)
        outputs = []
        for here in frames:
            state = _next_state(here + self.last(last), self.hidden(self.mix(state)), state)
            last = last + self.out(state)
            outputs.append(last)
        return torch.stack(outputs, 1)


def _next_state(given: Tensor, kept: Tensor, state: Tensor) -> Tensor:
    """Return the state after the gates, from the inputs and the previous state."""
    of_given, of_state = given.chunk(3, -1), kept.chunk(3, -1)
    reset, update = torch.sigmoid(of_given[0] + of_state[0]), torch.sigmoid(of_given[1] + of_state[1])
    return update * state + (1.0 - update) * torch.tanh(of_given[2] + reset * of_state[2])


def draw_latent(posterior: Tensor, noise: Tensor) -> Tensor:
    """Return z of means and logarithms of variances (..., 2 Z) and unit noise (..., Z)."""
    mean, log_variance = posterior.chunk(2, -1)
    return mean + noise * torch.exp(0.5 * log_variance)


def divergence(posterior: Tensor) -> Tensor:
    """Return the KL divergence from the unit normal, summed over latent axes, mean over the batch."""
    return axis_divergence(posterior).sum(-1).mean()


def axis_divergence(posterior: Tensor) -> Tensor:
    """Return the KL divergence of each latent axis (..., Z) from the unit normal."""
    mean, log_variance = posterior.chunk(2, -1)
    return 0.5 * (mean**2 + torch.exp(log_variance) - 1.0 - log_variance)
