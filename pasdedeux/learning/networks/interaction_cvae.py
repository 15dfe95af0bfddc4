"""The network of `paper_cvae`: three autoencoders, equations 1 to 8 of Li et al. (2024).

p(q'_A, q'_B, B_s | q_A, q_B) = p(q'_A | q'_B, q_A) p(q'_B | B_s, q_B) p(B_s): scales from z by MLP2; B's change from z,
the scales and the template's first and last frame by G-GRU1; A's change from z, B's motion as ST-GCN3 sees it and the
template's first and last frame by G-GRU2.  The second person is the scaled one.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from pasdedeux.learning.networks.layers import (
    NUM_SINES,
    Batch,
    GraphGru,
    StGcn,
    WindowNetwork,
    axis_divergence,
    divergence,
    draw_latent,
    mlp,
    sines,
)
from pasdedeux.learning.settings import PaperCvaeConfig
from pasdedeux.skeletons import BODY22, Skeleton

Narrow = npt.NDArray[np.float32]

_MLP1 = (16, 32, 64, 128, 256)
_MLP2 = (256, 128, 64, 32)
_W1, _W2, _W3 = 0.75, 0.1, 0.05
_W4 = 1.0 - _W1 - _W2 - _W3
_UNIT_M = 0.05
"""Unit of changes inside the network: a typical displacement of joints."""
_NEAR_M = 0.1
"""Joints of the partner nearer than this have the same weight."""
_KNOWN = 64
"""Inputs of each joint about all others: their ends, and the scaled body or its motion."""
_EACH = 13
"""Inputs of a decoder over plain kinematics, per frame and joint."""
_FREE_NATS = 0.1
"""Divergence of an axis of z, mean over windows, below which it costs nothing [Kingma et al. 2016, free bits]."""


class InteractionCvae(WindowNetwork):
    """The network with the sizes of the settings; the condition is standardised scales (W, 22)."""

    chains: Tensor

    def __init__(self, settings: PaperCvaeConfig, skeleton: Skeleton = BODY22) -> None:
        super().__init__()
        self.settings, self.skeleton = settings, skeleton
        s, joints, size = settings, skeleton.num_joints, settings.latent_size
        self.bones = [child for _, child in skeleton.bones]
        self.register_buffer("chains", _chains(skeleton), persistent=False)
        self.mlp1 = mlp(joints - 1, *_MLP1, 2 * _MLP2[0])
        self.mlp2 = mlp(*_MLP2, joints - 1)
        self.st_gcn1 = StGcn(skeleton, 4, s.width, s.num_blocks, s.kernel)
        self.st_gcn2 = StGcn(skeleton, 3, s.width, s.num_blocks, s.kernel)
        self.is_residual = s.architecture == "over_kinematics"
        self.sees_change = self.is_residual or s.architecture == "change_for_a"
        if s.architecture != "scales_for_a":
            self.st_gcn3 = StGcn(skeleton, 6 if self.sees_change else 3, s.width, s.num_blocks, s.kernel)
        self.z_b = nn.Linear(joints * (s.width + 6), 2 * size)
        self.z_a = nn.Linear(joints * (2 * s.width + 6), 2 * size)
        self.known_b = nn.Linear(joints * (6 + 1), _KNOWN)
        self.known_a = nn.Linear(joints * (6 + s.width), _KNOWN)
        decoder = _TimedStGcn if s.architecture == "st_gcn_decoders" else _g_gru
        given = size + _KNOWN + joints + 6
        self.g_gru1 = decoder(settings, skeleton, given + 1)
        self.g_gru2 = decoder(settings, skeleton, given + s.width)

    def noise_shapes(self, num_frames: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of z of scales, of B and of A."""
        size = (self.settings.latent_size,)
        return {"s": (_MLP2[0],), "b": size, "a": size}

    def loss(self, batch: Batch) -> Tensor:
        """Return equation 4: the sum of the losses of scales, of B and of A, means over the windows."""
        template, motion = batch["template_m"], batch["motion_m"]
        scale = batch["condition"][:, self.bones]
        encoded = self.mlp1(scale)
        again = self.mlp2(draw_latent(encoded, batch["noise_s"]))
        of_scales = ((again - scale) ** 2).sum(-1).mean() + divergence(encoded)
        moved_b = motion[:, :, 1] - template[:, :, 1]
        seen = self._seen_by_a(batch, moved_b)
        found_b, found_a = self._encode(batch, seen)
        b = self._decode_b(batch, draw_latent(found_b, batch["noise_b"]))
        a = self._decode_a(batch, draw_latent(found_a, batch["noise_a"]), seen, moved_b)
        of_b = self._motion_loss(template[:, :, 1] + b, motion[:, :, 1]) + _W4 * self._divergence(found_b)
        of_a = self._motion_loss(template[:, :, 0] + a, motion[:, :, 0]) + _W4 * self._divergence(found_a)
        return of_scales + of_b + of_a

    def _divergence(self, posterior: Tensor) -> Tensor:
        """Return the divergence of a motion's z: a sum over axes as published, or a mean above the free bits."""
        if self.settings.balance != "free_bits":
            return divergence(posterior)
        return axis_divergence(posterior).mean(0).clamp(min=_FREE_NATS).mean()

    def forward(self, batch: Batch, *, is_posterior: bool = False) -> Tensor:
        """Return how far both move from the template, by z of the batch's noise or of the answer.

        Where the batch has `moved_b` (W, T, J, 3), metres, how far B moves is given, and A's motion follows from it.
        """
        z_b, z_a = batch["noise_b"], batch["noise_a"]
        if is_posterior:
            seen = self._seen_by_a(batch, (batch["motion_m"] - batch["template_m"])[:, :, 1])
            z_b, z_a = (encoded.chunk(2, -1)[0] for encoded in self._encode(batch, seen))
        b = batch["moved_b"] if "moved_b" in batch else self._decode_b(batch, z_b)
        return torch.stack([self._decode_a(batch, z_a, self._seen_by_a(batch, b), b), b], 2)

    def scales(self, z: Narrow) -> Narrow:
        """Return standardised scales of bones (W, 22) decoded from latents (W, 256); the root's is 0."""
        with torch.no_grad():
            scales = np.zeros((len(z), self.skeleton.num_joints), np.float32)
            scales[:, self.bones] = self.mlp2(torch.from_numpy(z)).numpy()
        return scales

    def _encode(self, batch: Batch, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return means and logarithms of variances of z of B, and of A, which sees B: eqs. 2 and 3, the first lines."""
        template, motion = batch["template_m"], batch["motion_m"]
        change = motion if self.settings.architecture == "whole_motion" else (motion - template) / _UNIT_M
        scale = batch["condition"][:, None, :, None].expand(-1, change.shape[1], -1, -1)
        b = self.st_gcn1(torch.cat([change[:, :, 1], scale], -1))
        a = self.st_gcn2(change[:, :, 0])
        ends = self._ends(template).flatten(2)
        return (
            self.z_b(torch.cat([b.flatten(1), ends[:, 1]], -1)),
            self.z_a(torch.cat([a.flatten(1), ends[:, 0], seen.flatten(1)], -1)),
        )

    def _seen_by_a(self, batch: Batch, moved_b: Tensor) -> Tensor:
        """Return the features of B for A (W, 22, width): its motion by ST-GCN3, and its change if given."""
        if self.settings.architecture == "scales_for_a":
            return batch["condition"][..., None].expand(-1, -1, self.settings.width)
        b_m = batch["template_m"][:, :, 1] + moved_b
        return self.st_gcn3(torch.cat([b_m, moved_b / _UNIT_M], -1) if self.sees_change else b_m)

    def _decode_b(self, batch: Batch, z: Tensor) -> Tensor:
        """Return the change of B (W, T, 22, 3), that of plain kinematics included: equation 2, the second line."""
        plain = self._plain(batch) if self.is_residual else None
        decoded = self._decode(self.g_gru1, self.known_b, batch, 1, z, batch["condition"][..., None], plain)
        return decoded if plain is None else decoded + plain

    def _decode_a(self, batch: Batch, z: Tensor, seen: Tensor, moved_b: Tensor) -> Tensor:
        """Return the change of A (W, T, 22, 3): equation 3, the second line."""
        moved = moved_b if self.is_residual else None
        return self._decode(self.g_gru2, self.known_a, batch, 0, z, seen, moved)

    def _decode(
        self,
        decoder: nn.Module,
        known: nn.Module,
        batch: Batch,
        person: int,
        z: Tensor,
        seen: Tensor,
        moved_b: Tensor | None,
    ) -> Tensor:
        """Decode z with all joints' ends, the condition and the identity of each joint."""
        template, joints = batch["template_m"], self.skeleton.num_joints
        ends = torch.cat([self._ends(template)[:, person], seen], -1)
        everybody = torch.cat([z, known(ends.flatten(1))], -1)[:, None].expand(-1, joints, -1)
        which = torch.eye(joints, device=z.device).expand(len(z), -1, -1)
        given = torch.cat([everybody, which, ends], -1)
        if moved_b is not None:
            return _UNIT_M * decoder(given, template.shape[1], self._each(template, person, moved_b))
        decoded = _UNIT_M * decoder(given, template.shape[1])
        return decoded - template[:, :, person] if self.settings.architecture == "whole_motion" else decoded

    def _plain(self, batch: Batch) -> Tensor:
        """Return the change of B by plain kinematics (W, T, 22, 3): bones scaled, the root's height by its scale."""
        b, scale = batch["template_m"][:, :, 1], batch["scale"][:, None, :, None]
        bones = (scale - 1.0) * (b - b[:, :, list(self.skeleton.parents)])
        height = b[:, :, self.skeleton.root, 1] * (scale[:, :, self.skeleton.root, 0] - 1.0)
        root = torch.stack([torch.zeros_like(height), height, torch.zeros_like(height)], -1)
        return self.chains @ bones + root[:, :, None]

    def _each(self, template: Tensor, person: int, moved_b: Tensor) -> Tensor:
        """Return what one's joints are given in each frame (W, T, 22, 13): where they are, and the partner's near ones.

        These are the joint, where the partner's joints are from it and how near, weighted by 1 / d^2, and how far B's
        move: B's same joint, and those of B near A's.
        """
        own, other = template[:, :, person], template[:, :, 1 - person]
        apart = other[:, :, None] - own[:, :, :, None]
        weights = 1.0 / ((apart**2).sum(-1) + _NEAR_M**2)
        total = weights.sum(-1, keepdim=True)
        offset = (weights[..., None] * apart).sum(-2) / total
        near = _NEAR_M**2 * weights.amax(-1, keepdim=True)
        b = moved_b / _UNIT_M
        mixed = weights @ b / total if person == 0 else b
        return torch.cat([own, offset, near, mixed, near * mixed], -1)

    def _ends(self, template: Tensor) -> Tensor:
        """Return the first and the last frame of each person's template (W, 2, 22, 6)."""
        ends = torch.cat([template[:, 0], template[:, -1]], -1)
        return torch.zeros_like(ends) if self.settings.architecture == "without_ends" else ends

    def _motion_loss(self, found_m: Tensor, motion_m: Tensor) -> Tensor:
        """Return equations 6 and 8 without z: norms summed as printed, or the mean over frames, joints and axes."""
        terms = (
            (_W1, (found_m - motion_m).abs()),
            (_W2, (found_m.diff(dim=1) - motion_m.diff(dim=1)).abs()),
            (_W3, (self._lengths(found_m) - self._lengths(motion_m)) ** 2),
        )
        if self.settings.balance != "summed":
            return torch.stack([share * values.mean() for share, values in terms if values.numel()]).sum()
        return torch.stack([share * values.flatten(1).sum(1).mean() for share, values in terms]).sum()

    def _lengths(self, motion_m: Tensor) -> Tensor:
        parents, children = (list(ends) for ends in zip(*self.skeleton.bones, strict=True))
        return (motion_m[..., children, :] - motion_m[..., parents, :]).norm(dim=-1)


def _chains(skeleton: Skeleton) -> Tensor:
    """Return which bones, by the joints they end in, lie between the root and each joint (J, J), as 0 and 1."""
    chains = torch.zeros(skeleton.num_joints, skeleton.num_joints)
    for child in skeleton.order[1:]:
        chains[child] = chains[skeleton.parents[child]]
        chains[child, child] = 1.0
    return chains


def _g_gru(settings: PaperCvaeConfig, skeleton: Skeleton, inputs: int) -> GraphGru:
    return GraphGru(skeleton, inputs, settings.hidden, 3, _EACH if settings.architecture == "over_kinematics" else 0)


class _TimedStGcn(nn.Module):
    """An ST-GCN that knows the time, in place of a G-GRU."""

    def __init__(self, settings: PaperCvaeConfig, skeleton: Skeleton, inputs: int) -> None:
        super().__init__()
        s = settings
        self.st_gcn = StGcn(skeleton, inputs + NUM_SINES, s.hidden, s.num_blocks, s.kernel, is_pooled=False)
        self.out = mlp(s.hidden, s.hidden, 3)

    def forward(self, known: Tensor, num_frames: int) -> Tensor:
        times = sines(num_frames).to(known.device)[:, None].expand(len(known), -1, known.shape[1], -1)
        every = known[:, None].expand(-1, num_frames, -1, -1)
        return self.out(self.st_gcn(torch.cat([every, times], -1)))
