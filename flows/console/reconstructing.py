"""The work of the command `reconstruct`: reads OpenPose files, reconstructs, writes BVH files or live lines."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import typer
from threadpoolctl import threadpool_limits

from flows.console.context import open_store
from flows.console.following import STOP_NAME, follow_folder, list_frames
from flows.console.live_lines import follow_lines, lines_into, told_to_stop
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats import (
    OpenPoseFrame,
    check_anatomy,
    in_pixels,
    join_openpose_frames,
    read_openpose_frame,
)
from pasdedeux.formats.humanoid import say_units, write_npz
from pasdedeux.people.settle import settle_people
from pasdedeux.reconstruction.live.chain import LiveOptions, LivePeople, warm_up
from pasdedeux.reconstruction.people import reconstruct_people
from pasdedeux.reconstruction.reconstruct import Method, Searcher
from pasdedeux.reconstruction.tracks import tracks_from_rows
from storage_schema import ArtifactRef, Store, latest_studies, read_latest, resolve
from tasks.projections import read_pairs, read_views
from tasks.reconstruction import MAX_PAIRS, read_database

__all__ = ["Live", "Whole", "follow_video", "reconstruct_video"]

_LIVE_PITCH_DEG = 10.0


@dataclass(frozen=True)
class Live:
    """How a live video is reconstructed: a file for the lines (None for standard output), and the command's options."""

    out: Path | None
    rate_hz: float = 30.0
    size: str | None = None
    pitch_deg: float | None = None
    idle_s: float = 5.0
    lag: int = 6
    has_clean_up: bool = True


@dataclass(frozen=True)
class Whole:
    """How a whole video is reconstructed: a folder for the files (None for this one), and the command's options."""

    out: Path | None
    rate_hz: float = 30.0
    size: str | None = None
    pitch_deg: float | None = None
    camera_height_m: float | None = None
    has_clean_up: bool = True
    units: str = "cm"


def follow_video(folder: Path, database: str, store: Path, live: Live) -> None:
    """Write a line per person and frame while a folder's files are being written.

    Raises:
        InputError: No folder, no projections, an image size of another form, or keypoints that are not people.
    """
    _check_folder(folder)
    image_size = _image_size(live.size)
    source, refs = _projections(database, store)
    (searcher,) = _searchers(source, refs, _LIVE_PITCH_DEG if live.pitch_deg is None else live.pitch_deg)
    options = LiveOptions(lag=live.lag, has_clean_up=live.has_clean_up)
    warm_up(searcher, options)
    people = LivePeople(searcher, rate_hz=live.rate_hz, image_size_px=image_size, options=options)
    typer.echo(f"following {folder}; Ctrl-C or a file {STOP_NAME} in it ends the video", err=True)
    # Fits of a few frames are too small for several threads of linear algebra, which wait for each other.
    with lines_into(live.out) as out, told_to_stop() as is_stopped, threadpool_limits(limits=1):
        files = follow_folder(folder, idle_s=live.idle_s, is_stopped=is_stopped)
        follow_lines(people, files, out, rate_hz=live.rate_hz)


def reconstruct_video(folder: Path, database: str, store: Path, whole: Whole) -> None:
    """Write a BVH and an npz file per person of a folder of OpenPose files.

    Raises:
        InputError: No folder, no projections, an image size of another form, files that are not OpenPose's, keypoints
            that are not people, or nobody who can be reconstructed.
    """
    _check_folder(folder)
    image_size = _image_size(whole.size)
    source, refs = _projections(database, store)
    frames = _read_all(folder)
    joined = in_pixels(join_openpose_frames(frames, sequence_id="video"), image_size)
    check_anatomy(joined)
    searchers = _searchers(source, refs, whole.pitch_deg)
    settled = settle_people(replace(joined, rate_hz=whole.rate_hz))
    width, height = image_size or (None, None)
    tracks = tracks_from_rows(
        settled.frames.frame,
        settled.frames.person_id,
        settled.frames.frame / whole.rate_hz,
        settled.op14.positions,
        settled.op14.confidence,
        partner_id=settled.partner_id,
        width_px=width,
        height_px=height,
    )
    found = reconstruct_people(
        searchers,
        tracks,
        [Method.FIT],
        has_clean_up=whole.has_clean_up,
        pairs_m=read_pairs(source, refs, max_pairs=MAX_PAIRS),
        camera_height_m=whole.camera_height_m,
    )
    if not found.methods:
        raise InputError(f"nobody can be reconstructed: {next(iter(found.skipped.values()))}")
    target = whole.out or Path()
    target.mkdir(parents=True, exist_ok=True)
    for tracked, made in found.methods[-1].people:
        path, motion = target / f"{folder.resolve().name}_{tracked.person_id}.bvh", found.motions[tracked.person_id]
        path.write_text(motion.bvh(whole.units), encoding="utf-8")
        path.with_suffix(".npz").write_bytes(write_npz(motion))
        typer.echo(
            f"{path}: seen from frame {tracked.first_frame} to {int(tracked.frames[-1])}, "
            f"{100 * float(np.nanmean(made.score_m)):.1f} cm from the nearest projections, "
            f"{int(made.is_bridged.sum())} bridged"
        )
    (target / "README.txt").write_text(say_units(motion, whole.units), encoding="utf-8")
    for person_id, reason in found.skipped.items():
        typer.echo(f"person {person_id} was left out: {reason}", err=True)
    camera = searchers[found.searcher_index].database.camera
    typer.echo(
        f"camera pitch {math.degrees(camera.pitch_rad):.3g} degrees; "
        f"{'; '.join(one.in_words() for one in settled.sequences)}",
        err=True,
    )


def _check_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder of OpenPose files")


def _image_size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d{2,5})[xX](\d{2,5})", text)
    if match is None:
        raise InputError(f"image size '{text}' is not of the form WIDTHxHEIGHT, for example 1920x1080")
    return int(match[1]), int(match[2])


def _projections(text: str, store_folder: Path) -> tuple[Store, list[ArtifactRef]]:
    """Return the store and the artifacts that a reference names, or those of the only study of a store's folder."""
    if not Path(text).is_dir():
        store = open_store(store_folder)
        refs = resolve(text, store)
        if any("projections" not in store.manifest(ref).tables for ref in refs):
            raise InputError(f"'{text}' does not name projections; a reference to them starts with 'projections:'")
        return store, refs
    store = open_store(Path(text))
    found = {}
    for study in latest_studies(store):
        latest = read_latest(store, study)
        refs = [] if latest is None else latest.refs("projections")
        if refs := [ref for ref in refs if "projections" in store.manifest(ref).tables]:
            found[study] = refs
    if len(found) != 1:
        names = ", ".join(f"projections:{study}" for study in found)
        raise InputError(
            f"store {text} has projections of {len(found)} studies"
            + (f"; say which with --store {text} --database REF, one of: {names}" if found else "; run a study first")
        )
    return store, next(iter(found.values()))


def _searchers(store: Store, refs: list[ArtifactRef], pitch_deg: float | None) -> list[Searcher]:
    """Return the database as each of its cameras sees it, or as one of this pitch does."""
    views = read_views([store.manifest(ref) for ref in refs])
    cameras = views.cameras
    if pitch_deg is not None:
        cameras = (replace(views.level_camera, pitch_rad=math.radians(pitch_deg)),)
    level, _, _ = read_database(store, refs)
    return [Searcher.of(replace(level, camera=camera)) for camera in cameras]


def _read_all(folder: Path) -> list[tuple[int, OpenPoseFrame]]:
    frames = []
    for number, path in list_frames(folder):
        try:
            frames.append((number, read_openpose_frame(path.read_bytes())))
        except FormatError as error:
            raise FormatError(f"{path.name}: {error}") from None
    if not frames:
        raise InputError(f"folder {folder} holds no OpenPose files, whose names end in a frame number and .json")
    return frames
