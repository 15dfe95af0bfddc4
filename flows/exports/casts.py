"""Reads casts from the store: people in one world over the same frames, which all formats of poses write."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from flows.exports.export_format import Export, RestPose
from flows.exports.own_skeletons import TAKE_NAMES, TakePerson, people_of_take, rate_in_words, rig_of
from pasdedeux.arrays import Array
from pasdedeux.formats.humanoid import humanoid_motion
from pasdedeux.formats.positions_as_motion import motion_from_positions
from pasdedeux.formats.rigs.own_skeleton import BodyMap, OwnSkeleton
from pasdedeux.kinematics import Motion, bone_lengths
from pasdedeux.people.names import person_names
from pasdedeux.people.video import rate_from_times
from pasdedeux.plain_text import counted
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.projections.sources import resample_positions
from pasdedeux.reconstruction.body import body_from_joints, motions_together
from pasdedeux.skeletons import BODY22, OP14, PAIR17, Skeleton
from pasdedeux.skeletons.humanoid import HUMANOID
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Reference, Store, TableData, UnknownReference, resolve
from storage_schema.ancestry import inputs_with
from storage_schema.references import find_rows
from tasks.files.curation import IDENTITY, rows_without
from tasks.rows.products import PRODUCT_COLUMNS, PRODUCTS, method_name, product_rows
from tasks.rows.takes import read_motion, read_variants, take_of
from tasks.stage.facts import MotionFacts, PeopleFacts, TakeFacts, VariantFacts
from tasks.stage.judgements import verdict_of

MOVING = ("poses", "variants", "motions")
"""Tables of whole motions."""
_KEYS = {
    "draws": ("density", "seed_index", "chain"),
    "seeds": (),
    "lifted_pairs": ("sequence_id", "person_id", "partner_id", "method"),
    "in_betweens": ("sequence_id", "person_id", "partner_id", "method"),
    "selected_pairs": ("verdict",),
}
"""Tables of pairs; pairs with the same values in these columns are frames of one file."""
ANNOTATED = ("motions", "lifted_pairs", "in_betweens")
"""Tables made from annotations."""
POSED = f"whole {', '.join(MOVING)}; rows of {', '.join(name for name in _KEYS if name != 'selected_pairs')}"
"""Tables with poses, in words."""
_WHO = "the end of a name is the person, A or B"
NAMES = {
    "poses": TAKE_NAMES,
    "variants": TAKE_NAMES,
    "motions": f"Files are named by the video, and by the method where all were asked for; {_WHO}.",
    "draws": f"Files are named by density, seed and chain; {_WHO}.",
    "seeds": f"Files are named by the seed; {_WHO}.",
    "lifted_pairs": f"Files are named by sequence and people, and by the method where all were asked for; {_WHO}.",
    "in_betweens": f"Files are named by sequence, people and method; {_WHO}.",
    "selected_pairs": f"Files are named by the verdict; {_WHO}.",
}
"""Meaning of file names, by table."""
WORLD = "right-handed, Y up"
CAMERA = "right-handed, x right, y up, z towards the camera"
_HUMANOID_MAP = BodyMap(
    np.eye(BODY22.num_joints, HUMANOID.num_joints), np.zeros((BODY22.num_joints, HUMANOID.num_joints, 3))
)
_NOMINAL_HZ = 30.0
"""Stated rate of frames that are no motion, because files need one."""


@dataclass(frozen=True)
class Rig:
    """A person in the form that other programs draw.

    Args:
        motion: The motion.
        height_m: The person's stature.
        positions_m: Positions of the joints (frame, J, 3), metres, if bones change their lengths; else None.
        body_map: body22 as points of its joints; None for a working skeleton.
        own: On the source's own skeleton: the person, the motion, and body22 of its variant.
    """

    motion: Motion
    height_m: float
    positions_m: Array | None = None
    body_map: BodyMap | None = None
    own: tuple[TakePerson, OwnSkeleton, Array | None] | None = None


@dataclass(frozen=True)
class SeenCast:
    """A cast from annotations, in the view of their camera.

    Args:
        sequence_id: The sequence.
        person_ids: Its people, A first.
        frames: Its frames (frame,).
        skeleton: Skeleton of the positions.
        positions_m: Camera axes (frame, person, J, 3), metres; NaN for absent people.
        is_pair: Whether the relative positions of both are those of the image.
    """

    sequence_id: str
    person_ids: tuple[int, ...]
    frames: Sequence[int]
    skeleton: Skeleton
    positions_m: Array
    is_pair: bool


@dataclass(frozen=True)
class Cast:
    """People of one world over the same frames, A first.

    Args:
        parts: Parts of the file's name.
        skeleton: Skeleton of the positions.
        positions_m: Positions (frame, person, J, 3), metres.
        rate_hz: Frames per second.
        source_rate_hz: Frames per second of the source's file; 0 if unknown.
        level: Verdict on it.
        axes: Its axes.
        said: Further facts.
        labels: References of the frames, if they are no motion.
        seen: The cast in the view of the camera, if it was made from annotations.
        ref: Its artifact.
        make_rigs: Makes its people.
    """

    parts: tuple[str | int, ...]
    skeleton: Skeleton
    positions_m: Array
    rate_hz: float
    level: Level
    axes: str = WORLD
    said: str = ""
    labels: Sequence[str] = ()
    seen: SeenCast | None = None
    ref: ArtifactRef | None = None
    source_rate_hz: float = 0.0
    make_rigs: Callable[[RestPose], list[Rig]] | None = None

    @property
    def name_parts(self) -> tuple[str, ...]:
        """Return the parts of its file names, without the word `uniform`."""
        return tuple(str(part).replace("-uniform-", "-") for part in self.parts)

    @property
    def letters(self) -> list[str]:
        """Return the names of the people."""
        return person_names(self.positions_m.shape[1])

    @cached_property
    def statures_m(self) -> Array:
        """Return the statures (person,), metres, estimated from the legs."""
        return body_height_m(self.skeleton, np.median(bone_lengths(self.skeleton, self.positions_m), axis=0))

    def rigs(self, rest_pose: RestPose = "source") -> list[Rig]:
        """Return its people."""
        if self.make_rigs is not None:
            return self.make_rigs(rest_pose)
        rigs = []
        for person_m, height_m in zip(np.moveaxis(self.positions_m, 1, 0), self.statures_m.tolist(), strict=True):
            motion = motion_from_positions(self.skeleton, person_m, self.rate_hz)
            rigs.append(Rig(motion, height_m, person_m))
        return rigs

    def in_words(self) -> str:
        """Return the sentences about its files."""
        count = len(self.positions_m)
        apart = f"{counted(count, 'frame')}, which do not follow each other in time"
        words = (
            apart if self.labels else f"{counted(count, 'frame')} at {rate_in_words(self.rate_hz, self.source_rate_hz)}"
        )
        return "; ".join(filter(None, (words, f"axes: {self.axes}", self.said)))


def holds_poses(reference: Reference) -> bool:
    """Return whether a reference names poses: whole motions, or any rows of pairs."""
    return reference.table in _KEYS or (reference.table in MOVING and reference.row is None)


def casts(export: Export) -> Iterator[Cast]:
    """Yield the casts of an export, motions one at a time."""
    if export.reference.table in _KEYS:
        yield from _pairs(export)
        return
    make = {"poses": _take, "variants": _variants, "motions": _reconstructions}[export.reference.table]
    for ref in export.refs:
        for cast in make(export, ref):
            if "/".join(map(str, cast.parts)) not in export.left_out:
                yield cast


def groups(rows: TableData, *columns: str) -> Iterator[tuple[tuple[Any, ...], np.ndarray]]:
    """Yield the values of some columns with their rows (n,), in the order of first occurrence."""
    places: dict[tuple[Any, ...], list[int]] = {}
    keys = zip(*(rows[name] for name in columns), strict=True) if columns else [()] * rows.num_rows
    for place, key in enumerate(keys):
        places.setdefault(tuple(key), []).append(place)
    for key, part in places.items():
        yield key, np.array(part)


def _take(export: Export, ref: ArtifactRef) -> Iterator[Cast]:
    store = export.store
    facts = TakeFacts.of(store.manifest(ref))
    source_hz = float(store.read(ref, "takes", columns=["source_rate_hz"])["source_rate_hz"].max())
    rate_hz = _rate_hz(export, facts.rate_hz, source_hz)
    positions = read_motion(store, ref, "body22_m")["body22_m"]

    def rigs(rest_pose: RestPose) -> list[Rig]:
        return [_own_rig(person, person.own, None, rest_pose, rate_hz) for person in people_of_take(store, ref)]

    yield Cast(
        (facts.take_id,),
        BODY22,
        resample_positions(positions, from_hz=facts.rate_hz, to_hz=rate_hz),
        rate_hz,
        _level(store, ref),
        ref=ref,
        source_rate_hz=source_hz,
        make_rigs=rigs,
    )


def _variants(export: Export, ref: ArtifactRef) -> Iterator[Cast]:
    store = export.store
    people = people_of_take(store, take_of(store, ref))
    take_id = VariantFacts.of(store.manifest(ref)).take_id
    quality = store.read(ref, "variant_quality", columns=["variant_id", "bone_scale", "verdict"])
    motions = read_variants(store, ref)
    own_hz, source_hz = people[0].own.motion.rate_hz, max(person.source_rate_hz for person in people)
    rate_hz = _rate_hz(export, own_hz, source_hz)
    for name, scale, verdict, motion in zip(*(quality[column] for column in quality), motions, strict=True):
        positions = motion.astype(np.float64)

        def rigs(rest_pose: RestPose, positions_m: Array = positions, scales: Array = scale) -> list[Rig]:
            scaled = zip(people, np.moveaxis(positions_m, 1, 0), scales.reshape(len(people), -1), strict=True)
            return [
                _own_rig(person, person.own.retargeted(to_m, by), to_m, rest_pose, rate_hz)
                for person, to_m, by in scaled
            ]

        yield Cast(
            (take_id, str(name)),
            BODY22,
            resample_positions(positions, from_hz=own_hz, to_hz=rate_hz),
            rate_hz,
            Level(verdict),
            ref=ref,
            source_rate_hz=source_hz,
            make_rigs=rigs,
        )


def _rate_hz(export: Export, study_hz: float, source_hz: float) -> float:
    return source_hz if export.rate == "source" and source_hz else study_hz


def _own_rig(
    person: TakePerson, skeleton: OwnSkeleton, wanted_m: Array | None, rest_pose: RestPose, rate_hz: float
) -> Rig:
    """Return a person on the source's own skeleton at this rate; `wanted_m` (frame, 22, 3) has the rate of `made`."""
    if wanted_m is not None:
        wanted_m = resample_positions(wanted_m, from_hz=skeleton.motion.rate_hz, to_hz=rate_hz)
    skeleton = replace(skeleton, motion=skeleton.motion.resample(rate_hz))
    drawn = rig_of(skeleton, rest_pose)
    lengths = np.median(bone_lengths(BODY22, skeleton.body.of(skeleton.motion)), axis=0)
    height_m = float(body_height_m(BODY22, lengths))
    return Rig(drawn.motion, height_m, body_map=drawn.body, own=(person, skeleton, wanted_m))


def _reconstructions(export: Export, ref: ArtifactRef) -> Iterator[Cast]:
    """Yield the people of each video and method, upright on one floor; rejected clips divide videos into casts."""
    store = export.store
    rows = store.read(ref, "motions")
    if not export.all_methods:
        rows = TableData(rows.table, rows.rows.take(product_rows(rows)))
    # From the axes of a pitched camera to a world in which people stand upright.
    camera = DatabaseCamera(math.radians(MotionFacts.of(store.manifest(ref)).pitch_deg))
    for (sequence_id, method), part, *clip in _kept_parts(rows, export.left_out):
        ids = np.unique(rows["person_id"][part]).tolist()
        people = []
        for of_person in (part[rows["person_id"][part] == person_id] for person_id in ids):
            body = body_from_joints(rows["body22_m"][of_person], rows["body22_unitquat"][of_person])
            upright = body.turned(camera.camera_from_upright_rotmat.T)
            people.append((int(rows["frame"][of_person[0]]), upright, rows["is_bridged"][of_person]))
        rate_hz = rate_from_times(rows["frame"][part], rows["time_s"][part])
        together = motions_together(people, rate_hz=rate_hz)
        motions = [humanoid_motion(person.motion) for person in together]
        positions = np.stack([person.motion.world()[0] for person in together], axis=1)
        heights = body_height_m(BODY22, np.median(bone_lengths(BODY22, positions), axis=0))
        first = together[0].first_frame
        seen_m = np.full((len(positions), len(ids), OP14.num_joints, 3), np.nan)
        seen_m[rows["frame"][part] - first, np.searchsorted(ids, rows["person_id"][part])] = rows["op14_m"][part]

        def rigs(_: RestPose, motions: list[Motion] = motions, heights: Array = heights) -> list[Rig]:
            both = zip(motions, heights.tolist(), strict=True)
            return [Rig(motion, height_m, body_map=_HUMANOID_MAP) for motion, height_m in both]

        who = ", ".join(
            f"{letter} is person {person_id}" for letter, person_id in zip(person_names(len(ids)), ids, strict=True)
        )
        yield Cast(
            (sequence_id, *([method_name("motions", method)] if export.all_methods else []), *clip),
            BODY22,
            positions,
            rate_hz,
            _level(store, ref),
            said=f"method: {method}; {who} of the sequence; the first is frame {first} of the video; "
            "floor at y = 0, +Z to the camera",
            seen=SeenCast(sequence_id, tuple(ids), range(first, first + len(positions)), OP14, seen_m, is_pair=False),
            ref=ref,
            make_rigs=rigs,
        )


def _kept_parts(rows: TableData, left_out: Collection[str]) -> Iterator[tuple[Any, ...]]:
    """Yield video and method, the kept rows of each part, and its frames if rejected clips cut the video.

    Single frames are left out.
    """
    is_kept = np.isin(np.arange(rows.num_rows), rows_without(rows, left_out))
    for key, of_video in groups(rows, "sequence_id", "method"):
        frames = np.unique(rows["frame"][of_video[is_kept[of_video]]])
        gone = np.setdiff1d(rows["frame"][of_video], frames)  # gaps without people are no cuts
        parts = np.split(frames, np.flatnonzero(np.diff(np.searchsorted(gone, frames))) + 1)
        for part in (frames for frames in parts if len(frames) > 1):
            is_part = is_kept[of_video] & np.isin(rows["frame"][of_video], part)
            yield key, of_video[is_part], *([f"{part[0]}-{part[-1]}"] if len(parts) > 1 else [])


def _pairs(export: Export) -> Iterator[Cast]:
    """Yield casts of pairs: those of one chain, sequence or set of seeds are frames of one cast."""
    table, row = export.reference.table, export.reference.row
    is_named = export.all_methods or table not in PRODUCTS
    keys = [name for name in _KEYS[table] if name != "method" or is_named]
    by_pair: dict[tuple[Any, ...], list[tuple[ArtifactRef | None, TableData, np.ndarray, Sequence[str]]]] = {}
    for ref, rows, labels in _rows_of_pairs(export):
        for key, part in groups(rows, *keys):
            by_pair.setdefault(key, []).append((ref, rows, part, [labels[at] for at in part]))
    if table in ANNOTATED and row is None:  # single images, each a sequence
        for key in [key for key, parts in by_pair.items() if sum(len(part) for _, _, part, _ in parts) == 1]:
            (still,) = by_pair.pop(key)
            assert still[0] is not None
            by_pair.setdefault((export.store.manifest(still[0]).partition, "stills", key[-1]), []).append(still)
    levels = _chain_levels(export) if table == "draws" else {}
    for key, parts in by_pair.items():
        ref = parts[0][0]
        frames = [int(at) for _, rows, part, _ in parts for at in rows["frame"][part]] if table in ANNOTATED else []
        is_moving = len(frames) > 1 and bool((np.diff(frames) == 1).all())
        judged = [_level(export.store, artifact) for artifact, *_ in parts if artifact is not None]
        level = Level(key[0]) if ref is None else max(judged, key=lambda judged_level: judged_level.rank)
        positions = np.concatenate([rows["pair17_m"][part] for _, rows, part, _ in parts]).astype(np.float64)
        is_video = table in ANNOTATED and "stills" not in key
        seen = (
            SeenCast(key[0], (int(key[1]), int(key[2])), frames, PAIR17, positions, is_pair=True) if is_video else None
        )
        yield Cast(
            (table, *key) if row is None else (_name_of_row(export, parts[0][3][0]),),
            PAIR17,
            positions,
            _annotated_hz(export.store, ref) if ref is not None and is_moving else _NOMINAL_HZ,
            levels.get(key, level),
            axes=f"{CAMERA}; the middle of the pair is the origin" if table in ANNOTATED else WORLD,
            labels=() if is_moving else [label for *_, labels in parts for label in labels],
            seen=seen,
            ref=ref,
        )


def _name_of_row(export: Export, label: str) -> str:
    """Return the file name of one pair; seeds are named by their index, as in studies."""
    if export.reference.table == "seeds":
        (rows,) = export.batches()
        return f"seed{rows['seed_index'][0]}"
    table, key, row = re.split("[@#]", label)
    return f"{table.removesuffix('s')}-{key[:12]}-{row}"


def _rows_of_pairs(export: Export) -> Iterator[tuple[ArtifactRef | None, TableData, Sequence[str]]]:
    """Yield pairs by artifact, with their references; selected ones come from several artifacts."""
    table = export.reference.table
    if export.selected is not None:
        yield None, export.selected, [str(reference) for reference in export.selected["reference"]]
        return
    frames = ["frame"] if table in ANNOTATED else []
    is_chosen = table in PRODUCTS and not export.all_methods and export.reference.row is None
    columns = dict.fromkeys(
        [*_KEYS[table], *IDENTITY[table], "pair17_m", *frames, *(PRODUCT_COLUMNS[table] if is_chosen else ())]
    )
    for ref, rows in find_rows(export.reference, export.store):
        read = export.store.read(ref, table, columns=list(columns), rows=rows)
        kept = rows_without(read, export.left_out)
        kept = np.intersect1d(kept, product_rows(read)) if is_chosen else kept
        yield ref, TableData(read.table, read.rows.take(kept)), [f"{table}@{ref.key}#{rows.start + at}" for at in kept]


def _chain_levels(export: Export) -> dict[tuple[Any, ...], Level]:
    """Return the verdicts on the chains of draws, if the reference finds them."""
    levels: dict[tuple[Any, ...], Level] = {}
    with suppress(UnknownReference):
        for ref in resolve(replace(export.reference, table="chain_info", row=None), export.store):
            rows = export.store.read(ref, "chain_info", columns=[*_KEYS["draws"], "verdict"])
            levels |= {key: Level(rows["verdict"][part[0]]) for key, part in groups(rows, *_KEYS["draws"])}
    return levels


def _annotated_hz(store: Store, ref: ArtifactRef) -> float:
    """Return the rate of the annotations of an artifact."""
    return PeopleFacts.of(store.manifest(next(inputs_with(store, ref, "annotations")))).rate_hz or _NOMINAL_HZ


def _level(store: Store, ref: ArtifactRef) -> Level:
    verdict = verdict_of(store.manifest(ref))
    return Level.NOT_JUDGED if verdict is None else verdict.level
