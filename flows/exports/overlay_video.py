"""Results from 2D poses drawn on their footage: a video for each sequence and method."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flows.exports.cast_files import CastFiles
from flows.exports.casts import ANNOTATED, Cast, SeenCast, casts, holds_poses
from flows.exports.export_format import POSED_OPTIONS, Export, ExportFormat, write_film
from pasdedeux.arrays import Array, Flags
from pasdedeux.bodies import Body, body_of, standing_rest_m
from pasdedeux.bodies.drawing import draw_faces
from pasdedeux.errors import InputError, named
from pasdedeux.evaluation.pictures import COLOUR_NAMES, person_rgb
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.skeletons import Skeleton
from storage_schema import Store
from storage_schema.ancestry import inputs_with
from tasks.ingest.film.readers import first_shown, image_at, open_film
from tasks.stage.facts import PeopleFacts

_GREY, _BACKGROUND = (150, 150, 150), 30
_OPAQUE = 0.75
"""Opacity of bodies over the footage."""
_MARGIN_PX, _LARGEST_PX = 40, 4096
_FAR = 250
"""An image this many frames ahead is sought; nearer ones are read through."""
_STILLS_HZ = 2.0
"""Rate of frames that are single images."""
_SAID = [
    f"MP4 files show the annotation in grey and the result as bodies, person A in {COLOUR_NAMES[0]} and B in "
    f"{COLOUR_NAMES[1]}, fitted to the annotation by scale and shift: they show poses, but not how far off a person "
    "is placed."
]


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a video for each sequence and method, on blank frames without footage."""
    files = CastFiles(export, out, _SAID)
    for cast in casts(export):
        if cast.seen is not None:
            path, rate_hz = files.path(cast, suffix=".mp4"), _STILLS_HZ if cast.labels else cast.rate_hz
            write_film(path, _drawn(export, cast, cast.seen), rate_hz)
    if not (written := files.close()):
        raise InputError(f"'{export.text}' has photographs only: there is no video to draw on")
    return written


FORMAT = ExportFormat(
    _write,
    lambda reference: reference.table in ANNOTATED and holds_poses(reference),
    ", ".join(ANNOTATED),
    options=POSED_OPTIONS | {"footage"},
)


def _drawn(export: Export, cast: Cast, seen: SeenCast) -> Iterator[Any]:
    """Yield the images of the video of one cast."""
    import cv2  # here, as the import takes a quarter of a second

    given_px, is_given, size, placed_hz = _annotation(export.store, cast, seen)
    blank = np.full((size[1], size[0], 3), _BACKGROUND, np.uint8)
    frames = (lambda _: blank) if export.footage is None else FilmImages(export.footage, placed_hz)
    bodies: list[Body | None] = []
    for at, frame in enumerate(seen.frames):
        image, people_m = frames(frame).copy(), seen.positions_m[at]
        if cast.labels or not bodies:  # single images differ in bone lengths
            bodies = _bodies(seen.skeleton, people_m[None] if cast.labels else seen.positions_m)
        scales, shifts = _laid_on(people_m, given_px[at], is_given[at], together=seen.is_pair)
        thick, corners, colours = max(2, image.shape[0] // 240), [], []
        clothed = image.copy()
        for person, body in enumerate(bodies):
            joints, colour = people_m[person], person_rgb(person)[::-1]  # OpenCV has blue, green, red
            if body is None or not np.isfinite(joints).all() or np.isnan(scales[person]):
                laid_px = scales[person] * joints[:, :2] * (1.0, -1.0) + shifts[person]
                _bones(clothed, laid_px, seen, colour, thick)
                continue
            vertices = body.posed(body.turns(seen.skeleton, joints), joints)
            laid = scales[person] * vertices[:, :2] + shifts[person] * (1.0, -1.0)  # x right, y up, pixels
            corners.append(np.column_stack([laid, np.nanmean(scales) * vertices[:, 2]])[body.faces])
            colours += [colour] * len(body.faces)
        if corners:
            draw_faces(clothed, np.concatenate(corners), np.array(colours), lambda points: points[..., :2] * (1, -1))
        image = cv2.addWeighted(clothed, _OPAQUE, image, 1.0 - _OPAQUE, 0.0)
        for person in range(len(bodies)):
            grey = np.where(is_given[at, person][:, None], given_px[at, person], np.nan)
            _bones(image, grey, seen, _GREY, thick)
        yield image


def _bodies(skeleton: Skeleton, people_m: Array) -> list[Body | None]:
    """Return bodies for positions (frame, P, J, 3), metres; None for a person never seen complete."""
    model, bodies = capsule_model(skeleton), []
    for one_m in np.moveaxis(people_m, 1, 0):
        whole = one_m[np.isfinite(one_m).all(axis=(1, 2))]
        rest = (standing_rest_m(skeleton, whole), model.radii_of(whole[:, None])[0]) if len(whole) else None
        bodies.append(body_of(skeleton, *rest) if rest else None)
    return bodies


def _bones(image: Any, points_px: Array, seen: SeenCast, colour: tuple[int, int, int], thick: int) -> None:
    """Draw the bones with known ends."""
    import cv2

    for parent, child in seen.skeleton.bones:
        ends = points_px[[parent, child]]
        if np.isfinite(ends).all() and np.abs(ends).max() < 1e5:
            start, stop = (tuple(map(int, np.round(end))) for end in ends)
            cv2.line(image, start, stop, colour, thick, cv2.LINE_AA)


def _laid_on(people_m: Array, given_px: Array, is_given: Flags, *, together: bool) -> tuple[Array, Array]:
    """Return scale (P,) and shift (P, 2), pixels, that fit people (P, J, 3), camera axes, to the annotation.

    A pair is fitted as a whole, people of a video one by one; NaN if fewer than two joints are given.
    """
    flat = people_m[..., :2] * (1.0, -1.0)
    scales, shifts = np.full(len(flat), np.nan), np.full((len(flat), 2), np.nan)
    for who in [slice(None)] if together else [slice(at, at + 1) for at in range(len(flat))]:
        is_both = is_given[who] & np.isfinite(flat[who]).all(axis=-1)
        if is_both.sum() > 1:
            start, end = flat[who][is_both], given_px[who][is_both]
            middle, to = start.mean(axis=0), end.mean(axis=0)
            scales[who] = np.sum((start - middle) * (end - to)) / max(float(np.sum((start - middle) ** 2)), 1e-12)
            shifts[who] = to - scales[who][:1] * middle
    return scales, shifts


def _annotation(store: Store, cast: Cast, seen: SeenCast) -> tuple[Array, Flags, tuple[int, int], float | None]:
    """Return the annotation of a cast (frame, P, J, 2) in pixels, which of it is given, and the size of its images.

    Also return the rate that ingest used for the frames, if the film's own rate is not constant.
    """
    assert cast.ref is not None
    ref = next(inputs_with(store, cast.ref, "annotations"))
    name = seen.skeleton.name
    columns = ["sequence_id", "frame", "person_id", f"{name}_px", f"{name}_confidence"]
    rows = store.read(ref, "annotations", columns=[*columns, "image_width_px", "image_height_px"])
    place = {frame: at for at, frame in enumerate(seen.frames)}
    who = {person_id: at for at, person_id in enumerate(seen.person_ids)}
    given = np.full((len(place), len(who), seen.skeleton.num_joints, 2), np.nan)
    is_sure = np.zeros(given.shape[:-1], dtype=bool)
    size = (0, 0)
    for row in np.flatnonzero(np.asarray(rows["sequence_id"]) == seen.sequence_id).tolist():
        at, person = place.get(int(rows["frame"][row])), who.get(int(rows["person_id"][row]))
        if at is not None and person is not None:
            given[at, person] = rows[f"{name}_px"][row]
            is_sure[at, person] = rows[f"{name}_confidence"][row] > 0
        if not rows.is_null("image_width_px")[row]:
            size = int(rows["image_width_px"][row]), int(rows["image_height_px"][row])
    is_given = is_sure & np.isfinite(given).all(axis=-1)
    if not all(size) and is_given.any():
        size = tuple(np.clip(given[is_given].max(axis=0) + _MARGIN_PX, 2, _LARGEST_PX).astype(int).tolist())
    manifest = store.manifest(ref)
    placed_hz = None if manifest.parameters.get("is_constant_rate", True) else PeopleFacts.of(manifest).rate_hz
    return given, is_given, (max(size[0], 64), max(size[1], 64)), placed_hz


class FilmImages:
    """The images of a film by the frames of its annotations; read as a stream, with seeks to earlier frames.

    Args:
        path: The film, or a folder of numbered images.
        rate_hz: Rate of its annotations, if its own is not constant; else None.

    Raises:
        InputError: The film cannot be read.
    """

    def __init__(self, path: Path, rate_hz: float | None = None) -> None:
        with named("footage"):
            self._film = open_film(path)
        self._name, count = path.name, self._film.num_frames
        # The first frame of each image.
        numbers = self._film.first_number + np.arange(count)
        self._shown = numbers if rate_hz is None else first_shown(self._film.times_s, rate_hz)
        self._at = count
        self._image: Any = None

    def __call__(self, frame: int) -> Any:
        """Return the image of a frame; InputError without one."""
        wanted = image_at(self._shown, frame)
        if wanted < 0 or frame > self._shown[-1]:
            raise InputError(f"footage {self._name} has no frame {frame}: it is not the video of these annotations")
        if not self._at <= wanted < self._at + _FAR:
            self._images, self._at = self._film.read(wanted), wanted - 1
        while self._at < wanted:
            self._image, self._at = next(self._images).image, self._at + 1
        return self._image
