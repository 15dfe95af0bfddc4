"""Annotated frames of one camera are lifted together, which places people better than single frames do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.choreography.duets import make_duet
from pasdedeux.completion.errors import lifted_errors
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import rotate, unitquat_from_rotvec
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.projections.database import Database
from pasdedeux.projections.pairs import centre_pairs
from pasdedeux.projections.retarget import centre_and_face, mid_hip, retarget_proportions
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.reconstruction.annotated import (
    MIN_FRAMES,
    as_pair17,
    database_of_draws,
    database_of_takes,
    lift_over_time,
)
from pasdedeux.reconstruction.sequence import StatedCamera
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import BODY22, OP14, PAIR17

_BODY22_OF = {"spine": "spine1", "chest": "spine3"}


def pairs_of(name: str, **style: object) -> tuple[np.ndarray, np.ndarray]:
    """Return a duet on pair17 (frame, 2, 17, 3) and on op14, at 6 Hz."""
    body22 = make_duet(name, **style).positions_m()[::10]
    joints = [BODY22.index(_BODY22_OF.get(joint, joint)) for joint in PAIR17.joint_names]
    return body22[:, :, joints], op14_from_working(body22, BODY22)


def test_people_are_placed_by_the_frames_of_their_camera_together() -> None:
    truth, op14 = pairs_of("waltz", duration_s=6.0)
    draws, known = pairs_of("waltz", duration_s=6.0, heights_m=(1.6, 1.9))
    camera = look_at_camera(truth.mean(axis=(0, 1, 2)), distance_m=4.5, yaw_rad=0.5, pitch_rad=0.2, focal_px=1300.0)
    px = camera.project(op14).px + np.random.default_rng(0).normal(0.0, 3.0, (*op14.shape[:3], 2))
    lens = Lens.assumed(1920, 1080, px)
    tracks = [Track(px[:, person], np.ones((len(px), 14)), 6.0, lens, person_id=person) for person in (0, 1)]
    frames = np.arange(0, len(px), 2)
    of_draws = database_of_draws(draws, np.deg2rad([0.0, 10.0, 20.0]).tolist())
    found = lift_over_time(tracks, frames, of_draws)
    assert found is not None
    pairs = np.stack([as_pair17(lifted, draws[0]) for lifted in found.positions_m])
    true = truth[frames] @ camera.camera_from_world_rotmat.T
    errors = lifted_errors(pairs, true)
    # The draws hold the same dance by people of other sizes: poses are near, and so is the distance between people.
    assert errors["lifted_pair_error"].mean() < 0.12
    assert errors["person_distance_error"].mean() < 0.08
    assert 0.5 < errors["lifted_pair_error"].mean() / found.expected_m.mean() < 2.0
    # Takes of a projection database give the same.
    poses = centre_and_face(retarget_proportions(known.reshape(-1, 14, 3))).poses_m.astype(np.float32)
    database = Database(poses, np.ones(len(poses), dtype=bool))
    of_takes = database_of_takes(database, centre_pairs(known), np.deg2rad([0.0, 10.0, 20.0]).tolist())
    placed = lift_over_time(tracks, frames, of_takes)
    assert placed is not None
    between, true_between = (
        lifted[:, 1] - lifted[:, 0]
        for lifted in map(mid_hip, (placed.positions_m, op14[frames] @ camera.camera_from_world_rotmat.T))
    )
    assert np.linalg.norm(between - true_between, axis=-1).mean() < 0.12
    assert lift_over_time(tracks, frames[: MIN_FRAMES - 1], of_draws) is None
    # A stature is that of the person, whatever number the sequence has for them.
    tracks = [replace(track, person_id=track.person_id + 5) for track in tracks]
    one_pitch = database_of_draws(draws, [0.2])
    stated = StatedCamera(height_m=float(camera.position_m[1]))
    tall = lift_over_time(tracks, frames[:MIN_FRAMES], one_pitch, statures_m={6: 2.2})
    usual = lift_over_time(tracks, frames[:MIN_FRAMES], one_pitch, stated)
    assert tall is not None
    assert usual is not None
    lengths = (bone_lengths(OP14, lifted.positions_m[:, 1]) for lifted in (tall, usual))
    tall_m, usual_m = (np.median(body_height_m(OP14, length)) for length in lengths)
    assert tall_m == pytest.approx(2.2, abs=0.02)
    assert usual_m < 1.95


def test_trunks_move_with_shoulders_and_hips_at_the_size_of_the_person() -> None:
    pair = pairs_of("hug", duration_s=1.0)[0][0]
    turn, shift, size = unitquat_from_rotvec(np.array([0.2, 0.7, -0.4])), np.array([0.3, -0.2, 1.0]), 1.1
    moved = size * rotate(turn, pair) + shift
    op14 = np.full((2, OP14.num_joints, 3), np.nan)
    for joint, name in enumerate(OP14.joint_names):
        if name not in ("head", "neck"):
            op14[:, joint] = moved[:, PAIR17.index(name)]
    np.testing.assert_allclose(as_pair17(op14, pair), moved, atol=1e-9)
