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
from typing import TextIO

import numpy as np
import typer

from flows.console.following import FollowedFile
from pasdedeux.errors import InputError
from pasdedeux.formats import OpenPoseFrame, check_anatomy, in_pixels, join_openpose_frames
from pasdedeux.reconstruction.live.chain import LivePeople, LivePose
from pasdedeux.skeletons import OP14
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from tasks.ingest.parameters import AnnotationOptions

__all__ = ["follow_lines", "lines_into", "told_to_stop"]

_MIN_CONFIDENCE = float(AnnotationOptions.model_fields["min_confidence"].default)
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
            sure = np.where(frame.confidence < _MIN_CONFIDENCE, 0.0, frame.confidence)
            op14 = KEYPOINT_LAYOUTS[layout].derive("op14", frame.keypoints_px, sure)
            poses = people.push(file.number, op14.positions, op14.confidence)
        times.worked()
        _write(poses, times, out, rate_hz=rate_hz)
        times.written(poses)
    _write(people.finish(), times, out, rate_hz=rate_hz)
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
                f"({max(self._frames_behind)} at most)"
            )
        if self._answer_s:
            said.append(
                f"{_spread_ms(self._answer_s)} after the file that made it due was written "
                f"({len(self._answer_s)} files that came while following)"
            )
        return ", ".join(said)


def _spread_ms(seconds: list[float]) -> str:
    return f"{1000 * np.median(seconds):.1f} ms (median), {1000 * np.quantile(seconds, 0.99):.1f} ms (99 %)"


def _write(poses: list[LivePose], times: _Times, out: TextIO | None, *, rate_hz: float) -> None:
    for pose in poses:
        line = _line(pose, rate_hz=rate_hz, delay_s=times.delay_s(pose))
        if out is None:
            typer.echo(line)
        else:
            out.write(line + "\n")
            out.flush()


def _line(pose: LivePose, *, rate_hz: float, delay_s: float) -> str:
    return json.dumps(
        {
            "frame": pose.frame,
            "time_s": round(pose.frame / rate_hz, 6),
            "person_id": pose.person_id,
            "op14_m": np.round(pose.positions_m, 4).tolist(),
            "root_m": np.round(pose.root_m, 4).tolist(),
            "yaw_rad": round(pose.yaw_rad, 4),
            "score_m": round(pose.score_m, 4),
            "num_joints_seen": pose.num_joints_seen,
            "delay_s": round(delay_s, 4),
        }
    )
