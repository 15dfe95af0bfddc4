"""Live poses: reads a folder of OpenPose files while they are written, and writes lines of JSON with delays."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import typer
from threadpoolctl import threadpool_limits

from flows.console.context import echo
from flows.console.inputs import find_database, read_statures
from flows.signals import remembered_ctrl_c
from pasdedeux.errors import InputError
from pasdedeux.formats.humanoid import AXES
from pasdedeux.formats.poses2d.annotated_frames import MIN_CONFIDENCE, AnnotatedFrames, check_anatomy, in_pixels
from pasdedeux.formats.poses2d.detections import Detection, Footage, join_detections
from pasdedeux.formats.poses2d.openpose import openpose_frame_number, read_people
from pasdedeux.plain_text import counted
from pasdedeux.reconstruction.body import BodyBones
from pasdedeux.reconstruction.live.chain import EVERYBODY_ELSE, LivePeople, load_kernels
from pasdedeux.reconstruction.live.person import LiveOptions, LivePose
from pasdedeux.skeletons import BODY22, OP14
from pasdedeux.skeletons.humanoid import HUMANOID_NAMES
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from tasks.files.user_files import read_file
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.poses2d.resolution import DEFAULT_RATE_HZ

STOP_NAME = "STOP"
"""A file of this name in the folder ends the video."""

_POLL_S = 0.01
_LIVE_PITCH_DEG = 10.0


@dataclass(frozen=True)
class FollowedFile:
    """A frame that was read.

    Args:
        number: Frame number, from the file's name.
        path: The file.
        people: The detected people.
        frame: The same as annotations; None without people.
        problem: Why the file never became complete; empty if it did.
    """

    number: int
    path: Path
    people: Sequence[Detection] = ()
    frame: AnnotatedFrames | None = None
    problem: str = ""


def follow_video(
    video: AnnotationOptions,
    database: str | None,
    store: Path,
    out: Path | None,
    *,
    pitch_deg: float | None,
    statures: Sequence[str],
    idle_s: float,
    options: LiveOptions,
) -> None:
    """Write a line for each person and frame to a file or standard output, while a folder's files are written.

    Raises:
        InputError: There is no folder or no projections, a stature has another form, or keypoints are not people.
    """
    if not video.path.is_dir():
        raise InputError(f"{video.path} is not a folder of OpenPose files")
    statures_m = dict(video.statures_m) | read_statures(statures, [EVERYBODY_ELSE])
    focal_px = Footage(focal_px=video.focal_px, fov_deg=video.fov_deg).focal_of(video.image_size_px)
    searcher = find_database(database, store, with_pairs=False).searcher(
        math.radians(_LIVE_PITCH_DEG if pitch_deg is None else pitch_deg)
    )
    load_kernels(searcher, options)
    rate_hz = video.rate_hz or DEFAULT_RATE_HZ
    people = LivePeople(
        searcher,
        rate_hz=rate_hz,
        image_size_px=video.image_size_px,
        focal_px=focal_px,
        statures_m=statures_m,
        options=options,
    )
    echo(f"following {video.path}; Ctrl-C or a file {STOP_NAME} in it ends the video", err=True)
    # One thread: fits of a few frames are too small for several threads of linear algebra.
    with ExitStack() as stack:
        lines = None
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            lines = stack.enter_context(out.open("w", encoding="utf-8"))
        stack.enter_context(threadpool_limits(limits=1))
        is_stopped = stack.enter_context(remembered_ctrl_c(is_passed_on=False))
        files = follow_folder(video.path, idle_s=idle_s, is_stopped=is_stopped)
        follow_lines(people, files, lines, rate_hz=rate_hz)
    for name in sorted(statures_m.keys() - people.person_ids - {EVERYBODY_ELSE}):
        echo(f"a stature is stated for person {name}, who never appeared", err=True)


def list_frames(folder: Path) -> list[tuple[int, Path]]:
    """Return the numbered files of a folder, in order; of several with one number the first by name."""
    return _new_frames(folder, set(), -1)


def follow_folder(
    folder: Path,
    *,
    idle_s: float,
    is_stopped: Callable[[], bool] = lambda: False,
    sleep: Callable[[float], object] = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[FollowedFile]:
    """Yield frames as their files become complete; end at a file `STOP`, or after `idle_s` without a new file.

    An incomplete file (unreadable as OpenPose) delays the following ones until a later file is complete: then the
    writer has passed it, and it is returned without people. Late files, with a number before the last one, are ignored.

    Args:
        folder: Folder to watch.
        idle_s: Seconds without a new file after which the video is over.
        is_stopped: Returns whether the video is over, like a file `STOP`.
        sleep: Waits; tests write files here.
        clock: Seconds.
    """
    last = -1
    old: set[str] = set()
    since = clock()
    while True:
        is_told = is_stopped() or (folder / STOP_NAME).exists()
        waiting = _new_frames(folder, old, last)
        frames = [_read(number, path) for number, path in waiting]
        whole = [index for index, live_frame in enumerate(frames) if not live_frame.problem]
        is_over = is_told or clock() - since > idle_s
        ready = len(frames) if is_over else (whole[-1] + 1 if whole else 0)
        for live_frame in frames[:ready]:
            last = live_frame.number
            yield live_frame
        if ready:
            since = clock()
        if is_over:
            return
        if not ready:
            sleep(_POLL_S)


def _new_frames(folder: Path, old: set[str], last: int) -> list[tuple[int, Path]]:
    """Return the numbered files after the last frame; names of all other files are added to `old`.

    A folder may have hundreds of thousands of files, so each name is examined once.
    """
    with os.scandir(folder) as entries:
        names = sorted(entry.name for entry in entries if entry.name not in old)
    numbered = []
    for name in names:
        number = openpose_frame_number(name) if name.endswith(".json") else None
        if number is None or number <= last:
            old.add(name)
        else:
            numbered.append((number, folder / name))
    return sorted(dict(reversed(numbered)).items())


def _read(number: int, path: Path) -> FollowedFile:
    try:
        people = read_people(read_file(path))
        return FollowedFile(number, path, people, join_detections(people, sequence_id="video") if people else None)
    except InputError as error:
        return FollowedFile(number, path, problem=str(error))


_DECIMALS = 7
"""Decimals of metres and rotations; rounding changes bones by less than 1e-6 m."""

_CHECKED_ROWS = 30
"""After this many detections, the keypoints of a live video are checked for human proportions."""


def follow_lines(
    people: LivePeople, files: Iterator[FollowedFile], out: TextIO | None, *, rate_hz: float, began: float | None = None
) -> None:
    """Write the poses of frames as they come, then print their delays.

    Args:
        people: The live chain.
        files: Frames as their files become complete.
        out: File for the lines; None: standard output.
        rate_hz: Frames per second.
        began: Start of following, seconds since 1970; now if not given.

    Raises:
        InputError: Keypoints are not people, or the layout changes.
    """
    times = _Times(time.time() if began is None else began)
    lines = _JsonLines(people, out, rate_hz=rate_hz)
    seen: list[Detection] = []
    layout: str | None = None
    for file in files:
        if file.problem:
            echo(f"{file.path.name} was skipped: {file.problem}", err=True)
            continue
        frame = file.frame
        times.start(file)
        if frame is None:
            poses = people.push(file.number, np.zeros((0, OP14.num_joints, 2)), np.zeros((0, OP14.num_joints)))
        else:
            if layout not in (None, frame.layout):
                raise InputError(f"{file.path.name} has the layout '{frame.layout}', the files before it '{layout}'")
            layout = frame.layout
            if len(seen) < _CHECKED_ROWS:
                seen += [replace(person, place=("", file.number)) for person in file.people]
                if len(seen) >= _CHECKED_ROWS:
                    check_anatomy(in_pixels(join_detections(seen, sequence_id="video")))
            sure = np.where(frame.confidence < MIN_CONFIDENCE, 0.0, frame.confidence)
            op14 = KEYPOINT_LAYOUTS[layout].derive("op14", frame.keypoints_px, sure)
            poses = people.push(file.number, op14.positions, op14.confidence)
        times.worked()
        lines.write(poses, times)
    lines.write(people.finish(), times)
    echo(times.in_words(), err=True)


class _Times:
    """Working times of frames, and delays of poses.

    Args:
        began: Start of following, seconds since 1970, which counts as the arrival of earlier files.
    """

    def __init__(self, began: float) -> None:
        self._began = began
        self._arrived: dict[int, float] = {}
        self._work_s: list[float] = []
        self._delays_s: list[float] = []
        self._started = 0.0

    def start(self, file: FollowedFile) -> None:
        """Note that work on the frame of a file begins."""
        self._arrived[file.number] = max(file.path.stat().st_mtime, self._began)
        if len(self._arrived) > 4000:
            self._arrived = dict(list(self._arrived.items())[-2000:])
        self._started = time.perf_counter()

    def worked(self) -> None:
        """Note that work on the frame has ended."""
        self._work_s.append(time.perf_counter() - self._started)

    def delay_s(self, pose: LivePose) -> float:
        """Return the time since the file of a pose's image was written."""
        self._delays_s.append(time.time() - self._arrived.get(pose.frame, self._began))
        return self._delays_s[-1]

    def in_words(self) -> str:
        """Return all of it in words."""
        if not self._delays_s:
            return f"{counted(len(self._work_s), 'frame')}, nobody to be seen"
        work, delay = _spread_ms(self._work_s), _spread_ms(self._delays_s)
        poses = counted(len(self._delays_s), "pose")
        return f"{counted(len(self._work_s), 'frame')}, {poses}; work per frame {work}, a pose {delay} after its image"


def _spread_ms(seconds: list[float]) -> str:
    return f"{1000 * np.median(seconds):.1f} ms (median), {1000 * np.quantile(seconds, 0.99):.1f} ms (99 %)"


class _JsonLines:
    """Writes lines of JSON: a header, then one for each pose."""

    def __init__(self, people: LivePeople, out: TextIO | None, *, rate_hz: float) -> None:
        self._upright = people.camera_from_upright_rotmat
        self._out = out
        self._rate_hz = rate_hz
        self._bodies: dict[int, BodyBones] = {}
        self._put(
            {
                "format": "pasdedeux live",
                "version": 2,
                "rate_hz": rate_hz,
                "unit": "m",
                "axes": f"{AXES}; x to the right of the image, z towards the camera, which is the origin",
                "joint_names": [HUMANOID_NAMES[joint] for joint in BODY22.joint_names],
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
        typer.echo(json.dumps(line), file=self._out)
