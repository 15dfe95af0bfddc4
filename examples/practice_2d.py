"""Write 2D poses of a built-in duet from one camera, for practice.

    python examples/practice_2d.py --duet hug --out hug.csv

The file is CSV as `pasdedeux study new` and `reconstruct` read it; noise imitates a detector.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.choreography.duets import make_duet
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.skeletons import BODY22, OP14

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--duet", default="hug", help="hug, waltz, judo, push_hands")
arguments.add_argument("--seconds", type=float, default=2.0)
arguments.add_argument("--noise", type=float, default=2.0, help="standard deviation, pixels")
arguments.add_argument("--out", type=Path, default=Path("hug.csv"))
options = arguments.parse_args()

rate_hz = 30.0
positions_m = make_duet(options.duet, duration_s=options.seconds, rate_hz=rate_hz).positions_m()
camera = look_at_camera(positions_m.mean(axis=(0, 1, 2)), distance_m=4.0, yaw_rad=0.7, pitch_rad=0.05, focal_px=1200.0)
joints_px = camera.project(op14_from_working(positions_m, BODY22)).px  # (frame, person, joint, 2)
joints_px += np.random.default_rng(0).normal(scale=options.noise, size=joints_px.shape)

width, height = camera.image_size_px
lines = ["# layout: op14", f"# image_size: {width}x{height}", f"# rate_hz: {rate_hz:g}", "frame,person,joint,x,y"]
for frame, people in enumerate(joints_px):
    for person, joints in enumerate(people):
        for name, (x, y) in zip(OP14.joint_names, joints, strict=True):
            lines.append(f"{frame},{person},{name},{x:.2f},{y:.2f}")
options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
print(f"{options.out}: {len(joints_px)} frames of two people, {width} x {height} pixels")
