"""The work of the command `reconstruct`: reads 2D poses, reconstructs, writes BVH files or live lines."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
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
from pasdedeux.evaluation.motion_players import reconstruction_player
from pasdedeux.evaluation.pictures import PLAYER, Picture
from pasdedeux.formats.detections import Footage
from pasdedeux.formats.humanoid import units_text, write_npz
from pasdedeux.people.decisions import write_decisions
from pasdedeux.people.resolution import ResolvedPeople, SequencePeople
from pasdedeux.reconstruction.live.chain import EVERYBODY_ELSE, LivePeople, warm_up
from pasdedeux.reconstruction.live.person import LiveOptions
from pasdedeux.reconstruction.people import ReconstructedPeople, SequenceOptions
from pasdedeux.reconstruction.sequence import Reconstruction, SearchedDatabase, StatedCamera, reconstruct_sequence
from pasdedeux.reconstruction.tracks import tracks_of
from pasdedeux.settings import first_problem
from pasdedeux.verdict import Verdict
from storage_schema import ArtifactRef, Store, latest_studies, read_latest, resolve
from tasks.data import player_page
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.run import find_videos
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.poses2d.resolution import DEFAULT_RATE_HZ, find_annotations
from tasks.ingest.poses2d.run import stated_of_nobody, track_columns
from tasks.projections import read_pairs, read_searched

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
    searcher = _searched(database, store, with_pairs=False).searcher(
        math.radians(_LIVE_PITCH_DEG if pitch_deg is None else pitch_deg)
    )
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
    searched = _searched(database, store, with_pairs=True)
    camera = StatedCamera(
        None if pitch_deg is None else math.radians(pitch_deg), camera_height_m or video.camera_height_m
    )
    listener = make_listener()

    def reconstruct(resolved: ResolvedPeople, sequence: SequencePeople) -> None:
        if sequence.why_not_followed:
            raise InputError(sequence.why_not_followed)
        tracks = tracks_of(track_columns(resolved), sequence.sequence_id)
        known = [track.person_id for track in tracks]
        if unknown := sorted(set(person_ids) - set(known)):
            raise InputError(f"person {unknown[0]} is not in it; people: {', '.join(map(str, known)) or 'none'}")
        tracks = [track for track in tracks if track.person_id in (person_ids or known)]
        if not tracks:
            raise InputError("no frame shows enough joints of a person")
        shown = {track.person_id for track in tracks}
        stated_m = {name: stature for name, stature in (_statures(statures, shown) | named_m).items() if name in shown}
        found = reconstruct_sequence(
            tracks,
            searched,
            camera,
            SequenceOptions(has_clean_up=has_clean_up, statures_m=stated_m),
            sequence_id=sequence.sequence_id,
            on_step=Steps(listener, 1 + 2 * len(tracks)),
        )
        if not found.people.methods:
            raise InputError(f"nobody can be reconstructed: {next(iter(found.people.skipped.values()))}")
        _write_sequence(found, sequence, out, units)

    failed: list[InputError] = []
    num_made, known = 0, set[int]()
    try:
        for video_found in videos:
            listener.note(f"reading {video_found.in_words()}")
            try:
                resolved = video_found.resolve()
            except InputError as error:
                failed.append(error)
                continue
            known |= set(resolved.frames.person_id.tolist())
            for sequence in resolved.sequences:
                try:
                    reconstruct(resolved, sequence)
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


def _write_sequence(found: Reconstruction, sequence: SequencePeople, out: Path, units: str) -> None:
    """Write files of every person of one sequence, and say how good they are."""
    out.mkdir(parents=True, exist_ok=True)
    names, people = FileNames(out), found.people
    rows: list[tuple[str, ...]] = []
    for name, judged in found.judged.people.items():
        motion = people.motions[name]
        path = write_text(names.path(sequence.sequence_id, name, suffix=".bvh"), motion.bvh(units))
        path.with_suffix(".npz").write_bytes(write_npz(motion))
        (track,) = (person.track for person in people.methods[-1].people if person.person_id == name)
        rows.append(
            (
                str(path),
                f"{track.first_frame}-{int(track.frames[-1])}",
                judged.expected_in_words,
                f"{100 * judged.misfit_m:.1f} cm",
                f"{100 * judged.left_out_m:.1f} cm" if math.isfinite(judged.left_out_m) else "",
                f"{judged.share_seen:.0%}",
                f"{judged.share_bridged:.0%}",
                _in_words(judged.verdict),
            )
        )
    for (first, second), place in found.judged.places.items():
        rows.append(
            (f"place of {first} and {second}", "", place.expected_in_words, *[""] * 4, _in_words(place.verdict))
        )
    say(format_table(_HEADER, rows, text_columns=(0, len(_HEADER) - 1)))
    write_text(names.path(sequence.sequence_id, "units", suffix=".txt"), units_text(motion, units))
    decisions = names.path(sequence.sequence_id, "people", suffix=".csv")
    write_text(decisions, write_decisions(sequence.decisions))
    echo(f"{decisions}: who is who; --set people_file=COPY with changes overrules it", err=True)
    page = names.path(sequence.sequence_id, suffix=".html")
    write_text(page, player_page(sequence.sequence_id, [_shown(people, sequence.sequence_id)]))
    echo(f"look at it: {page}")
    for person_id, reason in people.skipped.items():
        echo(f"person {person_id} was skipped: {reason}", err=True)
    echo(f"{people.pitch.in_words()}; {sequence.in_words()}", err=True)


def _shown(found: ReconstructedPeople, sequence_id: str) -> Picture:
    """Show the people of a sequence upright, beside the 2D poses that they were found in."""
    people, lens_factor = found.methods[-1].people, 1.0 if found.scene is None else found.scene.lens_factor
    frames = np.unique(np.concatenate([person.track.frames for person in people]))
    upright_m, seen_px, projected_px = (np.full((len(frames), len(people), 14, axes), np.nan) for axes in (3, 2, 2))
    for number, person in enumerate(people):
        at, lens = np.searchsorted(frames, person.track.frames), person.track.lens
        upright_m[at, number] = person.positions_m @ found.camera_from_upright_rotmat
        seen_px[at, number] = person.track.keypoints_px
        depth_m = np.maximum(-person.positions_m[..., 2:], 1e-3)
        across = person.positions_m[..., :2] / depth_m * (1, -1)
        projected_px[at, number] = lens.principal_point_px + lens_factor * lens.focal_px * across
    rate_hz = people[0].track.rate_hz
    player = reconstruction_player(upright_m, rate_hz=rate_hz, keypoints_px=seen_px, projected_px=projected_px)
    caption = f"{sequence_id}: the reconstruction over its 2D poses, and turning; five seconds from the middle."
    return Picture(f"{sequence_id}{PLAYER}", caption, player)


def _in_words(verdict: Verdict) -> str:
    return verdict.level.value + (f": {verdict.reason}" if verdict.reason else "")


def _statures(texts: Sequence[str], person_ids: Iterable[int]) -> dict[int, float]:
    """Return the statures by person that options say: PERSON=METRES, or METRES for everybody else."""
    statures: dict[int, float] = {}
    for text in sorted(texts, key=lambda text: "=" in text):
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
    parts = {}
    for study in latest_studies(store):
        last = read_latest(store, study)
        parts[study] = [ref for ref in last.refs("projections") if _is_part(store, ref)] if last else []
    studies = [study for study in parts if parts[study]]
    if len(studies) != 1:
        names = ", ".join(f"projections:{study}" for study in studies)
        which = f"say which with --database, one of: {names}" if studies else _HOW_TO_GET_ONE
        has = (
            f"projections of {len(studies)} studies"
            if studies
            else "no projections, which `reconstruct` matches against"
        )
        raise InputError(f"store {store} has {has}; {which}")
    return store, parts[studies[0]]


def _is_part(store: Store, ref: ArtifactRef) -> bool:
    return "projections" in store.manifest(ref).tables


def _searched(text: str | None, store_folder: Path, *, with_pairs: bool) -> SearchedDatabase:
    """Return the projections that a reference names, or the only ones of a store; warn if they are few."""
    store, refs = _projections(text, store_folder)
    searched = read_searched(store, refs)
    if words := small_database_words(searched.poses.num_rows, len(set(searched.take_ids))):
        echo(words, err=True)
    return replace(searched, pairs_m=read_pairs(store, refs)) if with_pairs else searched
