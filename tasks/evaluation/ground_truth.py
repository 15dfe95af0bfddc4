"""Reading the truth behind virtual video: true cameras, and the takes' poses behind annotated frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from pasdedeux.cameras.pinhole import PinholeCamera
from storage_schema import ArtifactRef, Store
from tasks.annotated_pairs import Place
from tasks.facts import SequenceFacts, TakeFacts
from tasks.takes import read_motion

TakeFrames = dict[tuple[str, int], tuple[str, int]]
"""The take and its frame behind every sequence and frame of virtual video."""


def rate_of(times_s: np.ndarray) -> float:
    """Return the frames per second of times (row,), rising; 25 of a single one."""
    times = np.unique(times_s)
    return float(1.0 / np.median(np.diff(times))) if len(times) > 1 else 25.0


def read_cameras(store: Store, refs: Iterable[ArtifactRef]) -> dict[str, PinholeCamera]:
    """Return the true camera of every virtual sequence."""
    cameras = {}
    for ref in refs:
        if "cameras" not in store.manifest(ref).tables:
            continue
        table = store.read(ref, "cameras")
        for row, sequence_id in enumerate(table["sequence_id"]):
            cameras[sequence_id] = PinholeCamera(
                focal_px=float(table["focal_px"][row]),
                principal_point_px=table["principal_point_px"][row],
                camera_from_world_rotmat=table["camera_from_world_rotmat"][row],
                position_m=table["camera_position_m"][row],
                image_size_px=(int(table["image_width_px"][row]), int(table["image_height_px"][row])),
            )
    return cameras


def read_takes(store: Store, refs: Iterable[ArtifactRef], column: str) -> dict[str, np.ndarray]:
    """Return one positions column of every take as (frame, person, joint, 3)."""
    return {TakeFacts.of(store.manifest(ref)).take_id: read_motion(store, ref, column)[column] for ref in refs}


def read_rates(store: Store, refs: Iterable[ArtifactRef]) -> dict[str, float]:
    """Return the frames per second of every take."""
    return {take.take_id: take.rate_hz for take in TakeFacts.read(store, refs)}


def true_pair(place: Place, frames: TakeFrames, takes: Mapping[str, np.ndarray]) -> tuple[str, np.ndarray] | None:
    """Return the take behind an annotated pair of virtual video, and both people as captured (2, joint, 3), metres.

    None where it is not known: no virtual video, a take that is not among those read, or somebody who is not of it.
    """
    take_id, frame = frames.get((place.sequence_id, place.frame), ("", 0))
    take = takes.get(take_id)
    if take is None or not 0 <= place.person_id < place.partner_id < take.shape[1]:
        return None
    return take_id, take[frame][[place.person_id, place.partner_id]]


def read_take_frames(store: Store, refs: Iterable[ArtifactRef], *, keys_only: bool = False) -> TakeFrames:
    """Return the take and its frame behind every (sequence, frame) of virtual video, or behind the annotated ones only.

    Frames that are not annotated are there for velocity.
    """
    frames = {}
    for ref in refs:
        if not SequenceFacts.of(store.manifest(ref)).is_virtual:
            continue  # a video of the user's own may show a take, but nobody knows which frame of it
        table = store.read(ref, "annotations", columns=["sequence_id", "frame", "is_key", "take_id", "take_frame"])
        for sequence_id, frame, is_key, take_id, take_frame in zip(
            *(table[name] for name in ("sequence_id", "frame", "is_key", "take_id", "take_frame")), strict=True
        ):
            if keys_only and not is_key:
                continue
            frames[sequence_id, int(frame)] = (take_id, int(take_frame))
    return frames
