"""A learned interaction mesh of single frames, in torch: what `start_net` knows, and what it computes.

For every frame, x = p - r minimises a quadratic energy whose weights are learned:

- edges between all points of one and the other (joints and middles of bones) keep the source's vector, along themselves
  and across by two weights that depend on their length and on what they join;
- edges within a body keep that of plain forward kinematics r, each by a weight of its own; a bone's length by one more;
- points stay where the source has them, the more the lower and slower they are; and near r.

So A x = B d with d = q - r, the source less plain forward kinematics.  A and B are of the source alone: one pass serves
every scale, and at scale 1, where d = 0, nothing moves.  Weights are shared by both people and by left and right, and
see lengths, heights and speeds alone: a turned, mirrored or swapped pair is answered by the turned, mirrored or swapped
motion without having been learned.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import torch

from pasdedeux.skeletons import BODY22

__all__ = ["error_m", "first_weights", "loss", "response", "system"]

Narrow = npt.NDArray[np.float32]
Tensors = Mapping[str, torch.Tensor]

_JOINTS = BODY22.num_joints
_BONES = BODY22.bones
_SIZE = 6 * _JOINTS
_REACHES_M = (0.1, 0.2, 0.4)
_SHORTEST_M = 0.02
_LOW_M, _SLOW_M_S = 0.1, 0.3
_LARGEST_LOG, _SMALLEST_LOG = 8.0, -12.0


def _alike() -> npt.NDArray[np.int64]:
    """Return for each joint the first of it and its mirror image."""
    return np.minimum(np.arange(_JOINTS), BODY22.mirror)


def _points() -> Narrow:
    """Return joints and middles of bones as shares of joints (43, 22)."""
    middles = np.zeros((len(_BONES), _JOINTS), np.float32)
    for index, bone in enumerate(_BONES):
        middles[index, list(bone)] = 0.5
    return np.concatenate([np.eye(_JOINTS, dtype=np.float32), middles])


_ALIKE = torch.from_numpy(_alike())
_POINTS = torch.from_numpy(_points())
_CHILDREN = torch.tensor([child for _, child in _BONES])
_PARENTS = torch.tensor([parent for parent, _ in _BONES])
_POINTS_ALIKE = torch.cat([_ALIKE, _JOINTS + _ALIKE[_CHILDREN]])
_ALONG = torch.zeros(len(_BONES), _JOINTS)
_ALONG[range(len(_BONES)), _CHILDREN], _ALONG[range(len(_BONES)), _PARENTS] = 1.0, -1.0
_EYE = torch.eye(3)


def first_weights() -> dict[str, Narrow]:
    """Return logarithms of weights to begin with: about those of the published mesh, 1 / d^2."""
    count = 2 * _JOINTS
    values: dict[str, npt.ArrayLike] = {
        "across": [-4.0, -2.0, 0.0, 0.0, 0.0],
        "across_of": np.zeros(count),
        "along": [-3.0, -2.0, 1.0, 0.0, 0.0],
        "along_of": np.zeros(count),
        "own": np.full((_JOINTS, _JOINTS), -1.0),
        "bone": np.full(_JOINTS, 2.0),
        "bone_length": [5.0],
        "stay": np.zeros((_JOINTS, 2)),
        "stay_low": np.full((2, 2), -1.0),
        "near": np.full((_JOINTS, 2), -3.0),
    }
    return {name: np.asarray(value, np.float32) for name, value in values.items()}


def system(
    weights: Tensors, joints_m: torch.Tensor, speed_m_s: torch.Tensor, height_m: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return A and B (F, 132, 132) of the module, rows and columns by person, joint and axis.

    Args:
        weights: As `first_weights` names them.
        joints_m: The source (F, 2, 22, 3), metres.
        speed_m_s: How fast each joint moves (F, 2, 22), metres per second.
        height_m: Its height over the floor (F, 2, 22), metres.
    """
    frames = len(joints_m)
    between = _between(weights, joints_m)
    own = torch.exp(_cut(weights["own"][_ALIKE][:, _ALIKE]))
    own = (own + own.T) * (1.0 - torch.eye(_JOINTS))
    body = torch.kron(torch.diag(own.sum(1)) - own, _EYE).expand(frames, 2, -1, -1) + _bones(weights, joints_m)
    bodies = torch.zeros(frames, _SIZE, _SIZE)
    half = _SIZE // 2
    bodies = torch.cat(
        [torch.cat([body[:, 0], bodies[:, :half, half:]], 2), torch.cat([bodies[:, half:, :half], body[:, 1]], 2)], 1
    )
    low = torch.stack([height_m / _LOW_M, speed_m_s / _SLOW_M_S], -1)
    stay = torch.exp(_cut(weights["stay"][_ALIKE] + low @ weights["stay_low"]))
    kept = between + torch.diag_embed(_per_axis(stay).reshape(frames, _SIZE))
    near = _per_axis(torch.exp(_cut(weights["near"][_ALIKE]))).expand(2, -1, -1).reshape(_SIZE)
    return kept + bodies + torch.diag(near), kept


def loss(weights: Tensors, batch: Tensors) -> torch.Tensor:
    """Return the mean distance of joints, metres, over frames and their variants.

    Args:
        weights: As `first_weights` names them.
        batch: `joints_m`, `speed_m_s` and `height_m` of frames as `system` has them; of their variants `reference_m`
            and `motion_m` (F, V, 2, 22, 3), and `lengths_m` of bones (F, V, 2, 22), metres.
    """
    reference = batch["reference_m"]
    frames, count = reference.shape[:2]
    a, b = system(weights, batch["joints_m"], batch["speed_m_s"], batch["height_m"])
    missing = (batch["joints_m"][:, None] - reference).reshape(frames, count, _SIZE).transpose(1, 2)
    moved = torch.linalg.solve(a, b @ missing).transpose(1, 2).reshape(reference.shape)
    return (_place(reference + moved, batch["lengths_m"]) - batch["motion_m"]).norm(dim=-1).mean()


def error_m(weights: Mapping[str, Narrow], batch: Mapping[str, Narrow]) -> float:
    """Return the loss of weights and a batch that are arrays."""
    with torch.no_grad():
        return float(loss(_tensors(weights), _tensors(batch)))


def response(weights: Mapping[str, Narrow], known: Mapping[str, Narrow]) -> Narrow:
    """Return A^-1 B of frames (F, 132, 132): what every joint does where the source is one metre from r."""
    torch.set_num_threads(1)
    seen = _tensors(known)
    with torch.no_grad():
        a, b = system(_tensors(weights), seen["joints_m"], seen["speed_m_s"], seen["height_m"])
        return np.asarray(torch.linalg.solve(a, b).numpy())


def _tensors(arrays: Mapping[str, Narrow]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in arrays.items()}


def _place(points_m: torch.Tensor, lengths_m: torch.Tensor) -> torch.Tensor:
    """Return points (*batch, 22, 3) with exact bone lengths (*batch, 22) and the directions they have."""
    placed: dict[int, torch.Tensor] = {BODY22.root: points_m[..., BODY22.root, :]}
    for parent, child in _BONES:
        along = points_m[..., child, :] - points_m[..., parent, :]
        unit = along / (along.norm(dim=-1, keepdim=True) + 1e-9)
        placed[child] = placed[parent] + unit * lengths_m[..., child, None]
    return torch.stack([placed[joint] for joint in range(_JOINTS)], -2)


def _between(weights: Tensors, joints_m: torch.Tensor) -> torch.Tensor:
    """Return the quadratic form of the edges between the two (F, 132, 132)."""
    points = torch.einsum("pj,fajk->fapk", _POINTS, joints_m)
    edge = points[:, 0, :, None] - points[:, 1, None, :]
    length = edge.norm(dim=-1) + 1e-3
    unit = edge / length[..., None]
    known = [torch.ones_like(length), torch.log(length + _SHORTEST_M)]
    seen = torch.stack([*known, *(torch.exp(-((length / reach) ** 2)) for reach in _REACHES_M)], -1)
    across, along = (
        torch.exp(_cut(seen @ weights[name] + of[:, None] + of))
        for name, of in ((name, weights[f"{name}_of"][_POINTS_ALIKE]) for name in ("across", "along"))
    )
    block = across[..., None, None] * _EYE + along[..., None, None] * unit[..., :, None] * unit[..., None, :]
    mixed = -torch.einsum("ia,fijxy,jb->faxby", _POINTS, block, _POINTS)
    first, second = (torch.einsum("ia,ib,fixy->faxby", _POINTS, _POINTS, block.sum(axis)) for axis in (2, 1))
    rows = [torch.cat([first, mixed], 3), torch.cat([mixed.permute(0, 3, 4, 1, 2), second], 3)]
    return torch.cat(rows, 1).reshape(len(joints_m), _SIZE, _SIZE)


def _bones(weights: Tensors, joints_m: torch.Tensor) -> torch.Tensor:
    """Return the quadratic form of each body's bones (F, 2, 66, 66)."""
    bones = torch.einsum("ej,fajk->faek", _ALONG, joints_m)
    unit = bones / (bones.norm(dim=-1, keepdim=True) + 1e-9)
    stiff = torch.exp(_cut(weights["bone_length"]))
    soft = torch.exp(_cut(weights["bone"][_ALIKE[_CHILDREN]]))
    block = stiff * unit[..., :, None] * unit[..., None, :] + soft[:, None, None] * _EYE
    return torch.einsum("ea,eb,fpexy->fpaxby", _ALONG, _ALONG, block).reshape(len(joints_m), 2, _SIZE // 2, _SIZE // 2)


def _per_axis(values: torch.Tensor) -> torch.Tensor:
    """Return weights of horizontal and vertical (..., 2) as those of x, y and z (..., 3)."""
    return torch.stack([values[..., 0], values[..., 1], values[..., 0]], -1)


def _cut(logarithm: torch.Tensor) -> torch.Tensor:
    return logarithm.clamp(_SMALLEST_LOG, _LARGEST_LOG)
