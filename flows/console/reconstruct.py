"""`reconstruct`: makes 3D motion of people from 2D poses or film, also while files are written."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from flows.console import options
from flows.console.annotate import DetectionsOption, DetectOption, KeysOption
from flows.console.cameras import (
    Calibration,
    OtherCamera,
    camera_names,
    film_size_px,
    find_calibration,
    find_camera,
    find_video,
    image_size_px,
    read_camera,
    sources_of,
    steady_tracks,
)
from flows.console.context import app, echo, key_option, say
from flows.console.display import StepReporter, format_table, make_listener
from flows.console.inputs import find_database, read_statures
from flows.console.live import follow_video
from flows.exports.reconstructions import CameraData, write_reconstruction
from flows.progress import Listener
from pasdedeux.errors import InputError
from pasdedeux.people.resolution import ResolvedPeople, SequencePeople
from pasdedeux.people.video import check_one_video
from pasdedeux.reconstruction.live.person import LiveOptions
from pasdedeux.reconstruction.people import SequenceOptions
from pasdedeux.reconstruction.sequence import Reconstruction, SearchedDatabase, StatedCamera, reconstruct_sequence
from pasdedeux.reconstruction.views.cameras import SeenBy, upright_m
from pasdedeux.reconstruction.views.together import reconstruct_views
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.run import FoundFilm
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.poses2d.resolution import FoundAnnotations
from tasks.ingest.poses2d.run import stated_of_nobody

_HEADER = ("file", "frames", "expected error", "misfit", "left-out clips", "seen", "bridged", "verdict")
"""Columns of `WrittenReconstruction.rows`."""


@app.command()
def reconstruct(
    path: Annotated[Path, Argument(metavar="FILE_OR_DIR", help="2D poses: a file, or a folder of them; or film.")],
    keys: KeysOption = None,
    detections: DetectionsOption = None,
    detect: DetectOption = None,
    camera: Annotated[
        list[Path] | None, Option(metavar="FILE", help="The same take from another camera; repeatable.")
    ] = None,
    calibration: Annotated[
        Path | None, Option(metavar="TOML", help="Where the cameras are: calib.toml of Pose2Sim, Anipose or freemocap.")
    ] = None,
    database: Annotated[
        str | None, Option(metavar="REF", help="Projections; default: the only ones in the store.")
    ] = None,
    store: options.Store = Path("store"),
    out: Annotated[
        Path | None, Option(help="Folder for BVH files and a page (default: this folder); with --follow, a file.")
    ] = None,
    follow: Annotated[bool, Option("--follow", help="Read files while they are being written.")] = False,
    idle: Annotated[float, Option(min=0.0, metavar="S", help="End after this time without a new file, seconds.")] = 5.0,
    settings: Annotated[
        list[str] | None, Option("--set", metavar="KEY=C", help="A key of the source, such as rate_hz=60.")
    ] = None,
    stature: Annotated[
        list[str] | None, Option(metavar="[PERSON=]M", help="Stature of everybody, or of one person.")
    ] = None,
    person: Annotated[list[int] | None, Option(min=0, metavar="N", help="Only this person; repeatable.")] = None,
    pitch: Annotated[
        float | None, Option(min=-80, max=80, metavar="DEG", help="Pitch of the camera, positive down.")
    ] = None,
    height: Annotated[float | None, key_option(AnnotationOptions, "camera_height_m", "--height", metavar="M")] = None,
    lag: Annotated[int, key_option(LiveOptions, "lag", metavar="FRAMES")] = LiveOptions().lag,
    units: Annotated[Literal["cm", "m"], Option(help="Unit of lengths in BVH files.")] = "cm",
    clean_up: Annotated[bool, key_option(LiveOptions, "has_clean_up", "--clean-up/--no-clean-up")] = True,
) -> None:
    """Reconstruct 3D motion of people from film or 2D keypoints, with a study's projection database.

    Inputs are OpenPose folders, COCO annotations and result lists, MediaPipe landmarks, and the CSV and npz of the
    docs; each camera in a folder is a sequence.  --follow reads a folder of OpenPose files while it is being written.

    \b
      pasdedeux reconstruct walk/ --out out/      BVH, npz, a GLB and a page
      pasdedeux reconstruct dance.mp4 --out out/  film: --detect, else as fetched
      pasdedeux reconstruct walk/ --database projections:duets --follow
                                                  live: JSON lines, frame by frame
      pasdedeux reconstruct front.json --camera side.json --out out/
                                                  a take that two cameras saw

    Image size, rate and focal length come from the files if stated there, else from --set with the keys of a study
    (image_size_px, rate_hz, focal_px or fov_deg).  --set people_file=FILE overrides identities with an edited copy of
    the table that was written.  The camera pitch is estimated (with --follow: 10 degrees).  --height or --stature fixes
    the scale (with --follow, --stature).

    With --camera, clocks are found by how people move, and cameras by the people themselves, or by --calibration; --set
    is of all cameras, --pitch, --height and --stature are of the first.

    With --follow, each pose is written --lag frames after its image; the first two seconds of a person are written when
    they are over.  It ends with Ctrl-C, when a file STOP appears in the folder, or after --idle seconds without a new
    file; pending poses and a summary of the delays are then written.
    """
    video = find_video(path, settings or (), keys, detections, detect)
    if calibration and not camera:
        raise InputError("--calibration is of several cameras: name the others by --camera")
    if follow:
        if isinstance(video, FilmOptions):
            raise InputError("--follow reads OpenPose files, not film")
        whole_only = {"--height": height, "--person": person, "--camera": camera}
        given = [name for name, value in whole_only.items() if value] + ["--units"] * (units != "cm")
        footage = {"rate_hz", "image_size_px", "focal_px", "fov_deg", "statures_m"}
        given += sorted(f"--set {key}" for key in video.model_fields_set - {"id", "path"} - footage)
        if given:
            raise InputError(f"{given[0]} is for whole videos; leave it out with --follow")
        options = LiveOptions(lag=lag, has_clean_up=clean_up)
        follow_video(video, database, store, out, pitch_deg=pitch, statures=stature or (), idle_s=idle, options=options)
        return
    # Quick checks come before any film is read, which may take a detector minutes.
    names = camera_names([path, *(camera or ())])
    calibrated = find_calibration(calibration, names)
    found_others = [find_camera(other, settings or (), detect) for other in camera or ()]
    named_m = dict(video.statures_m) | read_statures(stature or (), [])
    videos = sources_of(video)
    if found_others:
        check_one_video(f"camera {names[0]}", [source.parameters.id for source in videos])
        calibrated.for_images([film_size_px(shown) for shown in (*videos, *found_others)])
    wanted = _Wanted(
        database=find_database(database, store, with_pairs=True),
        camera=StatedCamera(None if pitch is None else math.radians(pitch), height or video.camera_height_m),
        calibration=calibrated,
        person_ids=person or (),
        statures=stature or (),
        named_m=named_m,
        has_clean_up=clean_up,
        out=out or Path(),
        units=units,
    )
    listener = make_listener()
    failed: list[InputError] = []
    num_made, known = 0, set[int]()
    try:
        others = []
        for name, source in zip(names[1:], found_others, strict=True):
            _note_film(name, source, listener)
            others.append(read_camera(name, source))
        for source in videos:
            _note_film(source.parameters.id, source, listener)
            listener.note(f"reading {source.in_words()}")
            try:
                resolved = source.resolve()
            except InputError as error:
                failed.append(error)
                continue
            known |= set(resolved.frames.person_id.tolist())
            if others:
                check_one_video(f"camera {names[0]}", [sequence.sequence_id for sequence in resolved.sequences])
            for sequence in resolved.sequences:
                try:
                    listener.note(f"{sequence.sequence_id}: looking for poses, camera and sizes")
                    _reconstruct_sequence(wanted, source, resolved, sequence, others, listener)
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


@dataclass(frozen=True)
class _Wanted:
    """Options of the command.

    Args:
        database: Poses to search.
        camera: Stated pitch and height of the first camera.
        calibration: The calibrated cameras, if any.
        person_ids: The people to reconstruct; all if empty.
        statures: Stated statures, PERSON=METRES or METRES.
        named_m: Statures of single people, metres, also those of the source.
        has_clean_up: Whether motions are cleaned up.
        out: Folder for the files.
        units: Unit of lengths in BVH files.
    """

    database: SearchedDatabase
    camera: StatedCamera
    calibration: Calibration
    person_ids: Sequence[int]
    statures: Sequence[str]
    named_m: dict[int, float]
    has_clean_up: bool
    out: Path
    units: str


def _note_film(name: str, source: FoundAnnotations, listener: Listener) -> None:
    if isinstance(source, FoundFilm):
        listener.note(f"{name}: finding people in the film and following them")


def _reconstruct_sequence(
    wanted: _Wanted,
    source: FoundAnnotations,
    resolved: ResolvedPeople,
    sequence: SequencePeople,
    others: Sequence[OtherCamera],
    listener: Listener,
) -> None:
    """Reconstruct one sequence, with the other cameras of its take, and write its files.

    Raises:
        InputError: A requested person is missing, or nobody can be reconstructed.
    """
    tracks, motion = steady_tracks(resolved, sequence)
    known = [track.person_id for track in tracks]
    if unknown := sorted(set(wanted.person_ids) - set(known)):
        raise InputError(f"the input has no person {unknown[0]}; people: {', '.join(map(str, known)) or 'none'}")
    tracks = [track for track in tracks if track.person_id in (wanted.person_ids or known)]
    if not tracks:
        raise InputError("no frame shows enough joints of a person")
    shown = {track.person_id for track in tracks}
    statures_m = read_statures(wanted.statures, shown) | wanted.named_m
    options = SequenceOptions(
        has_clean_up=wanted.has_clean_up,
        statures_m={person_id: metres for person_id, metres in statures_m.items() if person_id in shown},
    )
    footage, cameras = [CameraData(motion, source if isinstance(source, FoundFilm) else None)], list[SeenBy]()
    if others:
        calibrated = wanted.calibration.for_images(
            [image_size_px(resolved, sequence), *(other.size_px for other in others)]
        )
        together = reconstruct_views(
            [tracks, *(other.tracks for other in others)],
            wanted.database,
            wanted.camera,
            options,
            names=wanted.calibration.names,
            calibration=calibrated,
            on_camera=StepReporter(listener, 1 + len(others)),
        )
        reconstruction, cameras = Reconstruction(together.people, together.judged), together.cameras
        footage += [other.footage for other in others]
        if calibrated:
            footage = [replace(shot, calibrated=given) for shot, given in zip(footage, calibrated, strict=True)]
        say([seen.in_words(upright_m(together.people)) for seen in cameras])
        for line in together.left_out:
            echo(line, err=True)
    else:
        on_step = StepReporter(listener, 1 + 2 * len(tracks))
        reconstruction = reconstruct_sequence(
            tracks, wanted.database, wanted.camera, options, sequence_id=sequence.sequence_id, on_step=on_step
        )
    people = reconstruction.people
    if not people.methods:
        raise InputError(f"nobody can be reconstructed: {next(iter(people.skipped.values()))}")
    written = write_reconstruction(
        reconstruction, sequence, wanted.out, units=wanted.units, footage=footage, cameras=cameras
    )
    say(format_table(_HEADER, written.rows, text_columns=(0, len(_HEADER) - 1)))
    say(
        [f"{written.decisions}: identities; to correct them, edit a copy and give it with --set people_file=COPY"],
        err=True,
    )
    echo(f"look at it: {written.page}")
    for person_id, reason in people.skipped.items():
        echo(f"person {person_id} was skipped: {reason}", err=True)
    say([f"{people.pitch.in_words()}; {sequence.in_words()}"], err=True)
