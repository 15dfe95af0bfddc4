"""Stage `projections`: the poses of a projection database, from takes, and from draws and variants when asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pasdedeux.errors import InputError
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import multiply, normalise, unitquat_from_rotmat, yaw_rotmat
from pasdedeux.projections.camera import DatabaseCamera, cameras_of
from pasdedeux.projections.pairs import centre_pairs
from pasdedeux.projections.retarget import centre_and_face, retarget_proportions
from pasdedeux.projections.sources import op14_from_working, resample_positions
from pasdedeux.reconstruction.body import REFERENCE_REST_M, body_through, pose_body, rotations_from_t_pose
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.skeletons import BODY22, OP14, PAIR17
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Manifest, Store
from tasks.facts import DrawFacts, ProjectionFacts, TakeFacts, VariantFacts
from tasks.stage import EarlyPlan, Parameters, Shard, Stage, StageInputs, StageName, commit, merge_takes
from tasks.takes import read_motion, read_rest

PROJECTIONS = StageName("projections", 5)

_RATE_HZ = 24.0
"""Frames per second of the database (Yiannakides et al. 2019)."""
NUM_YAWS = 30
"""Yaw steps over the full turn, of 12 degrees (Yiannakides et al. 2019)."""
_DENSITY = "ic"
"""Density whose draws enter: the one that compares with annotations."""


class ViewsOfPoses(Parameters):
    """How the poses of a database are seen: yaw steps over the full turn, and the cameras in a study's words."""

    num_yaws: int
    camera: Literal["orthographic", "pinhole"]
    pitches_deg: tuple[float, ...]
    heights_m: tuple[float, ...]
    distance_m: float

    @property
    def cameras(self) -> tuple[DatabaseCamera, ...]:
        """The cameras by rising pitch."""
        return cameras_of(
            self.camera, pitches_deg=self.pitches_deg, heights_m=self.heights_m, distance_m=self.distance_m
        )

    @property
    def level_camera(self) -> DatabaseCamera:
        """The camera at the height of the mid-hip."""
        return replace(self.cameras[0], pitch_rad=0.0)


class ProjectionsParameters(Parameters):
    """Which poses enter the database, and what cameras see them."""

    camera: Literal["orthographic", "pinhole"] = Field(
        "orthographic", description="Rays of the camera: parallel, or through a pinhole distance_m from the mid-hip"
    )
    pitches_deg: tuple[float, ...] = Field(
        (-10.0, 0.0, 20.0, 30.0, 45.0),
        description="Pitches of the camera, which looks at the mid-hip, below 0 upwards; that of a sequence is found "
        "between these and those of the heights",
    )
    heights_m: tuple[float, ...] = Field(
        (1.5,),
        description="Heights of the camera over the floor: more pitches, those at which it looks at the mid-hip of who "
        "stands distance_m away",
    )
    distance_m: float = Field(4.0, gt=1.5, le=100, description="Distance of the camera from the mid-hip")
    include_draws: bool | None = Field(
        None,
        description="Poses of the chains' draws enter the database; when not given they do where no take is there to "
        "enter",
    )
    include_variants: bool = Field(
        False,
        description="Poses of the variants enter the database; to search 14 million projections a worker needs 3 GB "
        "(--worker-memory 4)",
    )

    @model_validator(mode="after")
    def _check_views(self) -> Self:
        """Refuse cameras that cannot be."""
        try:
            cameras_of(self.camera, pitches_deg=self.pitches_deg, heights_m=self.heights_m, distance_m=self.distance_m)
        except InputError as error:
            raise ValueError(str(error)) from None
        return self

    @property
    def views(self) -> ViewsOfPoses:
        """How the poses are seen."""
        return self.part(ViewsOfPoses, num_yaws=NUM_YAWS)


class PoseShard(Parameters):
    """What a shard of poses is told: where they come from, their rate, and how they are seen."""

    origin: Literal["take", "draw", "variant"]
    rate_hz: float
    views: ViewsOfPoses


def plan(inputs: StageInputs, parameters: ProjectionsParameters) -> list[Shard]:
    """Plan a shard per take that is not held out, per artifact of draws and per artifact of variants."""
    shards = []
    wanted: list[tuple[Literal["take", "draw", "variant"], str]] = [("take", "poses")]
    has_takes = any(not take.is_held_out for take in map(TakeFacts.of, inputs.of("poses")))
    if parameters.include_draws or (parameters.include_draws is None and not has_takes):
        wanted.append(("draw", "draws"))
    if parameters.include_variants:
        wanted.append(("variant", "variants"))
    for origin, table in wanted:
        for manifest in inputs.of(table):
            if origin == "draw":
                if DrawFacts.of(manifest).density != _DENSITY:
                    continue
                partition = manifest.partition
            else:
                shown = TakeFacts.of(manifest) if origin == "take" else VariantFacts.of(manifest)
                if shown.is_held_out:
                    continue
                partition = shown.take_id
            options = PoseShard(origin=origin, rate_hz=_RATE_HZ, views=parameters.views)
            name = f"{origin}-{manifest.partition}-{manifest.name}"
            shards.append(PROJECTIONS.shard(inputs, partition, name, options, {"poses": [manifest]}))
    return shards


def _plan_early(inputs: StageInputs, parameters: ProjectionsParameters) -> list[Shard]:
    """Plan the shards of some artifacts alone: not draws that enter only where there are no takes."""
    return [] if parameters.include_draws is None else plan(inputs, parameters)


def _unread(parameters: ProjectionsParameters) -> tuple[str, ...]:
    """Return the tables whose poses do not enter."""
    return (
        *(("draws",) if parameters.include_draws is False else ()),
        *(() if parameters.include_variants else ("variants",)),
    )


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Retarget the poses of one source to the reference body, take heading and place away, and commit them."""
    options = shard.options(PoseShard)
    ref = shard.ref("poses")
    read_rows = {"take": _take_rows, "draw": _draw_rows, "variant": _variant_rows}[options.origin]
    rows = read_rows(store, ref, options.rate_hz)
    positions, unitquat = rows.pop("positions"), rows.pop("body22_unitquat")
    centred = centre_and_face(retarget_proportions(positions))
    heading = unitquat_from_rotmat(yaw_rotmat(-centred.heading_rad))
    unitquat[:, BODY22.root] = multiply(heading, unitquat[:, BODY22.root])
    columns: dict[str, Any] = {
        "origin": [options.origin] * len(positions),
        **rows,
        "op14_m": centred.poses_m,
        "op14_unitquat": bone_rotations(centred.poses_m),
        "body22_unitquat": unitquat,
        "heading_rad": centred.heading_rad,
        "root_translation_m": centred.root_translation_m,
        "joint_radius_m": np.hypot(centred.poses_m[..., 0], centred.poses_m[..., 2]),
    }
    facts = ProjectionFacts(
        origin=options.origin,
        takes=merge_takes(store.manifest(ref)),
        num_poses=len(positions),
        rate_hz=options.rate_hz,
        views=options.views.model_dump(mode="json"),
    )
    verdict = Verdict(
        Level.PASS if len(positions) else Level.WARN,
        "" if len(positions) else f"the {options.origin}s hold no pose",
    )
    return commit(shard, store, tables={"projections": columns}, facts=facts, verdict=verdict)


def read_views(parts: Sequence[Manifest]) -> ViewsOfPoses:
    """Return how the poses of a database's parts are seen.

    Raises:
        InputError: Parts differ, or are of an earlier version and do not tell.
    """
    stated = [ProjectionFacts.of(part).views for part in parts]
    if any(views != stated[0] for views in stated):
        raise InputError("parts of the projection database differ in yaw steps or camera; build them with one study")
    return ViewsOfPoses(**stated[0])


def read_pairs(store: Store, refs: Sequence[ArtifactRef], *, max_pairs: int | None = None) -> np.ndarray:
    """Return the pairs (row, person, 14, 3) of all parts, for `pair_database`; people who were alone are left out.

    The rows of a frame give back its people in their place to each other: heading and place are put on again.  Of more
    pairs than `max_pairs` an even choice is given.
    """
    count = sum(store.manifest(ref).tables["projections"].rows for ref in refs) // 2
    step = 1 if max_pairs is None else max(1, -(-count // max_pairs))
    pairs = [np.zeros((0, 2, OP14.num_joints, 3))]
    for ref in refs:
        columns = ["person", "partner_row", "op14_m", "heading_rad", "root_translation_m"]
        table = store.read(ref, "projections", columns=columns)
        is_alone = np.asarray(table.is_null("partner_row"))
        rows = np.flatnonzero((np.asarray(table["person"]) == 0) & ~is_alone)[::step]
        both = np.stack([rows, np.asarray(table["partner_row"])[rows].astype(np.int64)], axis=1)
        turn = yaw_rotmat(np.asarray(table["heading_rad"], dtype=np.float64)[both])
        poses = np.einsum("npij,npkj->npki", turn, np.asarray(table["op14_m"], dtype=np.float64)[both])
        pairs.append(centre_pairs(poses + np.asarray(table["root_translation_m"], dtype=np.float64)[both][:, :, None]))
    return np.concatenate(pairs)


def _take_rows(store: Store, ref: ArtifactRef, rate_hz: float) -> dict[str, Any]:
    """Return the poses of every person of a take at the database's rate."""
    take = TakeFacts.of(store.manifest(ref))
    poses, rest_m = read_motion(store, ref, "op14_m", "body22_m", "body22_world_unitquat"), read_rest(store, ref)
    rates = {"from_hz": take.rate_hz, "to_hz": rate_hz}
    parts = []
    for person in range(take.num_persons):
        op14, whole, turned = (np.ascontiguousarray(values[:, person]) for values in poses.values())
        unitquat = rotations_from_t_pose(whole, normalise(turned), rest_m[person])
        moved, turns = resample_positions(op14, **rates), _resample_rotations(unitquat, **rates)
        parts.append(_one_motion(moved, turns, take.take_id, person))
    _set_partners(parts)
    return _joined(parts)


def _draw_rows(store: Store, ref: ArtifactRef, rate_hz: float) -> dict[str, Any]:
    """Return both people of every draw; draws have no past, so each is a motion of its own."""
    draws = store.read(ref, "draws", columns=["pair17_m", "take_id"])
    pairs = op14_from_working(np.asarray(draws["pair17_m"], dtype=np.float64), PAIR17)
    rows = np.arange(len(pairs))
    take_ids = [take_id or "" for take_id in draws["take_id"]]
    parts = []
    for person in range(2):
        parts.append(
            {
                "take_id": take_ids,
                "person": np.full(len(rows), person),
                "frame": rows,
                "is_sequence_start": np.ones(len(rows), dtype=bool),
                "positions": pairs[:, person],
                "body22_unitquat": _bodies_of_op14(pairs[:, person]),
            }
        )
    _set_partners(parts)
    return _joined(parts)


def _variant_rows(store: Store, ref: ArtifactRef, rate_hz: float) -> dict[str, Any]:
    """Return everybody of every variant at the database's rate."""
    table = store.read(ref, "variants", columns=["variant_id", "person", "frame", "body22_m"])
    variant = np.array(list(table["variant_id"]), dtype=object)
    poses = np.asarray(table["body22_m"], dtype=np.float64)
    facts = VariantFacts.of(store.manifest(ref))
    rates = {"from_hz": facts.rate_hz, "to_hz": rate_hz}
    parts: list[dict[str, Any]] = []
    names, number = np.unique(variant.astype(str), return_inverse=True)
    for one in range(len(names)):
        people = []
        for person in np.unique(table["person"]):
            chosen = np.flatnonzero((number == one) & (table["person"] == person))
            chosen = chosen[np.argsort(np.asarray(table["frame"])[chosen], kind="stable")]
            moved = resample_positions(op14_from_working(poses[chosen], BODY22), **rates)
            turned = _resample_rotations(rotations_from_t_pose(poses[chosen]), **rates)
            people.append(_one_motion(moved, turned, facts.take_id, int(person)))
        _set_partners(people, first_row=sum(len(part["positions"]) for part in parts))
        parts += people
    return _joined(parts)


def _resample_rotations(unitquat: np.ndarray, *, from_hz: float, to_hz: float) -> np.ndarray:
    """Return local rotations (frame, 22, 4) at another rate, at the times of `resample_positions`."""
    motion = Motion(BODY22, REFERENCE_REST_M, np.zeros((len(unitquat), 3)), unitquat, from_hz)
    return motion.resample(to_hz).local_unitquat


def _bodies_of_op14(positions: np.ndarray) -> np.ndarray:
    """Return local rotations (row, 22, 4) for poses that say no more than op14: straight backs, feet square."""
    poses = retarget_proportions(positions)
    return pose_body(body_through(poses), poses)[1]


def _one_motion(positions: np.ndarray, unitquat: np.ndarray, take_id: str, person: int) -> dict[str, Any]:
    frame = np.arange(len(positions))
    return {
        "take_id": [take_id] * len(positions),
        "person": np.full(len(positions), person),
        "frame": frame,
        "is_sequence_start": frame == 0,
        "positions": positions,
        "body22_unitquat": unitquat,
    }


def _set_partners(parts: list[dict[str, Any]], *, first_row: int = 0) -> None:
    """Note for two people of a motion, whose rows will start at `first_row`, where the other's row is."""
    lengths = [len(part["positions"]) for part in parts]
    if len(parts) != 2:
        for part, length in zip(parts, lengths, strict=True):
            part["partner_row"] = [None] * length
        return
    for part, other, start in ((parts[0], 1, first_row + lengths[0]), (parts[1], 0, first_row)):
        rows = range(len(part["positions"]))
        part["partner_row"] = [start + row if row < lengths[other] else None for row in rows]


def _joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        name: list(chain.from_iterable(part[name] for part in parts))
        if name in ("take_id", "partner_row")
        else np.concatenate([part[name] for part in parts])
        for name in ("take_id", "partner_row", "person", "frame", "is_sequence_start", "positions", "body22_unitquat")
    }


STAGE = Stage(
    *PROJECTIONS,
    reads=("poses", "draws", "variants"),
    writes=("projections",),
    parameters=ProjectionsParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Builds the projection database: poses on one body, mid-hip at the origin, heading removed",
    needs="takes that are not held out ([[ingest.takes]], ingest.held_out), or draws or variants "
    "(projections.include_draws, projections.include_variants)",
    early=(EarlyPlan(_plan_early, each=("poses", "draws", "variants")),),
    unread=_unread,
)
