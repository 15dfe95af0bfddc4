"""`reconstruct`: 3D motion of people from 2D poses or film, at once or while files are being written."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from typer import Argument, Option

from flows.console.annotate import DetectionsOption, DetectOption, KeysOption, film_source
from flows.console.context import StoreOption, app, echo, key_option, say
from flows.console.display import Steps, format_table, make_listener
from flows.console.inputs import find_database, find_source, read_statures
from flows.console.live import follow_video
from flows.exports.casts import Rig
from flows.exports.export_format import FileNames, write_text
from flows.exports.glb_figures import glb_person
from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.evaluation.motion_players import reconstruction_player
from pasdedeux.evaluation.pictures import PLAYER, Picture, shown_frames
from pasdedeux.film.drawing import blur_faces, draw_people, moving_svg
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.camera_motion import CameraMotion
from pasdedeux.formats.glb import GlbCamera, write_glb
from pasdedeux.formats.humanoid import AXES, units_text, write_npz
from pasdedeux.kinematics.rotations import unitquat_from_rotmat
from pasdedeux.people.decisions import write_decisions
from pasdedeux.people.resolution import ResolvedPeople, SequencePeople
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction.body import soles_m
from pasdedeux.reconstruction.live.person import LiveOptions
from pasdedeux.reconstruction.moving_camera import subtract_motion
from pasdedeux.reconstruction.people import ReconstructedPeople, SequenceOptions
from pasdedeux.reconstruction.sequence import Reconstruction, StatedCamera, reconstruct_sequence
from pasdedeux.reconstruction.tracks import tracks_of
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Verdict
from tasks.data import player_page
from tasks.ingest.film.detector_files import fetched_detectors
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.readers import is_film
from tasks.ingest.film.resolution import shot_images
from tasks.ingest.film.run import FoundFilm, find_videos
from tasks.ingest.poses2d.parameters import AnnotationOptions
from tasks.ingest.poses2d.resolution import FoundAnnotations, find_annotations
from tasks.ingest.poses2d.run import stated_of_nobody, track_columns

_FILM_PX = 480
"""Longer side of the film on the page."""
_HEADER = ("file", "frames", "expected error", "misfit", "left-out clips", "seen", "bridged", "verdict")


@app.command()
def reconstruct(
    path: Annotated[Path, Argument(metavar="FILE_OR_DIR", help="2D poses: a file, or a folder of them; or film.")],
    keys: KeysOption = None,
    detections: DetectionsOption = None,
    detect: DetectOption = None,
    database: Annotated[str | None, Option(metavar="REF", help="Projections; default: the store's only ones.")] = None,
    store: StoreOption = Path("store"),
    out: Annotated[
        Path | None, Option(help="Folder for BVH files and a page, this one by default; with --follow a file.")
    ] = None,
    follow: Annotated[bool, Option("--follow", help="Read files while they are being written.")] = False,
    idle: Annotated[float, Option(min=0.0, metavar="S", help="End after this time without a new file, seconds.")] = 5.0,
    settings: Annotated[
        list[str] | None, Option("--set", metavar="KEY=C", help="A key of the source, such as rate_hz=60.")
    ] = None,
    stature: Annotated[list[str] | None, Option(metavar="[PERSON=]M", help="Stature of all, or of a person.")] = None,
    person: Annotated[list[int] | None, Option(min=0, metavar="N", help="Only this person; repeatable.")] = None,
    pitch: Annotated[float | None, Option(min=-80, max=80, metavar="DEG", help="Pitch of the camera, down.")] = None,
    height: Annotated[float | None, key_option(AnnotationOptions, "camera_height_m", "--height", metavar="M")] = None,
    lag: Annotated[int, key_option(LiveOptions, "lag", metavar="FRAMES")] = LiveOptions().lag,
    units: Annotated[Literal["cm", "m"], Option(help="Unit of lengths in BVH files.")] = "cm",
    clean_up: Annotated[bool, key_option(LiveOptions, "has_clean_up", "--clean-up/--no-clean-up")] = True,
) -> None:
    """Reconstruct the 3D motion of people from 2D keypoints, with a study's projection database.

    Inputs are OpenPose folders, COCO annotations and result lists, MediaPipe landmarks, and the CSV and npz of the
    docs; each camera in a folder is a sequence.  --follow reads a folder of OpenPose files while it is being written.

    \b
      pasdedeux reconstruct walk/ --out out/                              BVH and npz for each person, a GLB, a page
      pasdedeux reconstruct walk/ --database projections:duets --follow   a JSON line per person and frame, live
      pasdedeux reconstruct dance.mp4 --out out/      film, by the detector that was fetched; also --keys, --detect

    Image size, rate and focal length come from the files if stated there, else from --set with the keys of a study
    (image_size_px, rate_hz, focal_px or fov_deg).  --set people_file=FILE overrides identities with an edited copy of
    the table that was written.  The camera pitch is estimated (with --follow: 10 degrees).  --height or --stature fixes
    the scale (with --follow, --stature).

    With --follow, each pose is written --lag frames after its image; the first two seconds of a person are written when
    they are over.  It ends with Ctrl-C, when a file STOP appears in the folder, or after --idle seconds without a new
    file; pending poses and a summary of the delays are then written.
    """
    has_source = bool(keys or detections or detect)
    video = (
        film_source(path, settings or (), keys, detections, detect)
        if has_source or (is_film(path) and fetched_detectors())
        else find_source(AnnotationOptions, path, settings or ())
    )
    if follow:
        if isinstance(video, FilmOptions):
            raise InputError("--follow reads OpenPose files, not film")
        whole_only = {"--height": height, "--person": person}
        given = [name for name, value in whole_only.items() if value] + ["--units"] * (units != "cm")
        footage = {"rate_hz", "image_size_px", "focal_px", "fov_deg", "statures_m"}
        given += sorted(f"--set {key}" for key in video.model_fields_set - {"id", "path"} - footage)
        if given:
            raise InputError(f"{given[0]} is for whole videos: with --follow, leave it out")
        options = LiveOptions(lag=lag, has_clean_up=clean_up)
        follow_video(video, database, store, out, pitch_deg=pitch, statures=stature or (), idle_s=idle, options=options)
        return
    _reconstruct_video(
        video,
        database,
        store,
        out or Path(),
        units=units,
        pitch_deg=pitch,
        camera_height_m=height,
        person_ids=person or (),
        statures=stature or (),
        has_clean_up=clean_up,
    )


def _reconstruct_video(
    video: AnnotationOptions | FilmOptions,
    database: str | None,
    store: Path,
    out: Path,
    *,
    units: str,
    pitch_deg: float | None,
    camera_height_m: float | None,
    person_ids: Sequence[int],
    statures: Sequence[str],
    has_clean_up: bool,
) -> None:
    """Write a BVH and an npz file per person of every sequence of 2D poses, read as a study reads them.

    Raises:
        InputError: Nothing that can be read, no projections, a stature of another form, keypoints that are not people,
            or nobody who can be reconstructed.
    """
    named_m = dict(video.statures_m) | read_statures(statures, [])
    videos = find_videos(video) if isinstance(video, FilmOptions) else find_annotations(video)
    searched = find_database(database, store, with_pairs=True)
    camera = StatedCamera(
        None if pitch_deg is None else math.radians(pitch_deg), camera_height_m or video.camera_height_m
    )
    listener = make_listener()

    def reconstruct(source: FoundAnnotations, resolved: ResolvedPeople, sequence: SequencePeople) -> None:
        if sequence.why_not_followed:
            raise InputError(sequence.why_not_followed)
        motion = resolved.frames.camera_motion.get(sequence.sequence_id)
        tracks, is_steadied = subtract_motion(tracks_of(track_columns(resolved), sequence.sequence_id), motion)
        if motion is not None:
            echo(f"{sequence.sequence_id}: {motion.in_words(is_subtracted=is_steadied)}", err=True)
        for doubt in resolved.frames.doubts:
            echo(f"{sequence.sequence_id}: {doubt}", err=True)
        known = [track.person_id for track in tracks]
        if unknown := sorted(set(person_ids) - set(known)):
            raise InputError(f"person {unknown[0]} is not in it; people: {', '.join(map(str, known)) or 'none'}")
        tracks = [track for track in tracks if track.person_id in (person_ids or known)]
        if not tracks:
            raise InputError("no frame shows enough joints of a person")
        shown = {track.person_id for track in tracks}
        stated_m = {
            name: stature for name, stature in (read_statures(statures, shown) | named_m).items() if name in shown
        }
        reconstruction = reconstruct_sequence(
            tracks,
            searched,
            camera,
            SequenceOptions(has_clean_up=has_clean_up, statures_m=stated_m),
            sequence_id=sequence.sequence_id,
            on_step=Steps(listener, 1 + 2 * len(tracks)),
        )
        if not reconstruction.people.methods:
            raise InputError(f"nobody can be reconstructed: {next(iter(reconstruction.people.skipped.values()))}")
        found_film = source if isinstance(source, FoundFilm) else None
        _write_sequence(reconstruction, sequence, out, units, motion if is_steadied else None, found_film)

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
                    listener.note(f"{sequence.sequence_id}: looking for poses, camera and sizes")
                    reconstruct(video_found, resolved, sequence)
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
    motion: CameraMotion | None,
    film: FoundFilm | None,
) -> None:
    """Write files of every person of one sequence, and say how good they are.

    Args:
        found: The people.
        sequence: What was decided of the sequence.
        out: Folder.
        units: Unit of lengths in BVH files.
        motion: How the camera moves, where that was subtracted.
        film: The shot that shows them, where it is one.
    """
    out.mkdir(parents=True, exist_ok=True)
    names, people = FileNames(out), found.people
    rows: list[tuple[str, ...]] = []
    for name, judged in found.judged.people.items():
        human = people.motions[name]
        path = write_text(names.path(sequence.sequence_id, name, suffix=".bvh"), human.bvh(units))
        frames = human.first_frame + np.arange(human.motion.num_frames)
        steady = {} if motion is None else {"steady_from_image": motion.at(frames)}
        path.with_suffix(".npz").write_bytes(write_npz(human, **people.camera_facts, **steady))
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
    write_text(names.path(sequence.sequence_id, "units", suffix=".txt"), units_text(human, units))
    decisions = names.path(sequence.sequence_id, "people", suffix=".csv")
    write_text(decisions, write_decisions(sequence.decisions))
    echo(f"{decisions}: who is who; --set people_file=COPY with changes overrules it", err=True)
    page = names.path(sequence.sequence_id, suffix=".html")
    page.with_suffix(".glb").write_bytes(_glb(people))
    pictures, said = [_shown(people, sequence.sequence_id)], [motion.in_words()] if motion is not None else []
    if film is not None and film.parameters.is_constant_rate:
        pictures.append(_over_film(people, film, film.resolve().frames, motion))
    write_text(page, player_page(sequence.sequence_id, pictures, said))
    echo(f"look at it: {page}")
    for person_id, reason in people.skipped.items():
        echo(f"person {person_id} was skipped: {reason}", err=True)
    echo(f"{people.pitch.in_words()}; {sequence.in_words()}", err=True)


def _glb(people: ReconstructedPeople) -> bytes:
    """Return the people with bodies, and their camera, as a GLB file."""
    camera, figures = people.camera, []
    for name, human in people.motions.items():
        height_m = float(body_height_m(BODY22, np.linalg.norm(human.motion.rest_offsets_m, axis=-1)))
        figures.append(glb_person(f"person {name}", Rig(human.motion, height_m)))
    width, height = camera.image_size_px
    seen_by = GlbCamera(
        camera.position_m,
        unitquat_from_rotmat(camera.camera_from_world_rotmat.T),
        2.0 * math.atan(0.5 * height / camera.focal_px),
        width / height,
    )
    facts = {"unit": "m", "axes": AXES, "rate_hz": figures[0].motion.rate_hz}
    return write_glb(figures, copyright_text="", facts=facts, camera=seen_by)


def _over_film(
    people: ReconstructedPeople, film: FoundFilm, seen: AnnotatedFrames, motion: CameraMotion | None
) -> Picture:
    """Show the reconstruction over the images of its film, from the middle of it, faces blurred."""
    tracks, camera = people.methods[-1].people, people.camera
    first = film.parameters.first_number + film.parameters.first_frame
    rows: list[tuple[int, int, Array]] = []
    for person in tracks:
        px = _projected_px(person.positions_m, camera.principal_point_px, camera.focal_px)
        px = px if motion is None else motion.image_px(person.track.frames, px)
        rows += [(int(frame), person.person_id, one) for frame, one in zip(person.track.frames, px, strict=True)]
    frame, person_id, points = (np.array(column) for column in zip(*rows, strict=True))
    drawn_over = AnnotatedFrames("op14", ("film",) * len(rows), frame, person_id, points, np.ones(points.shape[:2]))
    rate_hz = tracks[0].track.rate_hz
    chosen, shown_hz = shown_frames(int(np.ptp(frame)) + 1, rate_hz)
    wanted, images = set((frame.min() + chosen).tolist()), []
    for number, image in enumerate(shot_images(film.parameters, film.files), start=first):
        if number in wanted:
            drawn = draw_people(blur_faces(image.image, seen, number), drawn_over, number)
            size = [max(1, round(side * min(1.0, _FILM_PX / max(drawn.shape[:2])))) for side in drawn.shape[1::-1]]
            images.append(np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), dtype=np.uint8))
    caption = f"{film.parameters.id}: the reconstruction, seen by its camera, over the film; faces are blurred."
    return Picture(f"{film.parameters.id}-film.svg", caption, moving_svg(images, shown_hz))


def _projected_px(positions_m: Array, middle_px: Sequence[float] | Array, focal_px: float) -> Array:
    """Return where points (*batch, 3) in camera axes are in the image, pixels."""
    return np.asarray(
        np.asarray(middle_px) + focal_px * positions_m[..., :2] / np.maximum(-positions_m[..., 2:], 1e-3) * (1, -1)
    )


def _shown(found: ReconstructedPeople, sequence_id: str) -> Picture:
    """Show the people of a sequence upright, beside the 2D poses that they were found in."""
    people, lens_factor = found.methods[-1].people, 1.0 if found.scene is None else found.scene.lens_factor
    made = found.methods[-1]
    origin_m, soles = made.origin_m, soles_m(made.bodies)
    frames = np.unique(np.concatenate([person.track.frames for person in people]))
    upright_m, seen_px, projected_px = (np.full((len(frames), len(people), 14, axes), np.nan) for axes in (3, 2, 2))
    for number, person in enumerate(people):
        at, lens = np.searchsorted(frames, person.track.frames), person.track.lens
        upright_m[at, number] = (person.positions_m - origin_m) @ found.camera_from_upright_rotmat + [0.0, soles, 0.0]
        seen_px[at, number] = person.track.keypoints_px
        projected_px[at, number] = _projected_px(
            person.positions_m, lens.principal_point_px, lens_factor * lens.focal_px
        )
    rate_hz = people[0].track.rate_hz
    player = reconstruction_player(
        upright_m, rate_hz=rate_hz, keypoints_px=seen_px, projected_px=projected_px, has_floor=True
    )
    caption = f"{sequence_id}: the reconstruction over its 2D poses, and turning; five seconds from the middle."
    return Picture(f"{sequence_id}{PLAYER}", caption, player)


def _in_words(verdict: Verdict) -> str:
    return verdict.level.value + (f": {verdict.reason}" if verdict.reason else "")
