"""Reconstruct two dancers from 2D keypoints as frames arrive, and print each pose when it is ready.

python examples/live_printed.py

`pasdedeux reconstruct --follow` does this with the files of a detector.
"""

import numpy as np

from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.choreography.duets import make_duet
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import centre_and_face, mid_hip
from pasdedeux.reconstruction.live.chain import LivePeople
from pasdedeux.reconstruction.live.person import LiveOptions
from pasdedeux.reconstruction.matching import Searcher
from pasdedeux.skeletons.layouts import LAYOUTS

RATE_HZ = 30.0


def poses_of(name, **style):
    """Return the op14 positions (frame, person, 14, 3) of a built-in duet, metres."""
    motions = make_duet(name, rate_hz=RATE_HZ, **style).motions
    return np.stack([derive_working_poses(motion, LAYOUTS["body22"]).op14_m for motion in motions], axis=1)


known = [
    centre_and_face(poses_of("waltz", variation=number, duration_s=4.0)[:, person]).poses_m
    for number in (1, 2)
    for person in (0, 1)
]
starts = np.concatenate([np.arange(len(poses)) == 0 for poses in known])
searcher = Searcher.of(Database(np.concatenate(known), starts))

seen_m = poses_of("waltz", variation=3, duration_s=3.0)
camera = look_at_camera(mid_hip(seen_m).mean(axis=(0, 1)), distance_m=5.0, yaw_rad=0.4, pitch_rad=0.0, focal_px=1400.0)
people = LivePeople(searcher, rate_hz=RATE_HZ, image_size_px=(1920, 1080), options=LiveOptions(lag=6))
for frame, keypoints_px in enumerate(camera.project(seen_m).px):
    for pose in people.push(frame, keypoints_px, np.ones(keypoints_px.shape[:-1])):
        if pose.frame % 15 == 0:
            x, y, z = pose.root_m
            print(f"image {frame}: person {pose.person_id} in frame {pose.frame} is at {x:+.2f} {y:+.2f} {z:+.2f} m")
