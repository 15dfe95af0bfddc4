"""Render a film of a built-in duet, and write annotated key frames, for practice.

    python examples/practice_film.py --duet waltz --out dance.mp4

`dance_keys.csv` beside the film has every 15th frame, with two pixels of noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from flows.exports.export_format import write_film
from pasdedeux.bodies import body_of, standing_rest_m
from pasdedeux.bodies.drawing import draw_faces
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.choreography.duets import make_duet
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.skeletons import BODY22, OP14

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--duet", default="waltz", help="hug, waltz, judo, push_hands")
arguments.add_argument("--seconds", type=float, default=2.0)
arguments.add_argument("--out", type=Path, default=Path("dance.mp4"))
options = arguments.parse_args()

rate_hz, size, random = 30.0, (960, 540), np.random.default_rng(0)
people_m = make_duet(options.duet, duration_s=options.seconds, rate_hz=rate_hz).positions_m()  # (frame, person, 22, 3)
camera = look_at_camera(
    people_m.mean(axis=(0, 1, 2)), distance_m=4.5, yaw_rad=0.7, pitch_rad=0.1, focal_px=1000.0, image_size_px=size
)
radii_m = capsule_model(BODY22).radii_of(people_m)
bodies = [body_of(BODY22, standing_rest_m(BODY22, people_m[:, at]), radii_m[at]) for at in range(2)]
wall = cv2.resize(random.uniform(90, 160, (27, 48, 1)).astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
wall = np.clip(wall[..., None] + random.normal(0, 6, (*wall.shape, 3)), 0, 255).astype(np.uint8)
shirts = [
    np.array([(60, 90, 210), (200, 130, 60)][at]) * random.uniform(0.5, 1.2, (len(bodies[at].faces), 1))
    for at in (0, 1)
]


def to_px(points):
    """Return pixels of points in camera axes (*batch, 3): x right, y up, z towards the camera."""
    scale = camera.focal_px / -points[..., 2:]
    return np.asarray(camera.principal_point_px) + scale * points[..., :2] * (1.0, -1.0)


def images():
    """Yield the images of the film."""
    for joints_m in people_m:
        image, corners = wall.copy(), []
        for body, joints in zip(bodies, joints_m, strict=True):
            posed = camera.camera_from_world(body.posed(body.turns(BODY22, joints), joints))
            corners.append(posed[body.faces])
        draw_faces(image, np.concatenate(corners), np.clip(np.concatenate(shirts), 0, 255), to_px)
        yield image


write_film(options.out, images(), rate_hz)
lines = ["# layout: op14", f"# image_size: {size[0]}x{size[1]}", f"# rate_hz: {rate_hz:g}", "frame,person,joint,x,y"]
for frame in sorted({*range(0, len(people_m), 15), len(people_m) - 1}):
    joints_px = camera.project(op14_from_working(people_m[frame], BODY22)).px
    for person, joints in enumerate(joints_px + random.normal(scale=2.0, size=joints_px.shape)):
        lines += [
            f"{frame},{person},{name},{x:.1f},{y:.1f}" for name, (x, y) in zip(OP14.joint_names, joints, strict=True)
        ]
keys = options.out.with_name(f"{options.out.stem}_keys.csv")
keys.write_text("\n".join(lines) + "\n", encoding="utf-8")
print(f"{options.out}: {len(people_m)} frames of two people; {keys}: key frames")
