"""Detect poses in a film with a real network, for `pasdedeux annotate`; run by `make film`, in its own environment.

`python benchmarks/film_check.py FILM OUT.csv` with mediapipe 0.10.21, which brings its detector and landmark networks.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import mediapipe


def main(film: str, out: str) -> None:
    """Write a row for each landmark of the person in each frame, with the visibility as the confidence."""
    capture = cv2.VideoCapture(film)
    landmarks = mediapipe.solutions.pose.PoseLandmark
    names = [landmark.name.lower().replace("foot_index", "big_toe") for landmark in landmarks]
    lines = [
        "# layout: mediapipe33",
        f"# rate_hz: {capture.get(cv2.CAP_PROP_FPS):g}",
        "frame,person,joint,x,y,confidence",
    ]
    with mediapipe.solutions.pose.Pose(model_complexity=1) as pose:
        frame = 0
        while True:
            was_read, image = capture.read()
            if not was_read:
                break
            marks = pose.process(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)).pose_landmarks
            height, width = image.shape[:2]
            for name, point in zip(names, marks.landmark if marks else (), strict=bool(marks)):
                lines.append(f"{frame},0,{name},{point.x * width:.2f},{point.y * height:.2f},{point.visibility:.4f}")
            frame += 1
    Path(out).write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
