"""The networks of `actor_like` and `action2motion_like`; their settings describe them.

Both give the change of both people from the template, as three numbers a joint, for a class and the template's first
and last frame.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pasdedeux.learning.networks.layers import Batch, WindowNetwork, divergence, draw_latent, mlp, sines
from pasdedeux.learning.settings import Action2MotionLikeConfig, ActorLikeConfig

_NUM_HEADS = 4


class ActorNetwork(WindowNetwork):
    """Transformers that encode and decode a window."""

    def __init__(self, settings: ActorLikeConfig, num_classes: int, num_joints: int) -> None:
        super().__init__()
        self.settings = settings
        width, pose = settings.width, 6 * num_joints
        self.tokens = nn.Parameter(torch.empty(num_classes, 2, width))
        self.bias = nn.Parameter(torch.empty(num_classes, width))
        self.pose = nn.Linear(pose, width)
        self.ends = nn.Linear(2 * pose, width)
        self.encoder = nn.Sequential(
            *(
                nn.TransformerEncoderLayer(width, _NUM_HEADS, 2 * width, 0.0, nn.ReLU(), batch_first=True)
                for _ in range(settings.num_blocks)
            )
        )
        self.decoder = nn.ModuleList(
            nn.TransformerDecoderLayer(width, _NUM_HEADS, 2 * width, 0.0, nn.ReLU(), batch_first=True)
            for _ in range(settings.num_blocks)
        )
        self.out = nn.Linear(width, pose)

    def noise_shapes(self, num_frames: int) -> dict[str, tuple[int, ...]]:
        """Return the shape of z."""
        return {"z": (self.settings.width,)}

    def loss(self, batch: Batch) -> Tensor:
        """Return the mean squared error and the divergence, weighed."""
        encoded = self._encode(batch)
        moved = self._decode(batch, draw_latent(encoded, batch["noise_z"]))
        return ((moved - _change(batch)) ** 2).mean() + self.settings.divergence_weight * divergence(encoded)

    def forward(self, batch: Batch, *, is_posterior: bool = False) -> Tensor:
        """Return how far both move, by z of the noise or of the answer."""
        z = self._encode(batch).chunk(2, -1)[0] if is_posterior else batch["noise_z"]
        return _people(self._decode(batch, z))

    def _encode(self, batch: Batch) -> Tensor:
        queries = torch.einsum("wc,ctn->wtn", batch["condition"], self.tokens)
        tokens = torch.cat([queries, self.pose(_change(batch))], 1)
        times = sines(tokens.shape[1], self.settings.width).to(tokens.device)
        return self.encoder(tokens + times)[:, :2].flatten(1)

    def _decode(self, batch: Batch, z: Tensor) -> Tensor:
        seen = torch.stack([z + batch["condition"] @ self.bias, self.ends(_ends(batch))], 1)
        times = sines(batch["template_m"].shape[1], self.settings.width).to(z.device)
        tokens = times.expand(len(z), -1, -1)
        for layer in self.decoder:
            tokens = layer(tokens, seen)
        return self.out(tokens)


class Action2MotionNetwork(WindowNetwork):
    """Recurrent networks that encode and decode frame after frame."""

    def __init__(self, settings: Action2MotionLikeConfig, num_classes: int, num_joints: int) -> None:
        super().__init__()
        self.settings = settings
        hidden, size, pose = settings.hidden, settings.latent_size, 6 * num_joints
        self.known = nn.Linear(num_classes, hidden, bias=False)
        self.ends = nn.Linear(2 * pose, hidden)
        self.out = mlp(hidden, hidden, pose)
        self.prior, self.prior_z = nn.GRUCell(pose + hidden + 1, hidden), nn.Linear(hidden, 2 * size)
        self.posterior, self.posterior_z = nn.GRUCell(pose + hidden + 1, hidden), nn.Linear(hidden, 2 * size)
        self.first = nn.GRUCell(pose + size + hidden + 1, hidden)
        self.second = nn.GRUCell(hidden, hidden)

    def noise_shapes(self, num_frames: int) -> dict[str, tuple[int, ...]]:
        """Return the shape of z of all frames."""
        return {"z": (num_frames, self.settings.latent_size)}

    def loss(self, batch: Batch) -> Tensor:
        """Return the mean squared error and the divergence of frames from the prior, weighed."""
        change = _change(batch)
        moved, apart = self._unroll(batch, change)
        return ((moved - change) ** 2).mean() + self.settings.divergence_weight * apart

    def forward(self, batch: Batch, *, is_posterior: bool = False) -> Tensor:
        """Return how far both move, by z of the prior and the noise or of the answer."""
        return _people(self._unroll(batch, _change(batch) if is_posterior else None)[0])

    def _unroll(self, batch: Batch, change: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the change (W, T, 6 J), and how far z's normals are from the prior: 0 where that is drawn from."""
        known = self.known(batch["condition"]) + self.ends(_ends(batch))
        prior = posterior = first = second = torch.zeros_like(known)
        num_frames, num_values = batch["template_m"].flatten(2).shape[1:]
        last, apart, unrolled = known.new_zeros(len(known), num_values), known.new_zeros(()), []
        for frame in range(num_frames):
            here = torch.cat([known, known.new_full((len(known), 1), frame / num_frames)], -1)
            prior = self.prior(torch.cat([last, here], -1), prior)
            z_of = drawn_from = self.prior_z(prior)
            if change is not None:
                posterior = self.posterior(torch.cat([change[:, frame], here], -1), posterior)
                z_of = self.posterior_z(posterior)
                apart = apart + _divergence_between(z_of, drawn_from) / num_frames
            z = draw_latent(z_of, batch["noise_z"][:, frame])
            first = self.first(torch.cat([last, z, here], -1), first)
            second = self.second(first, second)
            last = self.out(second)
            unrolled.append(last)
        return torch.stack(unrolled, 1), apart


def _divergence_between(posterior: Tensor, prior: Tensor) -> Tensor:
    """Return the KL divergence of normals from others, each as means and logarithms of variances, mean over windows."""
    (mean, log_variance), (middle, log_spread) = posterior.chunk(2, -1), prior.chunk(2, -1)
    ratio = (log_variance.exp() + (mean - middle) ** 2) / log_spread.exp()
    return 0.5 * (log_spread - log_variance + ratio - 1.0).sum(-1).mean()


def _change(batch: Batch) -> Tensor:
    """Return how far both move from the template (W, T, 6 J)."""
    return (batch["motion_m"] - batch["template_m"]).flatten(2)


def _ends(batch: Batch) -> Tensor:
    """Return the template's first and last frame (W, 12 J)."""
    return batch["template_m"][:, [0, -1]].flatten(1)


def _people(moved: Tensor) -> Tensor:
    return moved.unflatten(-1, (2, -1, 3))
