"""Ground truth of virtual video: the takes' poses behind annotated frames, and the true cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pasdedeux.cameras.pinhole import PinholeCamera
from storage_schema import ArtifactRef, Store
from tasks.rows.annotated_pairs import PairPlace
from tasks.rows.takes import read_motion
from tasks.stage.facts import SequenceFacts, TakeFacts


@dataclass(frozen=True)
class TruePair:
    """Both people of an annotated pair as captured (2, joint, 3), metres, with their take and the frame in it."""

    take_id: str
    time_s: float
    pair_m: np.ndarray


@dataclass(frozen=True)
class GroundTruth:
    """Takes and their virtual video.

    Args:
        takes: Poses of every take (frame, person, joint, 3), metres.
        rates_hz: Frames per second of every take.
        held_out: Takes that are held out.
        frames: The take and its frame behind every (sequence, frame) of virtual video.
        cameras: The true camera of every virtual sequence.
    """

    takes: Mapping[str, np.ndarray]
    rates_hz: Mapping[str, float]
    held_out: frozenset[str] = frozenset()
    frames: Mapping[tuple[str, int], tuple[str, int]] = field(default_factory=dict)
    cameras: Mapping[str, PinholeCamera] = field(default_factory=dict)

    @classmethod
    def read(
        cls, store: Store, takes: Sequence[ArtifactRef], annotations: Sequence[ArtifactRef], *, column: str = "pair17_m"
    ) -> GroundTruth:
        """Read a positions column of these takes, and the frames of these annotations; skip the user's own videos."""
        facts = {take.take_id: take for take in TakeFacts.read(store, takes)}
        frames: dict[tuple[str, int], tuple[str, int]] = {}
        for ref in annotations:
            if SequenceFacts.of(store.manifest(ref)).is_virtual:
                table = store.read(ref, "annotations", columns=["sequence_id", "frame", "take_id", "take_frame"])
                columns = (table[name] for name in ("sequence_id", "frame", "take_id", "take_frame"))
                for sequence_id, frame, take_id, take_frame in zip(*columns, strict=True):
                    frames[sequence_id, int(frame)] = take_id, int(take_frame)
        return cls(
            takes={name: read_motion(store, ref, column)[column] for name, ref in zip(facts, takes, strict=True)},
            rates_hz={name: fact.rate_hz for name, fact in facts.items()},
            held_out=frozenset(name for name, fact in facts.items() if fact.is_held_out),
            frames=frames,
            cameras={name: camera for ref in annotations for name, camera in _read_cameras(store, ref).items()},
        )

    def time_s(self, take_id: str, frame: int) -> float:
        """Return the time of a frame within its take, seconds."""
        return frame / self.rates_hz[take_id]

    def where(self, places: Sequence[tuple[str, int]]) -> tuple[list[str], list[float]]:
        """Return take and time of these takes and frames, as `Items` have them."""
        return [take for take, _ in places], [self.time_s(*place) for place in places]

    def pair(self, place: PairPlace) -> TruePair | None:
        """Return the pair behind an annotated pair.

        None if it is unknown: not a virtual video, a take that was not read, or a person outside it.
        """
        take_id, frame = self.frames.get((place.sequence_id, place.frame), ("", 0))
        take = self.takes.get(take_id)
        if take is None or not 0 <= place.person_id < place.partner_id < take.shape[1]:
            return None
        return TruePair(take_id, self.time_s(take_id, frame), take[frame][[place.person_id, place.partner_id]])


def _read_cameras(store: Store, ref: ArtifactRef) -> dict[str, PinholeCamera]:
    if "cameras" not in store.manifest(ref).tables:
        return {}
    table = store.read(ref, "cameras")
    return {
        sequence_id: PinholeCamera(
            focal_px=float(table["focal_px"][row]),
            principal_point_px=table["principal_point_px"][row],
            camera_from_world_rotmat=table["camera_from_world_rotmat"][row],
            position_m=table["camera_position_m"][row],
            image_size_px=(int(table["image_width_px"][row]), int(table["image_height_px"][row])),
        )
        for row, sequence_id in enumerate(table["sequence_id"])
    }
