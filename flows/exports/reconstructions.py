"""The files of a reconstructed sequence: BVH and npz for each person, a GLB, decisions on people, and a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flows.exports.casts import Rig
from flows.exports.export_format import FileNames, write_text
from flows.exports.glb_figures import glb_person
from pasdedeux.arrays import Array
from pasdedeux.evaluation.motion_players import reconstruction_player
from pasdedeux.evaluation.pictures import PLAYER, Picture, shown_frames
from pasdedeux.film.drawing import blur_faces, draw_people, moving_svg
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.camera_motion import CameraMotion
from pasdedeux.formats.glb import GlbCamera, write_glb
from pasdedeux.formats.humanoid import AXES, units_text, write_npz
from pasdedeux.kinematics.rotations import unitquat_from_rotmat
from pasdedeux.people.decisions import write_decisions
from pasdedeux.people.resolution import SequencePeople
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction.body import soles_m
from pasdedeux.reconstruction.people import ReconstructedPeople
from pasdedeux.reconstruction.sequence import Reconstruction
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Verdict
from tasks.data import player_page
from tasks.ingest.film.resolution import shot_images
from tasks.ingest.film.run import FoundFilm

_FILM_PX = 480
"""Longer side of the film on the page."""


@dataclass(frozen=True)
class WrittenReconstruction:
    """What was written of a sequence.

    Args:
        rows: For each person, then each couple's distance: file, frames, expected error, misfit, misfit of left-out
            clips, share of joints seen, share of frames bridged, and verdict, in words.
        decisions: The table of who is who.
        page: The page that shows it.
    """

    rows: list[tuple[str, ...]]
    decisions: Path
    page: Path


def write_reconstruction(
    reconstruction: Reconstruction,
    sequence: SequencePeople,
    out: Path,
    *,
    units: str,
    motion: CameraMotion | None = None,
    film: FoundFilm | None = None,
) -> WrittenReconstruction:
    """Write the files of one sequence; those of an earlier call are replaced.

    Args:
        reconstruction: The people, at least one.
        sequence: What was decided of the sequence.
        out: Folder; made where it is not there.
        units: Unit of lengths in BVH files, "cm" or "m".
        motion: How the camera moves, where that was subtracted.
        film: The shot that shows them, where it is one.
    """
    out.mkdir(parents=True, exist_ok=True)
    names, people = FileNames(out), reconstruction.people
    rows: list[tuple[str, ...]] = []
    for name, judged in reconstruction.judged.people.items():
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
    for (first, second), place in reconstruction.judged.places.items():
        rows.append(
            (f"place of {first} and {second}", "", place.expected_in_words, *[""] * 4, _in_words(place.verdict))
        )
    write_text(names.path(sequence.sequence_id, "units", suffix=".txt"), units_text(human, units))
    decisions = names.path(sequence.sequence_id, "people", suffix=".csv")
    write_text(decisions, write_decisions(sequence.decisions))
    page = names.path(sequence.sequence_id, suffix=".html")
    page.with_suffix(".glb").write_bytes(_glb(people))
    pictures, said = [_shown(people, sequence.sequence_id)], [motion.in_words()] if motion is not None else []
    if film is not None and film.parameters.is_constant_rate:
        pictures.append(_over_film(people, film, film.resolve().frames, motion))
    write_text(page, player_page(sequence.sequence_id, pictures, said))
    return WrittenReconstruction(rows, decisions, page)


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
        rows += [(int(frame), person.person_id, points) for frame, points in zip(person.track.frames, px, strict=True)]
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


def _shown(people: ReconstructedPeople, sequence_id: str) -> Picture:
    """Show the people of a sequence upright, beside the 2D poses that they were found in."""
    made, lens_factor = people.methods[-1], 1.0 if people.scene is None else people.scene.lens_factor
    origin_m, soles = made.origin_m, soles_m(made.bodies)
    frames = np.unique(np.concatenate([person.track.frames for person in made.people]))
    shape = len(frames), len(made.people), 14
    upright_m, seen_px, projected_px = (np.full((*shape, axes), np.nan) for axes in (3, 2, 2))
    for number, person in enumerate(made.people):
        at, lens = np.searchsorted(frames, person.track.frames), person.track.lens
        upright_m[at, number] = (person.positions_m - origin_m) @ people.camera_from_upright_rotmat + [0.0, soles, 0.0]
        seen_px[at, number] = person.track.keypoints_px
        projected_px[at, number] = _projected_px(
            person.positions_m, lens.principal_point_px, lens_factor * lens.focal_px
        )
    rate_hz = made.people[0].track.rate_hz
    player = reconstruction_player(
        upright_m, rate_hz=rate_hz, keypoints_px=seen_px, projected_px=projected_px, has_floor=True
    )
    caption = f"{sequence_id}: the reconstruction over its 2D poses, and in the room (five seconds from the middle)."
    return Picture(f"{sequence_id}{PLAYER}", caption, player)


def _in_words(verdict: Verdict) -> str:
    return verdict.level.value + (f": {verdict.reason}" if verdict.reason else "")
