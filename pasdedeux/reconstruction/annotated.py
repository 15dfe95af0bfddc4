"""Annotated frames of two people lifted as a film of them is reconstructed: one camera, one size each, over time.

A single frame leaves the distance of the two people to their sizes; over the frames of one camera it follows from
floor, sizes, touch and the pairs that look alike, as in `scene`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Integers
from pasdedeux.kinematics import align_rigid
from pasdedeux.projections.camera import DatabaseCamera
from pasdedeux.projections.database import Database
from pasdedeux.projections.pairs import centre_pairs
from pasdedeux.projections.retarget import centre_and_face, retarget_proportions
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.reconstruction.people import reconstruct_people
from pasdedeux.reconstruction.pitch import choose_pitch
from pasdedeux.reconstruction.reconstruct import Method, Searcher
from pasdedeux.reconstruction.reliability import judge_tracks
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.skeletons import OP14, PAIR17
from pasdedeux.spread import evenly_spread

MIN_FRAMES = 12
"""Fewer annotated frames say too little of a camera: twelve place a lift within 9 cm, a single frame nothing."""
_MAX_FRAMES, _MAX_PAIRS = 1000, 3000
"""Frames that are reconstructed together, and pairs of the database, evenly chosen, at most; poses twice as many."""

_SHARED = [name for name in OP14.joint_names if name not in ("head", "neck")]
"""Joints that both skeletons have; op14's head is the nose, and its neck lies between the shoulders."""
_OP14, _PAIR17 = OP14.indices(_SHARED), PAIR17.indices(_SHARED)
_TORSO = [_SHARED.index(f"{side}_{name}") for side in ("left", "right") for name in ("shoulder", "hip")]


@dataclass(frozen=True)
class FilmedPairs:
    """Pairs, and poses, as the people whom cameras of some pitches see.

    Args:
        op14_m: The pairs (row, person=2, 14, 3), metres, as many as count.
        searchers: One for each pitch.
        is_of_draws: Whether they are draws and grown pairs, not people of takes.
    """

    op14_m: Array
    searchers: tuple[Searcher, ...]
    is_of_draws: bool

    @classmethod
    def of_draws(cls, pairs_m: npt.NDArray[np.floating], pitches_rad: Sequence[float]) -> FilmedPairs:
        """Make draws and grown pairs (draw, person=2, 17, 3), metres, ready for cameras of these pitches."""
        op14 = op14_from_working(pairs_m[evenly_spread(len(pairs_m), _MAX_PAIRS)].astype(np.float64), PAIR17)
        poses = centre_and_face(retarget_proportions(op14.reshape(-1, OP14.num_joints, 3))).poses_m
        return cls._of(op14, poses, pitches_rad, is_of_draws=True)

    @classmethod
    def of_database(
        cls, database: Database, pairs_m: npt.NDArray[np.floating], pitches_rad: Sequence[float]
    ) -> FilmedPairs:
        """Make the poses of a database and its pairs (row, person=2, 14, 3) ready for cameras of these pitches."""
        pairs = pairs_m[evenly_spread(len(pairs_m), _MAX_PAIRS)].astype(np.float64)
        poses = database.poses_m[evenly_spread(database.num_rows, 2 * _MAX_PAIRS)]
        return cls._of(pairs, poses, pitches_rad, is_of_draws=False)

    @classmethod
    def _of(
        cls, op14_m: Array, poses_m: npt.NDArray[np.floating], pitches_rad: Sequence[float], *, is_of_draws: bool
    ) -> FilmedPairs:
        # Annotated frames are too far apart to follow motion by the frame.
        poses, starts = poses_m.astype(np.float32), np.ones(len(poses_m), dtype=bool)
        cameras = [DatabaseCamera(pitch) for pitch in pitches_rad]
        searchers = tuple(Searcher.of(Database(poses, starts, camera=camera)) for camera in cameras)
        return cls(op14_m, searchers, is_of_draws)


class LiftedFrames(NamedTuple):
    """Two people in annotated frames of one camera.

    Args:
        positions_m: Joints (frame, person=2, 14, 3), camera axes, metres.
        expected_m: What poses and place of the two let expect of the error of a joint of the pair (frame,).
    """

    positions_m: Array
    expected_m: Array


def lift_over_time(
    known: FilmedPairs,
    tracks: Sequence[Track],
    frames: Integers,
    *,
    statures_m: Mapping[int, float] | None = None,
    camera_height_m: float | None = None,
) -> LiftedFrames | None:
    """Return two people in annotated frames of one camera.

    Args:
        known: The database, with the pitches that are tried.
        tracks: The two people.
        frames: Annotated frames of the sequence (frame,) that show both, rising; need not be regular.
        statures_m: Stature by person id, where it is known.
        camera_height_m: Height of the camera over the floor where it is known.

    Returns:
        None where there are too few frames, or somebody cannot be reconstructed.
    """
    if len(frames) < MIN_FRAMES:
        return None
    stated_m = {
        number: stature for number, one in enumerate(tracks) if (stature := (statures_m or {}).get(one.person_id))
    }
    found, expected = [], []
    for part in np.array_split(frames, -(-len(frames) // _MAX_FRAMES)):
        step = max(float(np.median(np.diff(part))), 1.0) if len(part) > 1 else 1.0
        both = [
            replace(
                one,
                keypoints_px=one.keypoints_px[part - one.first_frame],
                confidence=one.confidence[part - one.first_frame],
                rate_hz=one.rate_hz / step,
                person_id=number,
                partner_id=1 - number,
                first_frame=0,
            )
            for number, one in enumerate(tracks)
        ]
        pitch = choose_pitch(known.searchers, both)
        searcher = known.searchers[0].pitched(pitch.pitch_rad)
        made = reconstruct_people(
            searcher,
            both,
            [Method.FIT],
            has_clean_up=False,
            pairs_m=centre_pairs(known.op14_m),
            pitch=pitch,
            statures_m=stated_m,
            camera_height_m=camera_height_m,
        )
        if made.skipped:
            return None
        found.append(np.stack([one.positions_m for one in made.methods[-1].people], axis=1))
        judged = judge_tracks(made)
        poses_m = np.mean([one.expected_error_m for one in judged.people.values()])
        # About their middle, each of the two is off by half of what their place is.
        whole_m = np.hypot(poses_m, 0.5 * judged.places[0, 1].expected_error_m)
        expected.append(np.full(len(part), whole_m))
    return LiftedFrames(np.concatenate(found), np.concatenate(expected))


def as_pair17(op14_m: Array, pair_m: Array) -> Array:
    """Return two people (2, 14, 3) on pair17 (2, 17, 3): trunks and heads, which op14 lacks, are those of a pair.

    Each is moved, at the size of the other, to where shoulders and hips lie.
    """
    joints, known = op14_m[:, _OP14], pair_m[:, _PAIR17]
    spread = [np.linalg.norm(one - one.mean(axis=1, keepdims=True), axis=(1, 2)) for one in (joints, known)]
    sized = pair_m * (spread[0] / np.maximum(spread[1], 1e-9))[:, None, None]
    moved = align_rigid(sized[:, _PAIR17][:, _TORSO], joints[:, _TORSO])
    made = np.einsum("pij,pnj->pni", moved.rotmat, sized) + moved.translation_m[:, None]
    made[:, _PAIR17] = joints
    return np.asarray(made)
