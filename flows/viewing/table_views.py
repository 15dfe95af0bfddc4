"""Makes scenes of the rows of each table with people: one function and one line for each table."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from flows.viewing.footage import LIMBS22, SequenceFootage, size_of
from flows.viewing.scene import Flat, Grid, People, Scene
from flows.viewing.shelf import SINGLE_IMAGES, Item, Shelf, ViewedPartition
from pasdedeux.arrays import Array, Integers
from pasdedeux.cameras.frames import project_pair
from pasdedeux.completion.retrieval import nearest_images
from pasdedeux.evaluation.shown_figures import plain
from pasdedeux.evaluation.verdicts import verdict_words
from pasdedeux.people.names import person_name
from pasdedeux.plain_text import counted
from pasdedeux.projections.database import Database, DatabaseCamera
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.projections.search import ProjectionIndex, build_index
from pasdedeux.skeletons import BODY22, COUNTED17, OP14, PAIR17, Skeleton
from storage_schema import ArtifactRef, Store
from storage_schema.ancestry import inputs_with
from tasks.projections import read_database
from tasks.rows.annotated_pairs import PairPlace, SeenPair, place_of, read_seen_pairs
from tasks.rows.takes import rate_of, read_motion, read_take_objects, take_of
from tasks.stage.facts import MotionFacts
from tasks.stage.judgements import verdicts_of_parts

IMAGE_HEIGHT_M = 2.0
"""An image without a camera stands in the room, this high."""
_NUM_NEAREST = 3
_MAX_PROJECTIONS = 300_000
"""Largest number of projections that are searched, evenly spread over the database."""
_LEVELS = {"pass": 0, "warn": 1, "fail": 2}


@dataclass(frozen=True)
class TableView:
    """A table with people.

    Args:
        scene: Makes the scene of an item.
        quality: Table with figures of each item; empty without one.
        is_each: Whether each row is accepted or rejected on its own: draws, seeds, lifted pairs.
    """

    scene: Callable[[Shelf, ViewedPartition, Item], Scene]
    quality: str = ""
    is_each: bool = False


def _take(shelf: Shelf, part: ViewedPartition, item: Item) -> Scene:
    if (scene := shelf.scenes.get(item.pieces[0][0])) is not None:
        return scene
    data = item.read(shelf.store, "poses", ["person", "frame", "time_s", "body22_m"])
    grid = Grid.of(data["frame"], data["person"])
    objects = read_take_objects(shelf.store, item.pieces[0][0])
    ends, radii = (None, None) if objects is None else (objects.ends_m, objects.radii_m)
    people = People(BODY22, grid.fill(data["body22_m"]))
    return Scene(people, grid.frame_of_row, rate_of(data["time_s"]), ends_m=ends, radii_m=radii)


def _variant(shelf: Shelf, part: ViewedPartition, item: Item) -> Scene:
    store, (take_id, variant_id) = shelf.store, item.names
    data = item.read(store, "variants", ["frame", "person", "time_s", "body22_m"])
    grid = Grid.of(data["frame"], data["person"])
    ref = item.pieces[0][0]
    quality = store.read(ref, "variant_frames")
    rows = np.flatnonzero((quality["take_id"] == take_id) & (quality["variant_id"] == variant_id))
    names = [column.name for column in quality.table.columns if column.name.endswith(("_m", "_rad", "_ratio"))]
    names.sort(key=lambda name: name != "contact_drift_m")  # first
    return Scene(
        People(BODY22, grid.fill(data["body22_m"])),
        grid.frame_of_row,
        rate_of(data["time_s"]),
        behind=People(BODY22, read_motion(store, take_of(store, ref), "body22_m")["body22_m"]),
        behind_name="source",
        curves={name: np.asarray(quality[name], dtype=np.float64)[rows] for name in names},
        levels=np.array([_LEVELS.get(str(word), 0) for word in quality["verdict"][rows]], dtype=np.int64),
    )


def _motion(shelf: Shelf, part: ViewedPartition, item: Item) -> Scene:
    store, sequence_id = shelf.store, item.names[0]
    columns = ["person_id", "frame", "time_s", "body22_m", "op14_m", "score_m", "match_take_id", "match_frame"]
    data = item.read(store, "motions", columns)
    grid = Grid.of(data["frame"], data["person_id"])
    shown = grid.fill(data["body22_m"])
    matches = grid.first(data["match_take_id"]), grid.first(data["match_frame"])
    seen = SequenceFootage.of(shelf, sequence_id)
    truth = seen.truth(grid.frames, grid.persons, "body22_m")
    manifest = store.manifest(item.pieces[0][0])
    facts = MotionFacts.of(manifest)
    # From the axes of a pitched camera to a world in which people stand upright.
    camera_from_upright = DatabaseCamera(math.radians(facts.pitch_deg)).camera_from_upright_rotmat
    shown = shown @ camera_from_upright.astype(np.float32)
    curves = {"match_distance_m": np.nanmean(grid.fill(data["score_m"]), axis=1)}
    if truth is not None:
        both = (
            (joints_m - joints_m[:, :, [BODY22.root]])[..., LIMBS22, :]
            for joints_m in (shown, truth @ camera_from_upright)
        )
        off = np.subtract(*both)
        curves = {"error_m": np.nanmean(np.linalg.norm(off, axis=-1), axis=(1, 2))} | curves
    if truth is not None:  # on the floor, with the mid-hips of the first frame in one place
        truth = truth @ camera_from_upright
        away = np.nanmean(truth[0, :, BODY22.root] - shown[0, :, BODY22.root], axis=0)
        truth = truth - [away[0], np.nanmin(truth[..., 1]) - np.nanmin(shown[..., 1]), away[2]]
    return Scene(
        People(BODY22, shown),
        grid.frame_of_row,
        rate_of(data["time_s"]),
        behind=None if truth is None else People(BODY22, truth),
        behind_name="capture",
        camera=seen.locate_camera(shown, grid, camera_from_upright, facts.lens_factor or 1.0),
        film=None if seen.film is None else lambda frame: seen.steady_image(int(grid.frames[frame])),
        numbers=grid.frames,
        curves=curves,
        say=lambda frame: [f"match {matches[0][frame] or 'bridged'} frame {matches[1][frame]}", *seen.film_words],
        images=lambda frame: seen.flats(int(grid.frames[frame]), sequence_id),
        nearest=partial(_nearest_poses, store, manifest.ref, grid.fill(data["op14_m"])),
        facts=(
            *(f"{name}: {verdict_words(verdict)}" for name, verdict in verdicts_of_parts(manifest).items()),
            *facts.cameras,
            f"persons {', '.join(map(str, grid.persons))}; to correct identities, set people_file = "
            '"people.csv" of the source in the study',
        ),
    )


def _nearest_poses(store: Store, ref: ArtifactRef, op14_m: Array, frame: int) -> list[Flat]:
    """Return the poses of the database most similar to each person of a reconstruction (frame, person, 14, 3)."""
    searched = _database(store, ref)
    if searched is None:
        return []
    database, index, takes, frames = searched
    flats = []
    for person, pose in enumerate(op14_m[frame]):
        image = (pose - mid_hip(pose))[:, :2]
        best = index.search(image, num_neighbours=_NUM_NEAREST)
        for row, yaw, distance_m in zip(best.row, best.yaw_index, best.distance_m, strict=True):
            if np.isfinite(distance_m):
                title = f"{person_name(person)}: {takes[row]} frame {frames[row]}, {100 * distance_m:.1f} cm"
                alone = np.full((person + 1, OP14.num_joints, 2), np.nan)  # in the colour of this person
                alone[person] = database.project(row, row + 1)[0, yaw]
                flats.append(_image_of(alone, title, OP14))
    return flats


@lru_cache(maxsize=1)
def _database(store: Store, ref: ArtifactRef) -> tuple[Database, ProjectionIndex, Array, Integers] | None:
    """Return the thinned database of a reconstruction, in the view of its camera; None if it is gone."""
    refs = [read for read in store.manifest(ref).inputs if store.find(read.stage, read.key)]
    refs = [other for other in refs if "projections" in store.manifest(other).tables]
    if not refs:
        return None
    level, takes, frames = read_database(store, refs)
    step = -(-level.num_projections // _MAX_PROJECTIONS)
    pitch_rad = math.radians(MotionFacts.of(store.manifest(ref)).pitch_deg)
    thin = replace(level.thinned(_MAX_PROJECTIONS), camera=replace(level.camera, pitch_rad=pitch_rad))
    return thin, build_index(thin), takes[::step], frames[::step]


def _sequence(shelf: Shelf, part: ViewedPartition, item: Item) -> Scene:
    columns = ["sequence_id", "frame", "person_id", "time_s", "pair17_px", "image_width_px", "image_height_px"]
    data = item.read(shelf.store, "annotations", columns)
    moments = np.unique(np.stack([data["sequence_id"].astype(str), data["frame"].astype(str)]), axis=1)
    numbers = {moment: at for at, moment in enumerate(zip(*moments.tolist(), strict=True))}
    is_single = item.names[0] == SINGLE_IMAGES
    where = [numbers[name, str(frame)] for name, frame in zip(data["sequence_id"], data["frame"], strict=True)]
    grid = Grid.of(np.array(where) if is_single else data["frame"], data["person_id"])
    image_px = grid.fill(_corrected_px(shelf, item, data))
    size = size_of(data["image_width_px"][0], data["image_height_px"][0], image_px)
    names, frames = grid.first(data["sequence_id"]), np.asarray(grid.first(data["frame"]))
    seen = SequenceFootage.of(shelf, str(data["sequence_id"][0]))
    truth = None if is_single else seen.truth(grid.frames, grid.persons, "body22_m", in_world=True)
    image = People(PAIR17, np.insert(placed_in_room(image_px, size), 2, 0.0, axis=-1))

    def seen_at(frame: int) -> SequenceFootage:
        return SequenceFootage.of(shelf, str(names[frame])) if is_single else seen

    def images(frame: int) -> list[Flat]:
        image = seen_at(frame).image(frames[frame])
        return [Flat(PAIR17, image_px[frame], size, f"{names[frame]} frame {frames[frame]}", image)]

    def say(frame: int) -> list[str]:
        seen_joints = np.isfinite(image_px[frame][:, COUNTED17]).all(axis=-1)
        return [f"{counted(int(seen_joints.sum()), 'joint')} seen", *seen_at(frame).film_words]

    return Scene(
        image if truth is None else People(BODY22, truth),
        grid.frame_of_row,
        None if is_single else rate_of(data["time_s"]),
        flat=image,
        camera=None if truth is None else seen.camera,
        images=images,
        say=say,
        facts=("captured 3D, seen by this camera" if truth is not None else "2D poses only",),
    )


def _corrected_px(shelf: Shelf, item: Item, data: Any) -> Array:
    """Return 2D poses (row, 17, 2), as stored or with later corrections."""
    points_px, changed = np.array(data["pair17_px"]), shelf.corrected.get(item.pieces[0][0], {})
    for row, place in enumerate(zip(data["frame"].tolist(), data["person_id"].tolist(), strict=True)):
        if place in changed:
            np.copyto(points_px[row], changed[place], where=np.isfinite(changed[place]))
    return points_px


def placed_in_room(points_px: Array, size_px: tuple[int, int]) -> Array:
    """Return the position of pixels (..., 2) of an image that stands in the room: metres across and up."""
    return np.asarray((points_px - [size_px[0] / 2, size_px[1]]) * [1.0, -1.0] * IMAGE_HEIGHT_M / size_px[1])


def _pairs(shelf: Shelf, part: ViewedPartition, item: Item, columns: list[str]) -> tuple[Any, People, Integers]:
    data = item.read(shelf.store, part.table, columns)
    pairs: Any = np.empty((data.num_rows, 2, PAIR17.num_joints, 3), dtype=np.float32)
    rows = 0
    for piece in item.pieces:  # one at a time: there may be 100,000 draws
        pair_m = Item(item.names, (piece,), item.label).read(shelf.store, part.table, ["pair17_m"])["pair17_m"]
        pairs[rows : rows + len(pair_m)] = pair_m
        rows += len(pair_m)
    return data, People(PAIR17, pairs), np.arange(data.num_rows)


def _seeds(shelf: Shelf, part: ViewedPartition, item: Item) -> Scene:
    data, people, rows = _pairs(shelf, part, item, ["seed_index", "take_id", "sequence_id", "made_from", "log_prior"])

    def say(frame: int) -> list[str]:
        origin = data["take_id"][frame] or data["sequence_id"][frame] or data["made_from"][frame]
        return [f"seed {data['seed_index'][frame]} of {plain(origin)}"]

    return Scene(people, rows, curves={"log_prior": data["log_prior"]}, say=say, has_floor=False)


def _draws(shelf: Shelf, part: ViewedPartition, item: Item) -> Scene:
    terms = ["log_density", "log_prior", "log_likelihood"]
    names = [*terms, "sequence_id", "sequence_frame", "view", "dissimilarity_m", "num_accepted"]
    data, people, rows = _pairs(shelf, part, item, names)
    others = [other for other in shelf.items(part) if other.names[:2] == item.names[:2] and other != item]
    chains = []
    for other in others:
        curve = np.full(len(rows), np.nan)
        values = other.read(shelf.store, "draws", ["log_density"])["log_density"][: len(rows)]
        curve[: len(values)] = values
        chains.append(curve)

    def say(frame: int) -> list[str]:
        lines = [f"steps accepted since the last draw: {data['num_accepted'][frame]}"]
        matched = data["sequence_id"][frame]
        if matched is not None:
            d_i = 100.0 * float(data["dissimilarity_m"][frame])
            lines.append(f"matches {matched} frame {plain(data['sequence_frame'][frame])}, d_I {d_i:.2f} cm")
        return lines

    def images(frame: int) -> list[Flat]:
        if data["sequence_id"][frame] is None:
            return []
        pair = people.frame(frame)
        flats = [_image_of(project_pair(pair, data["view"][frame]), "this draw in its view")]
        evidence = _evidence(shelf.store, item.pieces[0][0])
        if not evidence:
            return flats
        seen = np.stack([draw.image_m for draw in evidence])
        views = np.stack([draw.directions[0] for draw in evidence])
        which, d_i = nearest_images(pair, seen, views, count=_NUM_NEAREST)
        at = (data["sequence_id"][frame], int(data["sequence_frame"][frame]))
        matched = [draw for draw in evidence if draw.place[:2] == at][:1]
        flats += [_image_of(draw.image_m, f"matched: {draw.place.sequence_id}") for draw in matched]
        titles = [f"{evidence[k].place.sequence_id}, {100 * d:.1f} cm" for k, d in zip(which, d_i, strict=True)]
        return [*flats, *(_image_of(evidence[k].image_m, title) for k, title in zip(which, titles, strict=True))]

    curves = {name: data[name] for name in terms}
    return Scene(people, rows, curves=curves, others=chains, say=say, images=images, has_floor=False)


def _lifted(shelf: Shelf, part: ViewedPartition, item: Item) -> Scene:
    columns = [*PairPlace._fields, "residual_m", "expected_error_m", "num_joints_seen", "draw"]
    data, people, rows = _pairs(shelf, part, item, columns)
    places = [place_of(data, row) for row in range(data.num_rows)]
    truths = np.full(people.positions_m.shape, np.nan)
    for row, place in enumerate(places):
        seen = SequenceFootage.of(shelf, place.sequence_id)
        truth = seen.truth(np.array([place.frame]), np.array([place.person_id, place.partner_id]), "pair17_m")
        if truth is not None:
            truths[row] = truth[0] - truth[0].reshape(-1, 3).mean(axis=0)

    def say(frame: int) -> list[str]:
        at = places[frame]
        who = f"{at.sequence_id} frame {at.frame}, persons {at.person_id} and {at.partner_id}"
        return [who, f"{data['num_joints_seen'][frame]} of 28 joints seen"]

    return Scene(
        people,
        rows,
        behind=People(PAIR17, truths) if np.isfinite(truths).any() else None,
        behind_name="capture",
        curves={name: data[name] for name in ("expected_error_m", "residual_m")},
        say=say,
        images=lambda frame: SequenceFootage.of(shelf, places[frame].sequence_id).flats(
            places[frame].frame, places[frame].sequence_id
        ),
        has_floor=False,
    )


def _between(shelf: Shelf, part: ViewedPartition, item: Item) -> Scene:
    data, people, rows = _pairs(shelf, part, item, ["frame"])
    return Scene(people, rows, say=lambda frame: [f"frame {data['frame'][frame]}"], has_floor=False)


TABLE_VIEWS: Mapping[str, TableView] = {
    "variants": TableView(_variant, "variant_quality"),
    "poses": TableView(_take, "take_quality"),
    "motions": TableView(_motion),
    "lifted_pairs": TableView(_lifted, is_each=True),
    "draws": TableView(_draws, "chain_info", is_each=True),
    "seeds": TableView(_seeds, is_each=True),
    "annotations": TableView(_sequence),
    "in_betweens": TableView(_between),
}


@lru_cache(maxsize=4)
def _evidence(store: Store, ref: ArtifactRef) -> list[SeenPair]:
    """Return the annotated pairs of a chain's likelihood."""
    seen_pairs: list[SeenPair] = []
    for views in inputs_with(store, ref, "views"):
        for annotated in inputs_with(store, ref, "annotations"):
            if annotated in store.manifest(views).inputs:
                seen_pairs += read_seen_pairs(store, annotated, views, num_hypotheses=1)[0].values()
    return seen_pairs


def _image_of(image_m: Array, title: str, skeleton: Skeleton = PAIR17) -> Flat:
    """Convert an image in metres (person, joint, 2), y up, to pixels."""
    points = image_m * [400.0, -400.0]
    return Flat(skeleton, points - np.nanmin(points, axis=(0, 1)) + 40.0, size_of(np.nan, np.nan, points), title)
