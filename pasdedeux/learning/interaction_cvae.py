"""The networks of `paper_cvae`, in torch: three autoencoders, equations 1 to 8 of Li et al. (2024).

p(q'_A, q'_B, B_s | q_A, q_B) = p(q'_A | q'_B, q_A) p(q'_B | B_s, q_B) p(B_s): scales from z by MLP2; B's change from z,
the scales and the template's first and last frame by G-GRU1; A's change from z, B's motion as ST-GCN3 sees it and the
template's first and last frame by G-GRU2.  The second person is the scaled one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch

from pasdedeux.learning.paper_settings import PaperCvaeConfig
from pasdedeux.learning.torch_layers import (
    NUM_SINES,
    Shapes,
    Tensors,
    dense,
    divergence,
    draw_latent,
    graph_gru,
    mlp,
    shapes_of_dense,
    shapes_of_graph_gru,
    shapes_of_mlp,
    shapes_of_st_gcn,
    sines,
    st_gcn,
    tensors,
)
from pasdedeux.learning.window_vae import WindowNetworks
from pasdedeux.skeletons import BODY22, Skeleton

Narrow = npt.NDArray[np.float32]

_MLP1 = (16, 32, 64, 128, 256)
_MLP2 = (256, 128, 64, 32)
_W1, _W2, _W3 = 0.75, 0.1, 0.05
_W4 = 1.0 - _W1 - _W2 - _W3


@dataclass(frozen=True)
class InteractionCvae(WindowNetworks):
    """What the networks compute for sizes that the settings say.

    The condition is standardised scales (W, 22).
    """

    settings: PaperCvaeConfig
    skeleton: Skeleton = BODY22
    latent_of_scales: ClassVar[int] = _MLP2[0]

    def noise_shapes(self, num_frames: int) -> Shapes:
        """Return the shapes of z of scales, of B and of A."""
        size = (self.settings.latent_size,)
        return {"s": (_MLP2[0],), "b": size, "a": size}

    def shapes(self) -> Shapes:
        """Return the shapes of all weights."""
        s, joints = self.settings, self.skeleton.num_joints
        size = s.latent_size
        shapes = shapes_of_mlp("mlp1", (joints - 1, *_MLP1)) | shapes_of_dense("mlp1/z", _MLP1[-1], 2 * _MLP2[0])
        shapes |= shapes_of_mlp("mlp2", (*_MLP2, joints - 1))
        seen_by_a = () if s.architecture == "scales_for_a" else (("st_gcn3", 3),)
        for name, inputs in (("st_gcn1", 4), ("st_gcn2", 3), *seen_by_a):
            shapes |= shapes_of_st_gcn(name, joints, inputs, s.width, s.num_blocks, s.kernel)
        shapes |= shapes_of_dense("z_b", joints * (s.width + 6), 2 * size)
        shapes |= shapes_of_dense("z_a", joints * (2 * s.width + 6), 2 * size)
        for name, known in (("g_gru1", size + 6 + 1), ("g_gru2", size + 6 + s.width)):
            if s.architecture == "st_gcn_decoders":
                shapes |= shapes_of_st_gcn(name, joints, known + NUM_SINES, s.hidden, s.num_blocks, s.kernel)
                shapes |= shapes_of_mlp(f"{name}/out", (s.hidden, s.hidden, 3))
            else:
                shapes |= shapes_of_graph_gru(name, joints, known, s.hidden, 3)
        return shapes

    def loss(self, weights: Tensors, batch: Tensors) -> torch.Tensor:
        """Return equation 4: the sum of the losses of scales, of B and of A, means over the windows."""
        template, motion = batch["template_m"], batch["motion_m"]
        scale = batch["condition"][:, self._bones]
        found = self._encode_scale(weights, scale)
        again = self.decode_scale(weights, draw_latent(found, batch["noise_s"]))
        of_scales = ((again - scale) ** 2).sum(-1).mean() + divergence(found)
        found_b, found_a = self._encode(weights, batch)
        b = self._decode_b(weights, batch, draw_latent(found_b, batch["noise_b"]))
        seen = self._seen_by_a(weights, batch, motion[:, :, 1])
        a = self._unroll(weights, "g_gru2", batch, 0, draw_latent(found_a, batch["noise_a"]), seen)
        of_b = self._motion_loss(template[:, :, 1] + b, motion[:, :, 1]) + _W4 * divergence(found_b)
        of_a = self._motion_loss(template[:, :, 0] + a, motion[:, :, 0]) + _W4 * divergence(found_a)
        return of_scales + of_b + of_a

    def move(self, weights: Tensors, batch: Tensors, *, is_known: bool) -> torch.Tensor:
        """Return how far both move from the template, by z of the batch's noise or of the answer."""
        known = [found.chunk(2, -1)[0] for found in self._encode(weights, batch)] if is_known else []
        z_b, z_a = known or (batch["noise_b"], batch["noise_a"])
        b = self._decode_b(weights, batch, z_b)
        seen = self._seen_by_a(weights, batch, batch["template_m"][:, :, 1] + b)
        return torch.stack([self._unroll(weights, "g_gru2", batch, 0, z_a, seen), b], 2)

    def scales(self, weights: Mapping[str, Narrow], z: Narrow) -> Narrow:
        """Return standardised scales of bones (W, 22) that latents (W, 256) stand for; the root's is 0."""
        with torch.no_grad():
            found = np.zeros((len(z), self.skeleton.num_joints), np.float32)
            found[:, self._bones] = self.decode_scale(tensors(weights), torch.from_numpy(z)).numpy()
        return found

    def decode_scale(self, weights: Tensors, z: torch.Tensor) -> torch.Tensor:
        """Return scales (W, 21) of latents: MLP2."""
        return mlp(weights, "mlp2", z, len(_MLP2))

    @property
    def _bones(self) -> list[int]:
        return [child for _, child in self.skeleton.bones]

    def _encode_scale(self, weights: Tensors, scale: torch.Tensor) -> torch.Tensor:
        return dense(weights, "mlp1/z", torch.relu(mlp(weights, "mlp1", scale, len(_MLP1))))

    def _encode(self, weights: Tensors, batch: Tensors) -> tuple[torch.Tensor, torch.Tensor]:
        """Return means and logarithms of variances of z of B and of A: equations 2 and 3, the first lines."""
        template, motion = batch["template_m"], batch["motion_m"]
        change = motion if self.settings.architecture == "whole_motion" else motion - template
        scale = batch["condition"][:, None, :, None].expand(-1, change.shape[1], -1, -1)
        b = self._gcn(weights, "st_gcn1", torch.cat([change[:, :, 1], scale], -1))
        a, partner = self._gcn(weights, "st_gcn2", change[:, :, 0]), self._seen_by_a(weights, batch, motion[:, :, 1])
        ends = self._ends(template).flatten(2)
        return (
            dense(weights, "z_b", torch.cat([b.flatten(1), ends[:, 1]], -1)),
            dense(weights, "z_a", torch.cat([a.flatten(1), ends[:, 0], partner.flatten(1)], -1)),
        )

    def _decode_b(self, weights: Tensors, batch: Tensors, z: torch.Tensor) -> torch.Tensor:
        return self._unroll(weights, "g_gru1", batch, 1, z, batch["condition"][..., None])

    def _seen_by_a(self, weights: Tensors, batch: Tensors, b_m: torch.Tensor) -> torch.Tensor:
        """Return what A knows of B (W, 22, width): its motion as ST-GCN3 sees it."""
        if self.settings.architecture == "scales_for_a":
            return batch["condition"][..., None].expand(-1, -1, self.settings.width)
        return self._gcn(weights, "st_gcn3", b_m)

    def _unroll(
        self, weights: Tensors, name: str, batch: Tensors, person: int, z: torch.Tensor, seen: torch.Tensor
    ) -> torch.Tensor:
        """Return the change of one person frame after frame (W, T, 22, 3): equations 2 and 3, the second lines."""
        s, template, joints = self.settings, batch["template_m"], self.skeleton.num_joints
        num_frames = template.shape[1]
        known = torch.cat([z[:, None].expand(-1, joints, -1), self._ends(template)[:, person], seen], -1)
        if s.architecture == "st_gcn_decoders":
            times = sines(num_frames).to(known.device)[:, None].expand(len(known), -1, joints, -1)
            every = torch.cat([known[:, None].expand(-1, num_frames, -1, -1), times], -1)
            seen = st_gcn(weights, name, self.skeleton, every, s.num_blocks, s.kernel, is_pooled=False)
            found = mlp(weights, f"{name}/out", seen, 2)
        else:
            found = graph_gru(weights, name, self.skeleton, known, num_frames)
        return found - template[:, :, person] if s.architecture == "whole_motion" else found

    def _ends(self, template: torch.Tensor) -> torch.Tensor:
        """Return the first and the last frame of each person's template (W, 2, 22, 6)."""
        ends = torch.cat([template[:, 0], template[:, -1]], -1)
        return torch.zeros_like(ends) if self.settings.architecture == "without_ends" else ends

    def _gcn(self, weights: Tensors, name: str, x: torch.Tensor) -> torch.Tensor:
        return st_gcn(weights, name, self.skeleton, x, self.settings.num_blocks, self.settings.kernel)

    def _motion_loss(self, found_m: torch.Tensor, motion_m: torch.Tensor) -> torch.Tensor:
        """Return equations 6 and 8 without z: norms summed as printed, or the mean over frames, joints and axes."""
        terms = (
            (_W1, (found_m - motion_m).abs()),
            (_W2, (found_m.diff(dim=1) - motion_m.diff(dim=1)).abs()),
            (_W3, (self._lengths(found_m) - self._lengths(motion_m)) ** 2),
        )
        if self.settings.norm == "averaged":
            return torch.stack([share * values.mean() for share, values in terms if values.numel()]).sum()
        return torch.stack([share * values.flatten(1).sum(1).mean() for share, values in terms]).sum()

    def _lengths(self, motion_m: torch.Tensor) -> torch.Tensor:
        parents, children = (list(ends) for ends in zip(*self.skeleton.bones, strict=True))
        return (motion_m[..., children, :] - motion_m[..., parents, :]).norm(dim=-1)
