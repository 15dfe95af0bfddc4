"""Live poses as lines of JSON, and how long they took: what `reconstruct --follow` does with each frame that comes."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import numpy as np
import typer

from flows.console.following import FollowedFile
from pasdedeux.errors import InputError
from pasdedeux.formats.annotated_frames import MIN_CONFIDENCE, check_anatomy, in_pixels
from pasdedeux.formats.humanoid import AXES
from pasdedeux.formats.openpose import OpenPoseFrame, join_openpose_frames
from pasdedeux.reconstruction.body import Body
from pasdedeux.reconstruction.live.chain import LivePeople
from pasdedeux.reconstruction.live.person import LivePose
from pasdedeux.skeletons import BODY22, OP14
from pasdedeux.skeletons.humanoid import HUMANOID_NAMES
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS

_DECIMALS = 7
"""Digits of metres and of rotations: bones do not change by more than 1e-6 m because of them."""

_CHECKED_ROWS = 30
"""Detections after which a live video's keypoints are checked for looking like people."""


@contextmanager
def lines_into(path: Path | None) -> Iterator[TextIO | None]:
    """Return the file that lines go to, None for standard output."""
    if path is None:
        yield None
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        yield file


@contextmanager
def told_to_stop() -> Iterator[Callable[[], bool]]:
    """Return a function that tells whether Ctrl-C was pressed, which ends the video; a second one ends everything."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    is_told = threading.Event()
    before = signal.getsignal(signal.SIGINT)

    def stop(number: int, frame: FrameType | None) -> None:
        is_told.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, stop)
    try:
        yield is_told.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def follow_lines(
    people: LivePeople, files: Iterator[FollowedFile], out: TextIO | None, *, rate_hz: float, began: float | None = None
) -> None:
    """Write the poses of frames as they come, then say how long they took.

    Args:
        people: The live chain.
        files: Frames as their files become whole.
        out: Where lines go, None for standard output.
        rate_hz: Frames per second.
        began: When following began, seconds since 1970; now if not given.

    Raises:
        InputError: Keypoints that are not people, or another layout in between.
    """
    times = _Times(time.time() if began is None else began)
    lines = _Lines(people, out, rate_hz=rate_hz)
    seen: list[tuple[int, OpenPoseFrame]] = []
    layout: str | None = None
    for file in files:
        if file.frame is None:
            typer.echo(f"{file.path.name} was left out: {file.problem}", err=True)
            continue
        frame = file.frame
        times.start(file)
        if frame.layout is None:
            poses = people.push(file.number, np.zeros((0, OP14.num_joints, 2)), np.zeros((0, OP14.num_joints)))
        else:
            if layout not in (None, frame.layout):
                raise InputError(f"{file.path.name} has the layout '{frame.layout}', the files before it '{layout}'")
            layout = frame.layout
            if len(seen) < _CHECKED_ROWS:
                seen.append((file.number, frame))
                if len(seen) == _CHECKED_ROWS:
                    check_anatomy(in_pixels(join_openpose_frames(seen, sequence_id="video")))
            sure = np.where(frame.confidence < MIN_CONFIDENCE, 0.0, frame.confidence)
            op14 = KEYPOINT_LAYOUTS[layout].derive("op14", frame.keypoints_px, sure)
            poses = people.push(file.number, op14.positions, op14.confidence)
        times.worked()
        lines.write(poses, times)
        times.written(poses)
    lines.write(people.finish(), times)
    typer.echo(times.in_words(), err=True)


class _Times:
    """What each frame and pose took.

    Args:
        began: When following began, seconds since 1970: files that lay there before wait from then on.
    """

    def __init__(self, began: float) -> None:
        self._began = began
        self._arrived: dict[int, float] = {}
        self._work_s: list[float] = []
        self._answer_s: list[float] = []
        self._frames_behind: list[int] = []
        self._num_poses = 0
        self._number, self._started, self._is_live = 0, 0.0, False

    def start(self, file: FollowedFile) -> None:
        """Take a file whose frame is worked on now."""
        written = file.path.stat().st_mtime
        self._is_live = written >= self._began
        self._number, self._arrived[file.number] = file.number, max(written, self._began)
        if len(self._arrived) > 4000:
            self._arrived = dict(list(self._arrived.items())[-2000:])
        self._started = time.perf_counter()

    def worked(self) -> None:
        """Note that the frame's poses are there."""
        self._work_s.append(time.perf_counter() - self._started)

    def delay_s(self, pose: LivePose) -> float:
        """Return how long ago the file of a pose's own image was written."""
        self._num_poses += 1
        return time.time() - self._arrived.get(pose.frame, self._began)

    def written(self, poses: list[LivePose]) -> None:
        """Note that poses were written because a frame had come."""
        if poses and self._is_live:
            self._answer_s.append(time.time() - self._arrived[self._number])
        self._frames_behind += [self._number - pose.frame for pose in poses]

    def in_words(self) -> str:
        """Say all of it."""
        if not self._num_poses:
            return f"{len(self._work_s)} frames, nobody to be seen"
        said = [f"{len(self._work_s)} frames, {self._num_poses} poses; work per frame {_spread_ms(self._work_s)}"]
        if self._frames_behind:
            said.append(
                f"a pose left {np.median(self._frames_behind):.0f} frames after its image "
                f"({max(self._frames_behind)} at most, before a person's bones were known)"
            )
        if self._answer_s:
            said.append(
                f"{_spread_ms(self._answer_s)} after the file that made it due was written "
                f"({len(self._answer_s)} files that came while following)"
            )
        return ", ".join(said)


def _spread_ms(seconds: list[float]) -> str:
    return f"{1000 * np.median(seconds):.1f} ms (median), {1000 * np.quantile(seconds, 0.99):.1f} ms (99 %)"


class _Lines:
    """The lines: the first says what the others hold, then one for each pose."""

    def __init__(self, people: LivePeople, out: TextIO | None, *, rate_hz: float) -> None:
        self._upright = people.camera_from_upright_rotmat
        self._out = out
        self._rate_hz = rate_hz
        self._bodies: dict[int, Body] = {}
        self._put(
            {
                "format": "pasdedeux live",
                "version": 2,
                "rate_hz": rate_hz,
                "unit": "m",
                "axes": f"{AXES}; x to the right of the image, z towards the camera, which is the origin",
                "joint_names": [HUMANOID_NAMES[joint].mixamo for joint in BODY22.joint_names],
                "parents": list(BODY22.parents),
                "local_unitquat": "x, y, z, w against the parent, from the standing T-pose; root: Hips at hips_m",
                "rest_offset_m": "from the parent in the T-pose; in a person's first line",
                "floor_m": "y of the floor; null where it is not kept",
                "op14_names": list(OP14.joint_names),
            }
        )

    def write(self, poses: list[LivePose], times: _Times) -> None:
        """Write a line for each pose."""
        for pose in poses:
            line = {
                "frame": pose.frame,
                "time_s": round(pose.frame / self._rate_hz, 6),
                "person_id": pose.person_id,
                "hips_m": np.round(pose.pelvis_m, _DECIMALS).tolist(),
                "local_unitquat": np.round(pose.body22_unitquat, _DECIMALS).tolist(),
                "floor_m": round(pose.floor_m, _DECIMALS) if np.isfinite(pose.floor_m) else None,
                "op14_m": np.round(pose.positions_m @ self._upright, _DECIMALS).tolist(),
                "root_m": np.round(pose.root_m @ self._upright, _DECIMALS).tolist(),
                "yaw_rad": round(pose.yaw_rad, 4),
                "score_m": round(pose.score_m, 4),
                "num_joints_seen": pose.num_joints_seen,
                "delay_s": round(times.delay_s(pose), 4),
            }
            if self._bodies.get(pose.person_id) is not pose.body:
                self._bodies[pose.person_id] = pose.body
                line["rest_offset_m"] = np.round(pose.body.offsets_m, _DECIMALS).tolist()
            self._put(line)

    def _put(self, line: dict[str, Any]) -> None:
        if self._out is None:
            typer.echo(json.dumps(line))
        else:
            self._out.write(json.dumps(line) + "\n")
            self._out.flush()
