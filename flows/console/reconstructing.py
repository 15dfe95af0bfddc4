"""The work of the command `reconstruct`: reads 2D poses, reconstructs, writes BVH files or live lines."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError
from threadpoolctl import threadpool_limits

from flows.console.context import echo, open_store, say
from flows.console.display import Steps, format_table, make_listener
from flows.console.fetch import small_database_words
from flows.console.live import STOP_NAME, follow_folder, follow_lines
from flows.exports.export_format import FileNames, write_text
from flows.signals import remembered_ctrl_c
from flows.study_files import toml_value
from pasdedeux.errors import InputError
from pasdedeux.evaluation.pictures import PLAYER, Picture
from pasdedeux.formats.detections import Footage
from pasdedeux.formats.humanoid import units_text, write_npz
from pasdedeux.people.decisions import write_decisions
from pasdedeux.people.resolution import ResolvedPeople, SequencePeople
from pasdedeux.projections.camera import DatabaseCamera
from pasdedeux.projections.database import Database
from pasdedeux.reconstruction.live.chain import EVERYBODY_ELSE, LivePeople, warm_up
from pasdedeux.reconstruction.live.person import LiveOptions
from pasdedeux.reconstruction.people import Reconstruction, reconstruct_people
from pasdedeux.reconstruction.pitch import choose_camera
from pasdedeux.reconstruction.reconstruct import Method, Searcher
from pasdedeux.reconstruction.reliability import Judged, judge_tracks, left_out_misfit_m
from pasdedeux.reconstruction.tracks import Track, tracks_from_rows
from pasdedeux.settings import first_problem
from pasdedeux.verdict import Verdict
from storage_schema import ArtifactRef, Store, latest_studies, read_latest, resolve
from tasks.data import player_page
from tasks.evaluation.reconstruction import reconstruction_player
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.run import find_videos
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.poses2d.resolution import DEFAULT_RATE_HZ, find_annotations
from tasks.ingest.poses2d.run import stated_of_nobody
from tasks.projections import read_cameras, read_database, read_pairs
from tasks.reconstruction import MAX_PAIRS

_LIVE_PITCH_DEG = 10.0
_HEADER = ("file", "frames", "expected error", "misfit", "left-out clips", "seen", "bridged", "verdict")
_HOW_TO_GET_ONE = (
    "`pasdedeux fetch database` makes a large database, of people together and of everyday motion; "
    "`pasdedeux run duets --until projections` a small one, of built-in motion, in two minutes; a study of takes like "
    "yours the best; name it with --database projections:STUDY"
)


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
    """Write a line per person and frame, to a file or standard output, while a folder's files are being written.

    Raises:
        InputError: No folder, no projections, a stature of another form, or keypoints that are not people.
    """
    if not video.path.is_dir():
        raise InputError(f"{video.path} is not a folder of OpenPose files")
    statures_m = dict(video.statures_m) | _statures(statures, [EVERYBODY_ELSE])
    focal_px = Footage(focal_px=video.focal_px, fov_deg=video.fov_deg).focal_of(video.image_size_px)
    source, refs = _projections(database, store)
    (seen,), _ = _databases(source, refs, _LIVE_PITCH_DEG if pitch_deg is None else pitch_deg)
    searcher = Searcher.of(seen)
    warm_up(searcher, options)
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
    # Fits of a few frames are too small for several threads of linear algebra, which wait for each other.
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
        echo(f"a stature is stated for person {name}, who never came", err=True)


def annotation_source(path: Path, settings: Sequence[str]) -> AnnotationOptions:
    """Return the source of 2D poses that a path and KEY=VALUE of the command are, as a study would name it.

    Raises:
        InputError: There is no such key, or its value is not allowed.
    """
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", path.resolve().stem).lstrip("_.-")[:100]
    pairs = [setting.partition("=") for setting in settings]
    stated = {key: toml_value(text) for key, _, text in pairs}
    try:
        return AnnotationOptions.model_validate({"id": name or "video", "path": path, **stated})
    except ValidationError as error:
        raise InputError(f"--set {first_problem(error)}") from None


def reconstruct_video(
    video: AnnotationOptions | FilmOptions,
    database: str | None,
    store: Path,
    out: Path,
    *,
    units: str = "cm",
    pitch_deg: float | None = None,
    camera_height_m: float | None = None,
    person_ids: Sequence[int] = (),
    statures: Sequence[str] = (),
    has_clean_up: bool = True,
) -> None:
    """Write a BVH and an npz file per person of every sequence of 2D poses, read as a study reads them.

    Raises:
        InputError: Nothing that can be read, no projections, a stature of another form, keypoints that are not people,
            or nobody who can be reconstructed.
    """
    named_m = dict(video.statures_m) | _statures(statures, [])
    videos = find_videos(video) if isinstance(video, FilmOptions) else find_annotations(video)
    source, refs = _projections(database, store)
    databases, take_ids = _databases(source, refs, pitch_deg)
    pairs_m = read_pairs(source, refs, max_pairs=MAX_PAIRS)

    listener = make_listener()

    def reconstruct_sequence(resolved: ResolvedPeople, sequence: SequencePeople) -> None:
        if sequence.why_not_followed:
            raise InputError(sequence.why_not_followed)
        tracks = _tracks(resolved, sequence.sequence_id, person_ids)
        if not tracks:
            raise InputError("no frame shows enough joints of a person")
        stated = _statures(statures, [one.person_id for one in tracks]) | named_m
        step = Steps(listener, 1 + 2 * len(tracks))
        pitch = choose_camera(databases, tracks)
        step()
        searcher = Searcher.of(replace(databases[0], camera=DatabaseCamera(pitch.pitch_rad)))
        found = reconstruct_people(
            searcher,
            tracks,
            [Method.FIT],
            has_clean_up=has_clean_up,
            pairs_m=pairs_m,
            camera_height_m=camera_height_m or video.camera_height_m,
            statures_m={name: one for name, one in stated.items() if not person_ids or name in person_ids},
            pitch=pitch,
            on_step=step,
        )
        if not found.methods:
            raise InputError(f"nobody can be reconstructed: {next(iter(found.skipped.values()))}")
        judged = judge_tracks(
            found,
            left_out_misfit_m(searcher.database, searcher.index, take_ids),
            sequence_id=sequence.sequence_id,
            pitches_rad=[one.camera.pitch_rad for one in databases],
        )
        _write_sequence(found, sequence, out, units, judged)

    failed: list[InputError] = []
    num_made, known = 0, set[int]()
    try:
        for one in videos:
            listener.note(f"reading {one.in_words()}")
            try:
                resolved = one.resolve()
            except InputError as error:
                failed.append(error)
                continue
            known |= set(resolved.frames.person_id.tolist())
            for sequence in resolved.sequences:
                try:
                    reconstruct_sequence(resolved, sequence)
                    num_made += 1
                except InputError as error:
                    failed.append(type(error)(f"{sequence.sequence_id}: {error}"))
    finally:
        listener.close()
    for reason in failed if num_made else failed[:-1]:
        echo(f"skipped: {reason}", err=True)
    for line in stated_of_nobody(named_m, known):
        echo(line, err=True)
    if not num_made:
        raise failed[-1]


def _write_sequence(
    found: Reconstruction,
    sequence: SequencePeople,
    out: Path,
    units: str,
    judged: Judged,
) -> None:
    """Write files of every person of one sequence, and say how good they are."""
    out.mkdir(parents=True, exist_ok=True)
    names = FileNames(out)
    rows: list[tuple[str, ...]] = []
    for made in found.methods[-1].people:
        track, motion = made.track, found.motions[made.track.person_id]
        path = write_text(names.path(sequence.sequence_id, track.person_id, suffix=".bvh"), motion.bvh(units))
        path.with_suffix(".npz").write_bytes(write_npz(motion))
        one = judged.people[track.person_id]
        rows.append(
            (
                str(path),
                f"{track.first_frame}-{int(track.frames[-1])}",
                one.expected_in_words,
                f"{100 * one.misfit_m:.1f} cm",
                f"{100 * one.left_out_m:.1f} cm" if math.isfinite(one.left_out_m) else "",
                f"{one.share_seen:.0%}",
                f"{one.share_bridged:.0%}",
                _in_words(one.verdict),
            )
        )
    for (first, second), place in judged.places.items():
        rows.append(
            (f"place of {first} and {second}", "", place.expected_in_words, *[""] * 4, _in_words(place.verdict))
        )
    say(format_table(_HEADER, rows, text_columns=(0, len(_HEADER) - 1)))
    write_text(names.path(sequence.sequence_id, "units", suffix=".txt"), units_text(motion, units))
    people = names.path(sequence.sequence_id, "people", suffix=".csv")
    write_text(people, write_decisions(sequence.decisions))
    echo(f"{people}: who is who; --set people_file=COPY with changes overrules it", err=True)
    page = names.path(sequence.sequence_id, suffix=".html")
    write_text(page, player_page(sequence.sequence_id, [_shown(found, sequence.sequence_id)]))
    echo(f"look at it: {page}")
    for person_id, reason in found.skipped.items():
        echo(f"person {person_id} was skipped: {reason}", err=True)
    echo(f"{found.pitch.in_words()}; {sequence.in_words()}", err=True)


def _shown(tracks_found: Reconstruction, sequence_id: str) -> Picture:
    """Show the people of a sequence upright, beside the 2D poses that they were found in."""
    made, scene = tracks_found.methods[-1], tracks_found.scene
    upright = np.asarray(DatabaseCamera(tracks_found.pitch.pitch_rad).camera_from_upright_rotmat)
    lens_factor = 1.0 if scene is None else scene.lens_factor
    tracks = [one.track for one in made.people]
    frames = np.unique(np.concatenate([track.frames for track in tracks]))
    found, seen_px, projected_px = (np.full((len(frames), len(tracks), 14, axes), np.nan) for axes in (3, 2, 2))
    for number, one in enumerate(made.people):
        at = np.searchsorted(frames, one.track.frames)
        found[at, number], seen_px[at, number] = one.positions_m @ upright, one.track.keypoints_px
        lens, depth_m = one.track.lens, np.maximum(-one.positions_m[..., 2:], 1e-3)
        across = one.positions_m[..., :2] / depth_m * (1, -1)
        projected_px[at, number] = lens.principal_point_px + lens_factor * lens.focal_px * across
    player = reconstruction_player(found, rate_hz=tracks[0].rate_hz, keypoints_px=seen_px, projected_px=projected_px)
    caption = f"{sequence_id}: what was reconstructed, over its 2D poses and turning, five seconds from the middle."
    return Picture(f"{sequence_id}{PLAYER}", caption, player)


def _in_words(verdict: Verdict) -> str:
    return verdict.level.value + (f": {verdict.reason}" if verdict.reason else "")


def _tracks(resolved: ResolvedPeople, sequence_id: str, person_ids: Sequence[int]) -> list[Track]:
    """Return the tracks of a sequence, of these people, or of all where none are named."""
    frames = resolved.frames
    is_own = np.array([name == sequence_id for name in frames.sequence_id])
    known = sorted(set(frames.person_id[is_own].tolist()))
    unknown = sorted(set(person_ids) - set(known))
    if unknown:
        raise InputError(f"person {unknown[0]} is not in it; people: {', '.join(map(str, known)) or 'none'}")
    rows = is_own & np.isin(frames.person_id, person_ids or known)
    width, height = frames.image_size_px.get(sequence_id, (None, None))
    return tracks_from_rows(
        frames.frame[rows],
        frames.person_id[rows],
        frames.frame[rows] / (frames.rate_hz or 1.0),
        resolved.op14.positions[rows],
        resolved.op14.confidence[rows],
        partner_id=resolved.partner_id[rows],
        width_px=width,
        height_px=height,
        focal_px=frames.focal_px.get(sequence_id),
    )


def _statures(texts: Sequence[str], person_ids: Sequence[int]) -> dict[int, float]:
    """Return the statures by person that options say: PERSON=METRES, or METRES for everybody else."""
    statures: dict[int, float] = {}
    for text in sorted(texts, key=lambda one: "=" in one):
        match = re.fullmatch(r"(?:(\d{1,9})=)?(\d(?:\.\d+)?)", text)
        metres = float(match[2]) if match else 0.0
        if match is None or not 0.5 <= metres <= 2.5:
            raise InputError(f"stature '{text}' is none of METRES or PERSON=METRES; allowed: 0.5 to 2.5 m, as 1.72")
        statures |= dict.fromkeys([int(match[1])] if match[1] else person_ids, metres)
    return statures


def _projections(text: str | None, store_folder: Path) -> tuple[Store, list[ArtifactRef]]:
    """Return a store and the artifacts that a reference names, or those of the only study that has projections."""
    store = open_store(store_folder)
    if text is not None:
        refs = resolve(text, store)
        if not all(_is_part(store, ref) for ref in refs):
            raise InputError(f"'{text}' does not name projections; a reference to them starts with 'projections:'")
        return store, refs
    lasts = ((study, read_latest(store, study)) for study in latest_studies(store))
    every = {study: [] if last is None else last.refs("projections") for study, last in lasts}
    found = {study: own for study, refs in every.items() if (own := [ref for ref in refs if _is_part(store, ref)])}
    if len(found) != 1:
        names = ", ".join(f"projections:{study}" for study in found)
        which = f"say which with --database, one of: {names}" if found else _HOW_TO_GET_ONE
        has = f"projections of {len(found)} studies" if found else "no projections, which `reconstruct` matches against"
        raise InputError(f"store {store} has {has}; {which}")
    return store, next(iter(found.values()))


def _is_part(store: Store, ref: ArtifactRef) -> bool:
    return "projections" in store.manifest(ref).tables


def _databases(
    store: Store, refs: list[ArtifactRef], pitch_deg: float | None
) -> tuple[list[Database], npt.NDArray[np.object_]]:
    """Return the database as each of its cameras sees it, or as one of this pitch does, and the take of each row."""
    cameras = read_cameras([store.manifest(ref) for ref in refs])
    if pitch_deg is not None:
        cameras = (DatabaseCamera(math.radians(pitch_deg)),)
    level, take_ids, _ = read_database(store, refs)
    if words := small_database_words(level.num_rows, len(set(take_ids))):
        echo(words, err=True)
    return [replace(level, camera=camera) for camera in cameras], take_ids
