"""A take at a lower rate: corrections of plain forward kinematics are smooth, mostly below a few hertz.

Within a frame every term stays as it is; terms between frames are those of the longer step, so a motion without
anything faster has the same mean energy per frame.  The difference x = p - r goes back to all frames by cubic
interpolation (Catmull and Rom 1974).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.augmentation.mesh import InteractionMesh
from pasdedeux.augmentation.problem import MeshProblem
from pasdedeux.augmentation.terms import temporal_couplings

Indices = npt.NDArray[np.intp]
Packed = TypeVar("Packed")


@dataclass(frozen=True)
class Thinning:
    """A problem at some of the frames.

    Args:
        problem: The problem at n of the frames, evenly spaced.
        neighbours: The four of these from which each frame of the take is interpolated (T, 4).
        shares: Their shares (T, 4); they sum to 1.
    """

    problem: MeshProblem
    neighbours: Indices
    shares: Array


def thin_out(problem: MeshProblem, stride: int) -> Thinning:
    """Keep every `stride`-th frame, dropping equally many frames at both ends."""
    total = problem.num_frames
    frames = np.arange((total - 1) % stride // 2, total, stride)
    before = np.concatenate([np.zeros((1, problem.stance.shape[1])), np.cumsum(problem.stance, axis=0)])
    stance = np.diff(before[frames], axis=0) / stride**3
    smoothness = problem.smoothness / stride**4
    diagonal, _, _ = temporal_couplings(problem.stance, problem.smoothness, total)
    matrix = problem.matrix[:, frames]
    added, lag1, lag2 = temporal_couplings(stance, smoothness, len(frames))
    points = range(matrix.shape[-1])
    matrix[..., points, points] += added - diagonal[:, frames]
    thinned = replace(
        problem,
        source=problem.source.take_frames(slice(int(frames[0]), None, stride), rate_hz=problem.source.rate_hz / stride),
        mesh=InteractionMesh(problem.mesh.weights[frames]),
        matrix=matrix,
        lag1=lag1,
        lag2=lag2,
        contacts=_at(problem.contacts, frames),
        contact_weights=problem.contact_weights[frames],
        stance=stance,
        floor=problem.floor[frames],
        smoothness=smoothness,
        clearance=_at(problem.clearance, frames),
        coupling=problem.coupling[frames],
    )
    neighbours, shares = _catmull_rom(frames, total)
    return Thinning(problem=thinned, neighbours=neighbours, shares=shares)


def interpolate_thinned(thinning: Thinning, values: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return values (n, rows, axis, variant) at all frames (T, rows, axis, variant), of the same precision."""
    shares = thinning.shares.astype(values.dtype)[:, :, None, None, None]
    moved = values[thinning.neighbours[:, 0]] * shares[:, 0]
    for place in (1, 2, 3):
        moved += values[thinning.neighbours[:, place]] * shares[:, place]
    return moved


def _at(packed: Packed, frames: Indices) -> Packed:
    """Return the pairs of some frames."""
    return replace(packed, **{field.name: getattr(packed, field.name)[frames] for field in fields(packed)})  # type: ignore[type-var, arg-type]


def _catmull_rom(frames: Indices, total: int) -> tuple[Indices, Array]:
    """Return which kept frames each frame is interpolated from (total, 4) and by which shares; ends are held."""
    last = len(frames) - 1
    stride = int(frames[1] - frames[0]) if last > 0 else 1
    place = np.clip((np.arange(total) - frames[0]) / stride, 0.0, last)
    first = np.minimum(place.astype(np.intp), max(last - 1, 0))
    t = place - first
    shares = 0.5 * np.stack(
        [-t + 2.0 * t**2 - t**3, 2.0 - 5.0 * t**2 + 3.0 * t**3, t + 4.0 * t**2 - 3.0 * t**3, -(t**2) + t**3], axis=-1
    )
    return np.clip(first[:, None] + np.arange(-1, 3), 0, last), shares
