"""Windows of takes and their variants for models of a few seconds: one body scaled, in axes of their own.

A window is a stretch of a take at ten frames a second.  Its axes lie where the two are in its first frame: the origin
on the floor between their roots, the second person along x.  The scaled person is the second; where it is A,
the two change roles, and where both are scaled the displacements for one and for the other are added.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.augmentation import Source
from pasdedeux.learning.model import Items, VariantRequest

Narrow = npt.NDArray[np.float32]

RATE_HZ = 10.0
"""Sampled frames a second; between them, displacements follow cubic splines."""
_SCALED = 1e-6


@dataclass(frozen=True)
class Window:
    """A stretch of a take, in its own axes, the scaled person second.

    Args:
        take_id: The take.
        person: Index of the scaled person.
        frames: Numbers of its sampled frames (T,).
        template_m: The source's motion (T, 2, 22, 3), metres.
        axes: The window's axes as columns in the world (3, 3).
        variants_m: Motions of variants (V, T, 2, 22, 3), metres; none where they are to be predicted.
        bone_scale: Their scales of the scaled person (V, 22).
    """

    take_id: str
    person: int
    frames: npt.NDArray[np.int64]
    template_m: Narrow
    axes: Array
    variants_m: Narrow
    bone_scale: Narrow


def sampled_frames(source: Source) -> npt.NDArray[np.int64]:
    """Return the frames of a take that are sampled for models, including the first and the last."""
    stride = max(round(source.rate_hz / RATE_HZ), 1)
    return np.unique(np.append(np.arange(0, source.num_frames, stride), source.num_frames - 1))


def scaled_persons(request: VariantRequest) -> list[int]:
    """Return the scaled persons, the root's scale aside; the second person where none is."""
    bones = np.delete(request.bone_scale, request.source.skeleton.root, axis=1)
    return [person for person in range(2) if np.abs(bones[person] - 1.0).max() > _SCALED] or [1]


def cut_windows(source: Source, take_id: str, person: int, length: int) -> list[Window]:
    """Return the windows of a take, each half over the next; a take shorter than one is one window of its own length.

    Args:
        source: The take.
        take_id: Its name.
        person: Index of the scaled person.
        length: Frames of a window.
    """
    sampled = sampled_frames(source)
    order = [1 - person, person]
    count = len(sampled)
    starts = [*range(0, max(count - length, 0), max(length // 2, 1)), max(count - length, 0)]
    windows = []
    for start in sorted(set(starts)):
        frames = np.arange(start, min(start + length, count))
        people = source.positions_m[sampled[frames]][:, order]
        hips = people[0, :, source.skeleton.root]
        along = (hips[1] - hips[0]) * (1.0, 0.0, 1.0)
        distance = float(np.linalg.norm(along))
        x = along / distance if distance > 1e-6 else np.array([1.0, 0.0, 0.0])
        axes = np.stack([x, [0.0, 1.0, 0.0], np.cross(x, [0.0, 1.0, 0.0])], axis=1)
        origin = hips.mean(axis=0)
        origin[1] = source.floor_m
        template = ((people - origin) @ axes).astype(np.float32)
        none = np.zeros((0, *template.shape), np.float32)
        empty = np.zeros((0, source.skeleton.num_joints), np.float32)
        windows.append(Window(take_id, person, frames, template, axes, none, empty))
    return windows


def gather_windows(items: Items, length: int) -> list[Window]:
    """Return the windows of all takes, for each person scaled in them, with the variants of one scaled person."""
    variants: dict[tuple[str, int], tuple[Source, list[Array], list[Array]]] = {}
    for item in items():
        persons = scaled_persons(item.request)
        if len(persons) > 1:
            continue
        source, (person,) = item.request.source, persons
        _, moved, scales = variants.setdefault((item.request.take_id, person), (source, [], []))
        moved.append((item.motion_m - source.positions_m)[sampled_frames(source)][:, [1 - person, person]])
        scales.append(item.request.bone_scale[person])
    windows = []
    for (take_id, person), (source, moved, scales) in variants.items():
        change, scale = np.stack(moved), np.stack(scales).astype(np.float32)
        for window in cut_windows(source, take_id, person, length):
            motion = window.template_m + (change[:, window.frames] @ window.axes).astype(np.float32)
            windows.append(Window(take_id, person, window.frames, window.template_m, window.axes, motion, scale))
    return windows


def blend_windows(source: Source, windows: Sequence[Window], moved_m: Iterator[Narrow]) -> Array:
    """Return displacements of all frames of a take (T, 2, 22, 3), metres, in the world and its people's own order.

    Args:
        source: The take.
        windows: Its windows.
        moved_m: For each of them the displacements (its frames, 2, 22, 3), in its axes; where two windows overlap, one
            fades into the other.
    """
    from scipy.interpolate import CubicSpline  # here: planning need not wait for it

    sampled = sampled_frames(source)
    total, shares = np.zeros((len(sampled), *source.positions_m.shape[1:])), np.zeros(len(sampled))
    for window, moved in zip(windows, moved_m, strict=True):
        count = len(window.frames)
        share = np.minimum(np.arange(1, count + 1), np.arange(count, 0, -1)).astype(np.float64)
        total[window.frames] += share[:, None, None, None] * (moved.astype(np.float64) @ window.axes.T)
        shares[window.frames] += share
    mean = (total / shares[:, None, None, None])[:, [1 - windows[0].person, windows[0].person]]
    if len(sampled) == 1:
        return mean
    return np.asarray(CubicSpline(sampled, mean)(np.arange(source.num_frames)))
