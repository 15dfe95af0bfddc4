"""Files of a reconstructed sequence: BVH and npz for each person, a GLB, decisions on people, and a page."""

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
from pasdedeux.arrays import Array, Integers
from pasdedeux.evaluation.motion_players import seen_player
from pasdedeux.evaluation.pictures import PLAYER, Picture, shown_frames
from pasdedeux.film.drawing import blur_faces, draw_people, moving_svg
from pasdedeux.film.tracking import Image
from pasdedeux.formats.glb import GlbCamera, write_glb
from pasdedeux.formats.humanoid import AXES, units_text, write_npz
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.calibration import CalibratedCamera
from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from pasdedeux.kinematics.rotations import unitquat_from_rotmat
from pasdedeux.people.decisions import write_decisions
from pasdedeux.people.resolution import SequencePeople
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction.people import ReconstructedPeople
from pasdedeux.reconstruction.sequence import Reconstruction
from pasdedeux.reconstruction.views.cameras import SeenBy, camera_facts, seen_alone, spanned_frames, upright_m
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Verdict
from tasks.data import player_page
from tasks.ingest.film.resolution import shot_images
from tasks.ingest.film.run import FoundFilm

_FILM_PX = 480
"""Longer side of the film on the page."""
_ERRORS = (
    "An expected error is the mean distance of a joint from its true place, about the hips, estimated from "
    "the film alone; in brackets the range of four in five cases. The place of two people is the vector between them."
)


@dataclass(frozen=True)
class WrittenReconstruction:
    """The written files of a sequence.

    Args:
        rows: For each person, then each couple's distance: file, frames, expected error, misfit, misfit of left-out
            clips, share of joints seen, share of frames bridged, and verdict, in words.
        decisions: The table of identities.
        page: The page with the result.
    """

    rows: list[tuple[str, ...]]
    decisions: Path
    page: Path


@dataclass(frozen=True)
class CameraData:
    """Further data of a camera beside its keypoints.

    Args:
        motion: The camera motion, if it was subtracted.
        film: The shot of film, if there is one.
        calibrated: The calibrated camera, if there is one.
    """

    motion: CameraMotion | None = None
    film: FoundFilm | None = None
    calibrated: CalibratedCamera | None = None

    def image_px(self, frames: Integers, px: Array) -> Array:
        """Map pixels (frame, *batch, 2) of the steady camera without distortion to its images."""
        px = px if self.calibrated is None else self.calibrated.distorted_px(px)
        return px if self.motion is None else self.motion.image_px(frames, px)


def write_reconstruction(
    reconstruction: Reconstruction,
    sequence: SequencePeople,
    out: Path,
    *,
    units: str,
    footage: Sequence[CameraData] = (CameraData(),),
    cameras: Sequence[SeenBy] = (),
) -> WrittenReconstruction:
    """Write the files of one sequence; those of an earlier call are replaced.

    Args:
        reconstruction: The people, at least one.
        sequence: The decisions on the sequence.
        out: Folder; created if it is missing.
        units: Unit of lengths in BVH files, "cm" or "m".
        footage: Further data of each camera.
        cameras: The cameras, if there are several.
    """
    out.mkdir(parents=True, exist_ok=True)
    names, people = FileNames(out), reconstruction.people
    cameras = cameras or [seen_alone(people)]
    placed_m = upright_m(people)
    rows: list[tuple[str, ...]] = []
    for name, judged in reconstruction.judged.people.items():
        human = people.motions[name]
        path = write_text(names.path(sequence.sequence_id, name, suffix=".bvh"), human.bvh(units))
        frames = human.first_frame + np.arange(human.motion.num_frames)
        facts = {**people.camera_facts, **camera_facts(cameras, placed_m), **_steady_facts(cameras, footage, frames)}
        path.with_suffix(".npz").write_bytes(write_npz(human, **facts))
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
    page.with_suffix(".glb").write_bytes(_glb(people, cameras))
    rate_hz = people.methods[-1].people[0].track.rate_hz
    caption = f"{sequence.sequence_id}: the reconstruction over its 2D poses, and in the room."
    pictures = [Picture(f"{sequence.sequence_id}{PLAYER}", caption, seen_player(placed_m, cameras, rate_hz=rate_hz))]
    camera_words = [seen.in_words(placed_m) for seen in cameras] if len(cameras) > 1 else []
    said = [_ERRORS, *(f"{words[0].upper()}{words[1:]}." for words in camera_words)]
    for seen, shot in zip(cameras, footage, strict=True):
        if shot.motion is not None:
            said.append(
                shot.motion.in_words() if not camera_words else f"Camera {seen.name}: {shot.motion.in_words()}."
            )
        if shot.film is not None and shot.film.parameters.is_constant_rate:
            images, shown_hz = _over_film(people, placed_m, seen, shot, shot.film)
            whose = f"camera {seen.name}" if camera_words else shot.film.parameters.id
            caption = f"{whose}: the reconstruction over the film; faces are blurred."
            pictures += [Picture(f"{whose}-film.svg", caption, moving_svg(images, shown_hz))] if images else []
    verdicts = reconstruction.judged.verdicts_with_errors
    write_text(page, player_page(sequence.sequence_id, pictures, said, verdicts))
    return WrittenReconstruction(rows, decisions, page)


def _steady_facts(cameras: Sequence[SeenBy], footage: Sequence[CameraData], frames: Integers) -> dict[str, Array]:
    """Return the homographies to the steady images at frames of the first camera, if a camera moves.

    They are `steady_from_image` (frame, 3, 3) of the first camera and, of several, `cameras_steady_from_image`
    (camera, frame, 3, 3) at the nearest frame of each; the identity where one does not move.
    """
    times_s, matrices = cameras[0].first_time_s + frames / cameras[0].rate_hz, []
    for seen, shot in zip(cameras, footage, strict=True):
        theirs = np.rint((times_s - seen.first_time_s) * seen.rate_hz).astype(np.int64)
        matrices.append(np.tile(np.eye(3), (len(frames), 1, 1)) if shot.motion is None else shot.motion.at(theirs))
    facts = {} if footage[0].motion is None else {"steady_from_image": matrices[0]}
    if len(cameras) > 1 and any(shot.motion is not None for shot in footage):
        facts["cameras_steady_from_image"] = np.stack(matrices)
    return facts


def _glb(people: ReconstructedPeople, cameras: Sequence[SeenBy]) -> bytes:
    """Return the people with bodies, and their cameras, as a GLB file."""
    figures, seen_by = [], []
    for name, human in people.motions.items():
        height_m = float(body_height_m(BODY22, np.linalg.norm(human.motion.rest_offsets_m, axis=-1)))
        figures.append(glb_person(f"person {name}", Rig(human.motion, height_m)))
    for seen in cameras:
        width, height = seen.camera.image_size_px
        seen_by.append(
            GlbCamera(
                "camera" if len(cameras) == 1 else f"camera {seen.name}",
                seen.camera.position_m,
                unitquat_from_rotmat(seen.camera.camera_from_world_rotmat.T),
                2.0 * math.atan(0.5 * height / seen.camera.focal_px),
                width / height,
            )
        )
    facts = {"unit": "m", "axes": AXES, "rate_hz": figures[0].motion.rate_hz}
    return write_glb(figures, copyright_text="", facts=facts, cameras=seen_by)


def _over_film(
    people: ReconstructedPeople, placed_m: Array, seen: SeenBy, shot: CameraData, film: FoundFilm
) -> tuple[list[Image], float]:
    """Draw the reconstruction over images from the middle of a film, faces blurred; return them with their rate.

    There are no images if the film and the reconstruction do not overlap in time.
    """
    tracks, first = people.methods[-1].people, film.parameters.first_number + film.parameters.first_frame
    times_s = (
        tracks[0].track.first_time_s + (spanned_frames(people) - tracks[0].track.first_frame) / tracks[0].track.rate_hz
    )
    ends = (
        np.ceil((times_s[0] - seen.first_time_s) * seen.rate_hz - 1e-6),
        np.floor((times_s[-1] - seen.first_time_s) * seen.rate_hz + 1e-6),
    )
    last = first + film.parameters.num_frames - 1
    numbers = np.arange(max(int(ends[0]), first), min(int(ends[1]), last) + 1)
    if not len(numbers):
        return [], seen.rate_hz
    at = (seen.first_time_s + numbers / seen.rate_hz - times_s[0]) * tracks[0].track.rate_hz
    px = shot.image_px(numbers, seen.camera.project(_between_frames(placed_m, at)).px)
    frame, person = (index.reshape(-1) for index in np.indices(px.shape[:2]))
    is_there = np.isfinite(px).all(axis=(2, 3)).reshape(-1)
    ids = np.array([track.person_id for track in tracks])
    points = px.reshape(-1, *px.shape[2:])[is_there]
    drawn_over = AnnotatedFrames(
        "op14",
        ("film",) * len(points),
        numbers[frame[is_there]],
        ids[person[is_there]],
        points,
        np.ones(points.shape[:2]),
    )
    chosen, shown_hz = shown_frames(len(numbers), seen.rate_hz)
    wanted, images, annotated = set(numbers[chosen].tolist()), [], film.resolve().frames
    for number, image in shot_images(film.parameters, film.files):
        if number in wanted:
            drawn = draw_people(blur_faces(image.image, annotated, number), drawn_over, number)
            size = [max(1, round(side * min(1.0, _FILM_PX / max(drawn.shape[:2])))) for side in drawn.shape[1::-1]]
            images.append(np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), dtype=np.uint8))
    return images, shown_hz


def _between_frames(positions_m: Array, at: Array) -> Array:
    """Interpolate joints (frame, *batch) at fractional frames (n,); NaN beside a frame of NaN.

    A frame within rounding counts as that frame, so that a person who leaves after it is still there.
    """
    at = np.where(np.abs(at - np.round(at)) < 1e-6, np.round(at), at)
    flat = positions_m.reshape(len(positions_m), -1)
    moved = [np.interp(at, np.arange(len(flat)), values) for values in flat.T]
    return np.stack(moved, axis=-1).reshape(len(at), *positions_m.shape[1:])


def _in_words(verdict: Verdict) -> str:
    return verdict.level.value + (f": {verdict.reason}" if verdict.reason else "")
