"""Lift the annotated frames of two people as one video: one camera, and one size for each person.

In a single frame, the distance of the two people depends on their sizes.  Over the frames of one camera it follows from
floor, sizes, touch and pairs that look alike, as in `scene`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Integers
from pasdedeux.kinematics import align_rigid
from pasdedeux.projections.database import Database
from pasdedeux.projections.pairs import centre_pairs
from pasdedeux.projections.retarget import centre_and_face, retarget_proportions
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.reconstruction.people import SequenceOptions
from pasdedeux.reconstruction.sequence import SearchedDatabase, StatedCamera, reconstruct_sequence
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.skeletons import OP14, PAIR17
from pasdedeux.spread import evenly_spread

MIN_FRAMES = 12
"""Smallest number of annotated frames that determine a camera: twelve place a lift within 9 cm."""
_MAX_FRAMES, MAX_PAIRS = 1000, 3000
"""Largest numbers of frames reconstructed together and of pairs of the database, evenly chosen; twice as many poses."""

_SHARED = [name for name in OP14.joint_names if name not in ("head", "neck")]
"""Joints that both skeletons have; op14's head is the nose, and its neck lies between the shoulders."""
_OP14, _PAIR17 = OP14.indices(_SHARED), PAIR17.indices(_SHARED)
_TORSO = [_SHARED.index(f"{side}_{name}") for side in ("left", "right") for name in ("shoulder", "hip")]


def database_of_draws(pairs_m: npt.NDArray[np.floating], pitches_rad: Sequence[float]) -> SearchedDatabase:
    """Return draws and grown pairs (draw, person=2, 17, 3), metres, as a database for cameras of these pitches."""
    op14 = op14_from_working(pairs_m[evenly_spread(len(pairs_m), MAX_PAIRS)].astype(np.float64), PAIR17)
    poses = centre_and_face(retarget_proportions(op14.reshape(-1, OP14.num_joints, 3))).poses_m
    return _database(poses, op14, pitches_rad)


def database_of_takes(
    database: Database, pairs_m: npt.NDArray[np.floating], pitches_rad: Sequence[float]
) -> SearchedDatabase:
    """Return poses of a database and its pairs (row, person=2, 14, 3) as a database for cameras of these pitches."""
    pairs = pairs_m[evenly_spread(len(pairs_m), MAX_PAIRS)].astype(np.float64)
    poses = database.poses_m[evenly_spread(database.num_rows, 2 * MAX_PAIRS)]
    return _database(poses, pairs, pitches_rad)


def _database(poses_m: npt.NDArray[np.floating], pairs_m: Array, pitches_rad: Sequence[float]) -> SearchedDatabase:
    # Annotated frames are too far apart to follow the motion of a take, so each pose starts a sequence.
    count = len(poses_m)
    searched = SearchedDatabase(
        Database(poses_m.astype(np.float32), np.ones(count, dtype=bool)),
        tuple(pitches_rad),
        take_ids=np.full(count, "", dtype=object),
        take_frames=np.zeros(count, dtype=np.int64),
        pairs_m=centre_pairs(pairs_m),
    )
    return replace(searched, ready=tuple(searched.searchers_tried()))


class LiftedFrames(NamedTuple):
    """Two people in annotated frames of one camera.

    Args:
        positions_m: Joints (frame, person=2, 14, 3), camera axes, metres.
        expected_m: Expected error of a joint of the pair, from those of poses and place (frame,).
    """

    positions_m: Array
    expected_m: Array


def lift_over_time(
    tracks: Sequence[Track],
    frames: Integers,
    database: SearchedDatabase,
    camera: StatedCamera | None = None,
    statures_m: Mapping[int, float] | None = None,
) -> LiftedFrames | None:
    """Return two people in annotated frames of one camera.

    Args:
        tracks: The two people.
        frames: Annotated frames of the sequence (frame,) that show both, rising, at any distances.
        database: Database for the matches.
        camera: Stated facts about the camera.
        statures_m: Stature by person id, where it is known.

    Returns:
        None if there are too few frames, or somebody cannot be reconstructed.
    """
    if len(frames) < MIN_FRAMES:
        return None
    options = SequenceOptions(has_clean_up=False, statures_m=statures_m or {})
    positions, expected = [], []
    for part in np.array_split(frames, -(-len(frames) // _MAX_FRAMES)):
        step = max(float(np.median(np.diff(part))), 1.0) if len(part) > 1 else 1.0
        both = [
            replace(
                track.chosen(part - track.first_frame, track.rate_hz / step),
                partner_id=partner.person_id,
                first_frame=0,
            )
            for track, partner in zip(tracks, tracks[::-1], strict=True)
        ]
        reconstruction = reconstruct_sequence(both, database, camera, options)
        if reconstruction.people.skipped:
            return None
        positions.append(np.stack([track.positions_m for track in reconstruction.people.methods[-1].people], axis=1))
        (place,) = reconstruction.judged.places.values()
        poses_m = np.mean([person.expected_error_m for person in reconstruction.judged.people.values()])
        # Relative to their middle, each person has half the error of their place.
        expected.append(np.full(len(part), np.hypot(poses_m, 0.5 * place.expected_error_m)))
    return LiftedFrames(np.concatenate(positions), np.concatenate(expected))


def as_pair17(op14_m: Array, pair_m: Array) -> Array:
    """Return two people (2, 14, 3) as pair17 (2, 17, 3); trunks and heads, which op14 lacks, come from a similar pair.

    Each person of that pair is scaled and moved onto the shoulders and hips of the other.
    """
    joints, known = op14_m[:, _OP14], pair_m[:, _PAIR17]
    spread = [np.linalg.norm(points - points.mean(axis=1, keepdims=True), axis=(1, 2)) for points in (joints, known)]
    sized = pair_m * (spread[0] / np.maximum(spread[1], 1e-9))[:, None, None]
    moved = align_rigid(sized[:, _PAIR17][:, _TORSO], joints[:, _TORSO])
    pair17_m = np.einsum("pij,pnj->pni", moved.rotmat, sized) + moved.translation_m[:, None]
    pair17_m[:, _PAIR17] = joints
    return np.asarray(pair17_m)
