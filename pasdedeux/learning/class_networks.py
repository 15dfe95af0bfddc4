"""The networks of `actor_like` and `action2motion_like`, in torch; what they are is said with their settings.

Both give the change of both people from the template, as three numbers a joint, for a class and the template's first
and last frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pasdedeux.learning.paper_settings import Action2MotionLikeConfig, ActorLikeConfig
from pasdedeux.learning.torch_layers import (
    Shapes,
    Tensors,
    dense,
    divergence,
    draw_latent,
    gru,
    look_at,
    mlp,
    shapes_of_dense,
    shapes_of_gru,
    shapes_of_look_at,
    shapes_of_mlp,
    sines,
)
from pasdedeux.learning.window_vae import WindowNetworks


@dataclass(frozen=True)
class ActorNetworks(WindowNetworks):
    """Transformers that encode and decode a window."""

    settings: ActorLikeConfig
    num_classes: int
    num_joints: int

    def shapes(self) -> Shapes:
        """Return the shapes of all weights."""
        width, pose = self.settings.width, 6 * self.num_joints
        shapes: Shapes = {f"class/{what}/matrix": (self.num_classes, width) for what in ("mean", "variance", "bias")}
        shapes |= shapes_of_dense("pose", pose, width) | shapes_of_dense("ends", 2 * pose, width)
        shapes |= shapes_of_mlp("decoder/out", (width, width, pose))
        for block in range(self.settings.num_blocks):
            for part in ("encoder", "decoder", "memory"):
                shapes |= shapes_of_look_at(f"{part}/{block}", width)
        return shapes

    def noise_shapes(self, num_frames: int) -> Shapes:
        """Return the shape of z."""
        return {"z": (self.settings.width,)}

    def loss(self, weights: Tensors, batch: Tensors) -> torch.Tensor:
        """Return the mean squared error and the divergence, weighed."""
        found = self._encode(weights, batch)
        moved = self._decode(weights, batch, draw_latent(found, batch["noise_z"]))
        return ((moved - _change(batch)) ** 2).mean() + self.settings.divergence_weight * divergence(found)

    def move(self, weights: Tensors, batch: Tensors, *, is_known: bool) -> torch.Tensor:
        """Return how far both move, by z of the noise or of the answer."""
        z = self._encode(weights, batch).chunk(2, -1)[0] if is_known else batch["noise_z"]
        return _people(self._decode(weights, batch, z))

    def _encode(self, weights: Tensors, batch: Tensors) -> torch.Tensor:
        asked = [batch["condition"] @ weights[f"class/{what}/matrix"] for what in ("mean", "variance")]
        tokens = torch.cat([torch.stack(asked, 1), dense(weights, "pose", _change(batch))], 1)
        tokens = tokens + sines(tokens.shape[1], self.settings.width).to(tokens.device)
        for block in range(self.settings.num_blocks):
            tokens = look_at(weights, f"encoder/{block}", tokens, tokens)
        return tokens[:, :2].flatten(1)

    def _decode(self, weights: Tensors, batch: Tensors, z: torch.Tensor) -> torch.Tensor:
        own = z + batch["condition"] @ weights["class/bias/matrix"]
        seen = torch.stack([own, dense(weights, "ends", _ends(batch))], 1)
        times = sines(batch["template_m"].shape[1], self.settings.width).to(z.device)
        tokens = times.expand(len(z), -1, -1)
        for block in range(self.settings.num_blocks):
            tokens = look_at(weights, f"decoder/{block}", tokens, tokens)
            tokens = look_at(weights, f"memory/{block}", tokens, seen)
        return mlp(weights, "decoder/out", tokens, 2)


@dataclass(frozen=True)
class Action2MotionNetworks(WindowNetworks):
    """Recurrent networks that encode and decode frame after frame."""

    settings: Action2MotionLikeConfig
    num_classes: int
    num_joints: int

    def shapes(self) -> Shapes:
        """Return the shapes of all weights."""
        hidden, size, pose = self.settings.hidden, self.settings.latent_size, 6 * self.num_joints
        shapes: Shapes = {"class/known/matrix": (self.num_classes, hidden)}
        shapes |= shapes_of_dense("ends", 2 * pose, hidden) | shapes_of_mlp("decoder/out", (hidden, hidden, pose))
        for name in ("prior", "posterior"):
            shapes |= shapes_of_gru(name, pose + hidden + 1, hidden) | shapes_of_dense(f"{name}/z", hidden, 2 * size)
        return (
            shapes | shapes_of_gru("first", pose + size + hidden + 1, hidden) | shapes_of_gru("second", hidden, hidden)
        )

    def noise_shapes(self, num_frames: int) -> Shapes:
        """Return the shape of z of all frames."""
        return {"z": (num_frames, self.settings.latent_size)}

    def loss(self, weights: Tensors, batch: Tensors) -> torch.Tensor:
        """Return the mean squared error and the divergence of frames from the prior, weighed."""
        change = _change(batch)
        moved, apart = self._unroll(weights, batch, change)
        return ((moved - change) ** 2).mean() + self.settings.divergence_weight * apart

    def move(self, weights: Tensors, batch: Tensors, *, is_known: bool) -> torch.Tensor:
        """Return how far both move, by z of the prior and the noise or of the answer."""
        return _people(self._unroll(weights, batch, _change(batch) if is_known else None)[0])

    def _unroll(
        self, weights: Tensors, batch: Tensors, change: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the change (W, T, 6 J), and how far z's normals are from the prior: 0 where that is drawn from."""
        known = batch["condition"] @ weights["class/known/matrix"] + dense(weights, "ends", _ends(batch))
        last, apart, found = known.new_zeros(len(known), 6 * self.num_joints), known.new_zeros(()), []
        states = {name: torch.zeros_like(known) for name in ("prior", "posterior", "first", "second")}
        num_frames = batch["template_m"].shape[1]
        for frame in range(num_frames):
            here = torch.cat([known, known.new_full((len(known), 1), frame / num_frames)], -1)
            z_of = prior = self._latent(weights, "prior", states, torch.cat([last, here], -1))
            if change is not None:
                z_of = self._latent(weights, "posterior", states, torch.cat([change[:, frame], here], -1))
                apart = apart + _divergence_between(z_of, prior) / num_frames
            z = draw_latent(z_of, batch["noise_z"][:, frame])
            states["first"] = gru(weights, "first", torch.cat([last, z, here], -1), states["first"])
            states["second"] = gru(weights, "second", states["first"], states["second"])
            last = mlp(weights, "decoder/out", states["second"], 2)
            found.append(last)
        return torch.stack(found, 1), apart

    def _latent(self, weights: Tensors, name: str, states: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
        states[name] = gru(weights, name, x, states[name])
        return dense(weights, f"{name}/z", states[name])


def _divergence_between(found: torch.Tensor, prior: torch.Tensor) -> torch.Tensor:
    """Return the KL divergence of normals from others, each as means and logarithms of variances, mean over windows."""
    (mean, log_variance), (middle, log_spread) = found.chunk(2, -1), prior.chunk(2, -1)
    ratio = (log_variance.exp() + (mean - middle) ** 2) / log_spread.exp()
    return 0.5 * (log_spread - log_variance + ratio - 1.0).sum(-1).mean()


def _change(batch: Tensors) -> torch.Tensor:
    """Return how far both move from the template (W, T, 6 J)."""
    return (batch["motion_m"] - batch["template_m"]).flatten(2)


def _ends(batch: Tensors) -> torch.Tensor:
    """Return the template's first and last frame (W, 12 J)."""
    return batch["template_m"][:, [0, -1]].flatten(1)


def _people(moved: torch.Tensor) -> torch.Tensor:
    return moved.unflatten(-1, (2, -1, 3))
