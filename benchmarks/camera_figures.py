"""Measure errors of poses and places with a moving camera, and with one, two and three cameras; not a test.

`python -m benchmarks.camera_figures DATA` with the folder of real motion data; a quarter of an hour on one core.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.film_figures import print_now
from pasdedeux.film.annotating import annotate_shot
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.people.resolution import resolve_people
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.projections.database import Database
from pasdedeux.projections.pairs import centre_pairs
from pasdedeux.projections.retarget import centre_and_face, mid_hip, retarget_proportions
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.reconstruction.annotated import database_of_takes
from pasdedeux.reconstruction.errors import root_centred_error_m
from pasdedeux.reconstruction.matching import Method
from pasdedeux.reconstruction.moving_camera import subtract_motion
from pasdedeux.reconstruction.people import SequenceOptions
from pasdedeux.reconstruction.sequence import SearchedDatabase, reconstruct_sequence
from pasdedeux.reconstruction.tracks import tracks_of
from pasdedeux.reconstruction.views.together import reconstruct_views
from pasdedeux.skeletons import BODY22, OP14
from tasks.ingest.poses2d.run import track_columns
from tests.builders.cameras_of_a_take import STEPS, see
from tests.builders.cameras_of_a_take import errors_m as seen_errors_m
from tests.builders.crowds import salsa_couple
from tests.builders.rendered_film import Film, hand_held, moved, render, rows_of, salsa_bodies

NUM_FRAMES, _KEYS_EVERY = 90, 10
_KNOWN_TAKES = ("01", "03", "06", "10")
"""Takes of the database, without the filmed ones."""
CLIPS = (("07", 300, 2.0), ("12", 100, -1.0), ("05", 200, 0.5))
"""Take, first frame, and direction of the camera."""
CAMERAS = {
    "still": {},
    "shaken by 87 px": {"shake_px": 40.0},
    "panned by 20 degrees": {"pan_rad": 0.35},
    "zoomed by 1.4": {"zoom": 1.4},
}
_VIEWS = {
    "one camera": (),
    "two cameras, 60 degrees": (60.0,),
    "two cameras, 90 degrees": (90.0,),
    "two cameras, 120 degrees": (120.0,),
    "three cameras": (90.0, -100.0),
}
"""Angles of the other cameras to the first."""


def salsa_database(data: Path) -> SearchedDatabase:
    """Return the database, without the filmed takes."""
    known = np.concatenate([salsa_couple(data, take, rate_hz=8.0) for take in _KNOWN_TAKES])
    poses = centre_and_face(retarget_proportions(known.reshape(-1, 14, 3))).poses_m.astype(np.float32)
    is_real = np.ones(len(poses), dtype=bool)
    return database_of_takes(Database(poses, is_real), centre_pairs(known), np.deg2rad([0.0, 10.0, 20.0]).tolist())


def errors_m(film: Film, truth_m: np.ndarray, moves: np.ndarray, database: SearchedDatabase) -> tuple[float, float]:
    """Return the mean error of joints about the mid-hip, and of the vector from one mid-hip to the other."""
    size = film.images[0].shape[1::-1]
    frames = sorted({*range(0, len(film.px), _KEYS_EVERY), len(film.px) - 1})
    given = replace(rows_of(film, frames), image_size_px={"film": size})
    seen = annotate_shot(given, iter(film.images), 0, len(film.px), is_key=True).frames
    tracks = tracks_of(track_columns(resolve_people(seen)), "film")
    people = reconstruct_sequence(subtract_motion(tracks, seen.camera_motion.get("film"))[0], database).people
    # Results are in the axes of the camera of the steady image.
    first = film.cameras[0].camera_from_world_rotmat
    turns = [moved(replace(film.cameras[0], camera_from_world_rotmat=np.eye(3)), *move) for move in moves]
    rotmat = moved(
        replace(film.cameras[0], camera_from_world_rotmat=turns[0].camera_from_world_rotmat.T @ first),
        *np.median(moves, axis=0),
    ).camera_from_world_rotmat
    poses, roots = [], []
    for person in people.methods[-1].people:
        true = truth_m[person.track.frames, person.person_id] @ rotmat.T
        poses.append(root_centred_error_m(person.positions_m, true).mean())
        roots.append(person.root_m - mid_hip(true))
    return float(np.mean(poses)), float(np.linalg.norm(roots[1] - roots[0], axis=-1).mean())


def views(data: Path, database: SearchedDatabase) -> dict[str, list[tuple[float, float]]]:
    """Return errors of poses and places, metres, by cameras: keypoints of 2 px of noise, lenses and places unknown."""
    errors: dict[str, list[tuple[float, float]]] = {}
    for take, start, yaw_rad in CLIPS:
        first = start * STEPS - 60
        bodies = salsa_bodies(data, take, slice(first, first + 120 + STEPS * NUM_FRAMES), rate_hz=30.0 * STEPS)
        truth_m = op14_from_working(bodies.body22_m, BODY22)
        stature_m = body_height_m(OP14, np.median(bone_lengths(OP14, truth_m), axis=0))
        yaw_deg = float(np.rad2deg(yaw_rad))
        for name, others in _VIEWS.items():
            cameras = see(truth_m, (yaw_deg, *(yaw_deg + other for other in others)), num_frames=NUM_FRAMES)
            tracks = [camera.tracks for camera in cameras]
            if others:
                motions = {name: reconstruct_views(tracks, database).people.methods[-1]}
                stated = SequenceOptions(statures_m=dict(enumerate(stature_m.tolist())))
                motions[f"{name}, statures stated"] = reconstruct_views(
                    tracks, database, options=stated
                ).people.methods[-1]
            else:
                both = SequenceOptions((Method.NEAREST, Method.FIT))
                methods = reconstruct_sequence(tracks[0], database, options=both).people.methods
                motions = {"one camera, nearest match": methods[0], name: methods[-1]}
            for key, method in motions.items():
                for said, has_best_scale in (("", False), (", scale fitted to the truth", True)):
                    if has_best_scale and key != name:
                        continue
                    pose, place = seen_errors_m(method.people, truth_m, cameras[0], has_best_scale=has_best_scale)
                    errors.setdefault(f"{key}{said}", []).append((pose, place))
                    print_now(f"salsa {take}, {key}{said}: pose {100 * pose:.1f} cm, place {100 * place:.1f} cm")
    return errors


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--part", choices=("moving", "views"), action="append")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    database = salsa_database(options.data)
    parts = options.part or ("moving", "views")
    figures = views(options.data, database) if "views" in parts else {}
    for take, start, yaw_rad in CLIPS if "moving" in parts else ():
        bodies = salsa_bodies(options.data, take, slice(start, start + NUM_FRAMES))
        truth_m = op14_from_working(bodies.body22_m, BODY22)
        for camera, kind in CAMERAS.items():
            moves = hand_held(NUM_FRAMES, **kind)
            film = render(bodies, turn_rad=0.0, yaw_rad=yaw_rad, moves=moves, blur=1, seed=5, size=(960, 540))
            pose, place = errors_m(film, truth_m, moves, database)
            figures.setdefault(camera, []).append((pose, place))
            print_now(f"salsa {take}, {camera}: pose {100 * pose:.1f} cm, place {100 * place:.1f} cm")
    for camera, both in figures.items():
        pose, place = 100.0 * np.mean(both, axis=0)
        print_now(f"mean, {camera}: pose {pose:.1f} cm, place {place:.1f} cm")


if __name__ == "__main__":
    main()
