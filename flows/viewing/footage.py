"""The footage of a sequence: 2D poses, film, camera, and the captured people of virtual video."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from flows.viewing.films import FilmReader
from flows.viewing.scene import Flat, Grid
from flows.viewing.shelf import Shelf
from pasdedeux.arrays import Array, Integers
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.errors import InputError
from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from pasdedeux.reconstruction.tracks import Lens
from pasdedeux.skeletons import BODY22, PAIR17
from pasdedeux.spread import evenly_spread
from storage_schema import ArtifactRef, Store
from storage_schema.ancestry import inputs_with
from tasks.evaluation.ground_truth import GroundTruth
from tasks.reconstruction import read_subtracted_motion
from tasks.rows.annotated_pairs import read_pair_points
from tasks.stage.facts import SequenceFacts

_NUM_LOCATED = 60
"""Frames used to locate the camera of a reconstruction."""
_LIMBS = [name for name in PAIR17.joint_names if name.endswith(("shoulder", "elbow", "wrist", "knee", "ankle"))]
LIMBS17, LIMBS22 = ([skeleton.index(name) for name in _LIMBS] for skeleton in (PAIR17, BODY22))


@dataclass(frozen=True)
class SequenceFootage:
    """The footage of a sequence: annotated people by place, the camera of virtual video and its take."""

    store: Store
    ref: ArtifactRef | None
    sequence_id: str
    film: FilmReader | None = None

    @classmethod
    def of(cls, shelf: Shelf, sequence_id: str) -> SequenceFootage:
        """Find it among the annotations at hand."""
        for ref in shelf.having("annotations"):
            if sequence_id in SequenceFacts.of(shelf.store.manifest(ref)).sequence_ids:
                return cls(shelf.store, ref, sequence_id, shelf.film(ref))
        return cls(shelf.store, None, sequence_id)

    @property
    def film_words(self) -> tuple[str, ...]:
        """Why its film could not be read."""
        return (self.film.trouble,) if self.film is not None and self.film.trouble else ()

    def image(self, frame: int) -> Callable[[], Array | None] | None:
        """Return a function that reads the image of a frame; None without a film."""
        return None if self.film is None else partial(self.film.image, int(frame))

    def steady_image(self, frame: int) -> Array | None:
        """Return the image of a frame in the view of the located camera, without the subtracted camera motion."""
        image = None if self.film is None else self.film.image(int(frame))
        motion = None if self.ref is None else _motion(self.store, self.ref, self.sequence_id)
        if image is None or motion is None:
            return image
        import cv2  # here, as the import takes a quarter of a second

        height, width = image.shape[:2]
        (matrix,) = motion.resized(width / motion.image_size_px[0]).at(np.array([frame]))
        return np.asarray(cv2.warpPerspective(image, matrix, (width, height)))

    def locate_camera(
        self, upright_m: Array, grid: Grid, camera_from_upright: Array, lens_factor: float
    ) -> PinholeCamera | None:
        """Return the camera that projects a reconstruction (frame, person, 22, 3) onto its 2D poses.

        Return None if too little of them was seen.
        """
        if self.ref is None:
            return None
        at, people = evenly_spread(len(grid.frames), _NUM_LOCATED), _people(self.store, self.ref)
        nobody = np.full((PAIR17.num_joints, 2), np.nan)
        seen = [people.get((self.sequence_id, int(frame)), {}) for frame in grid.frames[at]]
        px = np.array([[indices.get(int(who), nobody) for who in grid.persons] for indices in seen])
        motion = _motion(self.store, self.ref, self.sequence_id)
        px = px if motion is None else motion.steady_px(grid.frames[at], px)
        width, height, focal_px = _lenses(self.store, self.ref)[self.sequence_id]
        size = size_of(width, height, px)
        lens = Lens.assumed(*size, px, None if np.isnan(focal_px) else focal_px)
        with suppress(InputError):
            return PinholeCamera.locate(
                upright_m[at][:, :, LIMBS22].reshape(-1, 3),
                px[:, :, LIMBS17].reshape(-1, 2),
                focal_px=lens_factor * lens.focal_px,
                principal_point_px=np.array(lens.principal_point_px),
                camera_from_world_rotmat=camera_from_upright,
                image_size_px=size,
            )
        return None

    @property
    def camera(self) -> PinholeCamera | None:
        """The camera of virtual video."""
        return None if self.ref is None else _truth(self.store, self.ref, "body22_m").cameras.get(self.sequence_id)

    def truth(self, frames: Integers, persons: Integers, column: str, *, in_world: bool = False) -> Array | None:
        """Return the captured people (frame, person, joint, 3), in camera or world axes; None if unknown."""
        if self.ref is None or not SequenceFacts.of(self.store.manifest(self.ref)).is_virtual:
            return None
        truth = _truth(self.store, self.ref, column)
        takes = [truth.frames.get((self.sequence_id, int(frame)), ("", 0)) for frame in frames]
        camera = truth.cameras.get(self.sequence_id)
        known = [truth.takes.get(take) for take, _ in takes]
        if camera is None or any(positions_m is None or max(persons) >= positions_m.shape[1] for positions_m in known):
            return None
        world = np.stack(
            [
                positions_m[at][persons]
                for positions_m, (_, at) in zip(known, takes, strict=True)
                if positions_m is not None
            ]
        )
        return world if in_world else world @ camera.camera_from_world_rotmat.T

    def flats(self, frame: int, title: str) -> list[Flat]:
        """Return the 2D poses of a frame; none where it was not annotated."""
        people = {} if self.ref is None else _people(self.store, self.ref).get((self.sequence_id, frame))
        if self.ref is None or not people:
            return []
        points = np.stack([people[who] for who in sorted(people)])
        width, height, _ = _lenses(self.store, self.ref)[self.sequence_id]
        return [Flat(PAIR17, points, size_of(width, height, points), f"{title} frame {frame}", self.image(frame))]


@lru_cache(maxsize=4)
def _motion(store: Store, ref: ArtifactRef, sequence_id: str) -> CameraMotion | None:
    return read_subtracted_motion(store, ref, sequence_id)


@lru_cache(maxsize=4)
def _truth(store: Store, ref: ArtifactRef, column: str) -> GroundTruth:
    return GroundTruth.read(store, [*inputs_with(store, ref, "poses")], [ref], column=column)


@lru_cache(maxsize=4)
def _people(store: Store, ref: ArtifactRef) -> Mapping[tuple[str, int], Mapping[int, Array]]:
    """Return the people of each frame of each sequence, by their numbers."""
    seen_people: dict[tuple[str, int], dict[int, Array]] = {}
    for place, people in read_pair_points(store, [ref], is_between=True, with_held_out=True).items():
        seen_people.setdefault((place.sequence_id, place.frame), {}).update(people)
    return seen_people


@lru_cache(maxsize=16)
def _lenses(store: Store, ref: ArtifactRef) -> Mapping[str, Array]:
    """Return width, height and focal length of the camera of each sequence of 2D poses, pixels, NaN where unknown."""
    columns = ["image_width_px", "image_height_px", "focal_px"]
    data = store.read(ref, "annotations", columns=["sequence_id", *columns])
    names, rows = np.unique(data["sequence_id"].astype(str), return_index=True)
    lenses = np.stack([np.where(data.is_null(name), np.nan, data[name])[rows] for name in columns], axis=-1)
    return dict(zip(names.tolist(), lenses, strict=True))


def size_of(width: float, height: float, points_px: Array) -> tuple[int, int]:
    """Return the size of an image; if unknown, one that holds all points."""
    if np.isfinite([width, height]).all():
        return int(width), int(height)
    if not np.isfinite(points_px).any():
        return 640, 480
    low, high = (take(points_px, axis=tuple(range(points_px.ndim - 1))) for take in (np.nanmin, np.nanmax))
    return int(high[0] - min(low[0], 0.0)) + 80, int(high[1] - min(low[1], 0.0)) + 80
