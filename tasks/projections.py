"""Stage `projections`: the poses of a projection database, from takes, and from draws."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from pasdedeux.arrays import merge_axes
from pasdedeux.errors import InputError
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import multiply, normalise, unitquat_from_rotmat, yaw_rotmat
from pasdedeux.projections.database import Database, DatabaseCamera
from pasdedeux.projections.pairs import centre_pairs
from pasdedeux.projections.published import Clusters, cluster_projections
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, centre_and_face, retarget_proportions
from pasdedeux.projections.sources import op14_from_working, resample_positions
from pasdedeux.reconstruction.body import (
    REFERENCE_HIP_WIDTH_M,
    REFERENCE_REST_M,
    body_with_bones,
    pose_body,
    rotations_from_t_pose,
)
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.reconstruction.sequence import SearchedDatabase
from pasdedeux.skeletons import BODY22, OP14, PAIR17
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Manifest, Store
from tasks.rows.draw_sets import is_chain
from tasks.rows.takes import read_motion, read_rest
from tasks.stage import EarlyPlan, Parameters, Shard, Stage, StageInputs, StageName
from tasks.stage.committing import commit, followed
from tasks.stage.facts import DrawFacts, Facts, ProjectionFacts, TakeFacts, merge_takes
from tasks.stage.streams import stream

PROJECTIONS = StageName("projections", 6)

MAX_PAIRS = 30_000
"""Most pairs that are searched, evenly chosen: with 30 yaws about a million projections."""
_RATE_HZ = 24.0
"""Frames per second of the database (Yiannakides et al. 2019)."""
_DENSITY = "ic"
"""Density whose draws enter: the one that compares with annotations.

Repaired pairs enter where no chain draws: beside its draws, 300 of the duets worsen the fit to the image from 6.6 to
7.5 cm.
"""


Pitches = tuple[Annotated[float, Field(gt=-90, lt=90)], ...]


class ProjectionsParameters(Parameters):
    """Poses of the database, and the cameras that see them."""

    pitches_deg: Pitches = Field(
        (-30.0, -10.0, 0.0, 8.2, 20.0, 30.0, 45.0),
        min_length=1,
        description="Pitches of the camera, which looks at the mid-hip, below 0 upwards (8.2: from 1.5 m over the "
        "floor, 4 m away); that of a sequence is found between these",
    )
    include_draws: bool | None = Field(
        None,
        description="Poses of the chains' draws enter the database; when not given they do where no take is there to "
        "enter",
    )
    num_clusters: int = Field(
        0,
        ge=0,
        description="Clusters of the database's projections, for the method `published` of [reconstruction] (500 in "
        "the paper); 0: none",
    )


class PoseShard(Parameters):
    """The parameters of a shard of poses: where they come from, their rate, and the pitches they are seen at."""

    origin: Literal["take", "draw"]
    rate_hz: float
    pitches_deg: Pitches


class ClusterShard(Parameters):
    """The parameters of the shard that clusters the projections of all others."""

    num_clusters: int


def plan(inputs: StageInputs, parameters: ProjectionsParameters) -> list[Shard]:
    """Plan a shard per source of poses, and one that clusters the projections of all where clusters are asked for."""
    shards = plan_poses(inputs, parameters)
    if shards and parameters.num_clusters:
        options = ClusterShard(num_clusters=parameters.num_clusters)
        after = tuple(shard.key for shard in shards)
        shards.append(PROJECTIONS.shard(inputs, "clusters", "clusters", options, after=after))
    return shards


def plan_poses(inputs: StageInputs, parameters: ProjectionsParameters, *, may_be_repaired: bool = True) -> list[Shard]:
    """Plan a shard per take that is not held out, and per artifact of draws."""
    takes = [(TakeFacts.of(manifest), manifest) for manifest in inputs.of("poses")]
    sources: list[tuple[Literal["take", "draw"], str, Manifest]] = [
        ("take", take.take_id, manifest) for take, manifest in takes if not take.is_held_out
    ]
    if parameters.include_draws or (parameters.include_draws is None and not sources):
        draws = [manifest for manifest in inputs.of("draws") if DrawFacts.of(manifest).density == _DENSITY]
        if not draws and may_be_repaired:
            short = [manifest for manifest in inputs.of("draws") if not is_chain(manifest)]
            draws = [manifest for manifest in short if manifest.parameters["density"] == _DENSITY]
        sources += [("draw", manifest.partition, manifest) for manifest in draws]
    shards = []
    for origin, partition, manifest in sources:
        options = PoseShard(origin=origin, rate_hz=_RATE_HZ, pitches_deg=parameters.pitches_deg)
        name = f"{origin}-{manifest.partition}-{manifest.name}"
        shards.append(PROJECTIONS.shard(inputs, partition, name, options, {"poses": [manifest]}))
    return shards


def _plan_early(inputs: StageInputs, parameters: ProjectionsParameters) -> list[Shard]:
    """Plan the shards of some artifacts alone, without draws that enter only in the absence of takes."""
    return [] if parameters.include_draws is None else plan_poses(inputs, parameters, may_be_repaired=False)


def _unread(parameters: ProjectionsParameters) -> tuple[str, ...]:
    """Return the tables whose poses do not enter."""
    return ("draws",) if parameters.include_draws is False else ()


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Make a part of the database, or the clusters of all its projections."""
    return (_cluster if isinstance(shard.parameters, ClusterShard) else _project)(shard, store)


def _cluster(shard: Shard, store: Store) -> ArtifactRef:
    """Cluster the projections of all parts of the database, as its level camera sees them, and commit the clusters."""
    parts = followed(shard, store)
    clusters = Clusters(np.zeros(0, dtype=np.int64), ())
    if any(part.tables["projections"].rows for part in parts):
        database, _, _ = read_database(store, [part.ref for part in parts])
        rng = stream(shard.seed, PROJECTIONS.name, "clusters")
        clusters = cluster_projections(database, shard.options(ClusterShard).num_clusters, rng)
    columns = {"representative": clusters.representative, "members": list(clusters.members)}
    return commit(
        shard, store, tables={"projection_clusters": columns}, facts=Facts(kind="clusters", takes=merge_takes(*parts))
    )


def _project(shard: Shard, store: Store) -> ArtifactRef:
    """Retarget the poses of one source to the reference body, remove heading and place, and commit them."""
    options = shard.options(PoseShard)
    ref = shard.ref("poses")
    group = _READERS[options.origin](store, ref, options.rate_hz)
    positions, unitquat = merge_axes(group.op14_m, 0, 2), merge_axes(group.body22_unitquat, 0, 2)
    centred = centre_and_face(retarget_proportions(positions))
    heading = unitquat_from_rotmat(yaw_rotmat(-centred.heading_rad))
    unitquat[:, BODY22.root] = multiply(heading, unitquat[:, BODY22.root])
    columns: dict[str, Any] = {
        "origin": [options.origin] * len(positions),
        **_rows(group),
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
        pitches_deg=options.pitches_deg,
    )
    verdict = Verdict(
        Level.PASS if len(positions) else Level.WARN, "" if len(positions) else f"the {options.origin}s hold no pose"
    )
    return commit(shard, store, tables={"projections": columns}, facts=facts, verdict=verdict)


def read_cameras(parts: Sequence[Manifest]) -> tuple[DatabaseCamera, ...]:
    """Return the cameras that see a database of these parts, by rising pitch; the same pitch twice gives one."""
    pitches = sorted({pitch for part in parts for pitch in ProjectionFacts.of(part).pitches_deg})
    return tuple(DatabaseCamera(float(np.deg2rad(pitch))) for pitch in pitches)


def read_database(store: Store, refs: Sequence[ArtifactRef]) -> tuple[Database, np.ndarray, np.ndarray]:
    """Return the database of all parts as its level camera sees it, take ids and frames, in the order of the plan.

    Raises:
        InputError: There is no pose, or parts differ in how they are seen.
    """
    manifests = [store.manifest(ref) for ref in refs]
    columns = ["op14_m", "body22_unitquat", "is_sequence_start", "take_id", "frame"]
    parts = [store.read(ref, "projections", columns=columns) for ref in refs]
    if len({ProjectionFacts.of(part).pitches_deg for part in manifests}) > 1:
        raise InputError("parts of the projection database differ in their cameras; build them with one study")
    database = Database(
        np.concatenate([np.asarray(part["op14_m"]) for part in parts]),
        np.concatenate([np.asarray(part["is_sequence_start"]) for part in parts]),
        rate_hz=ProjectionFacts.of(manifests[0]).rate_hz,
        body22_unitquat=np.concatenate([np.asarray(part["body22_unitquat"]) for part in parts]),
    )
    return (
        database,
        np.concatenate([np.array(list(part["take_id"]), dtype=object) for part in parts]),
        np.concatenate([np.asarray(part["frame"]) for part in parts]),
    )


def read_searched(store: Store, refs: Sequence[ArtifactRef]) -> SearchedDatabase:
    """Return the database of all parts with the pitches of its cameras, without pairs.

    Raises:
        InputError: There is no pose, or parts differ in how they are seen.
    """
    poses, take_ids, take_frames = read_database(store, refs)
    cameras = read_cameras([store.manifest(ref) for ref in refs])
    return SearchedDatabase(poses, tuple(camera.pitch_rad for camera in cameras), take_ids, take_frames)


def clusters_of(inputs: StageInputs, parts: Sequence[Manifest]) -> tuple[list[Manifest], list[Manifest]]:
    """Return the clusters of a database of exactly these parts, none where there are none, and the parts in order."""
    parts_by_ref = {part.ref: part for part in parts}
    for clusters in inputs.of("projection_clusters"):
        if set(clusters.inputs) == set(parts_by_ref):
            return [clusters], [parts_by_ref[ref] for ref in clusters.inputs]
    return [], list(parts)


def read_clusters(store: Store, ref: ArtifactRef) -> Clusters:
    """Return the clusters of a database's projections."""
    table = store.read(ref, "projection_clusters")
    members = tuple(np.asarray(numbers, dtype=np.int64) for numbers in table["members"])
    return Clusters(np.asarray(table["representative"], dtype=np.int64), members)


def read_pairs(store: Store, refs: Sequence[ArtifactRef], *, max_pairs: int = MAX_PAIRS) -> np.ndarray:
    """Return the pairs (row, person, 14, 3) of all parts, for `pair_database`; single people are skipped.

    Heading and place are applied again, so that the people of a frame have their relative places.  If there
    are more than `max_pairs`, they are chosen evenly.
    """
    count = sum(store.manifest(ref).tables["projections"].rows for ref in refs) // 2
    step = max(1, -(-count // max_pairs))
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


class _PosesTogether(NamedTuple):
    """People seen together: the take of each frame, and everybody's poses and rotations, frame by frame.

    Draws are frames of one group that have no past: each begins a sequence.
    """

    take_ids: Sequence[str]
    op14_m: np.ndarray
    """(person, frame, 14, 3)"""
    body22_unitquat: np.ndarray
    """(person, frame, 22, 4)"""
    has_past: bool = True


def _of_take(store: Store, ref: ArtifactRef, rate_hz: float) -> _PosesTogether:
    """Return the poses of every person of a take at the database's rate."""
    take, rest_m = TakeFacts.of(store.manifest(ref)), read_rest(store, ref)
    poses = read_motion(store, ref, "op14_m", "body22_m", "body22_world_unitquat")
    op14, body22, world = (np.ascontiguousarray(values.swapaxes(0, 1)) for values in poses.values())
    moved = np.stack([resample_positions(positions, from_hz=take.rate_hz, to_hz=rate_hz) for positions in op14])
    turned = []
    for person in zip(body22, normalise(world), rest_m, strict=True):
        local = rotations_from_t_pose(*person)
        motion = Motion(BODY22, REFERENCE_REST_M, np.zeros((len(local), 3)), local, take.rate_hz)
        turned.append(motion.resample(rate_hz).local_unitquat)
    return _PosesTogether([take.take_id] * moved.shape[1], moved, np.stack(turned))


def _of_draws(store: Store, ref: ArtifactRef, rate_hz: float) -> _PosesTogether:
    """Return both people of every draw."""
    draws = store.read(ref, "draws", columns=["pair17_m", "take_id"])
    pairs = op14_from_working(np.asarray(draws["pair17_m"], dtype=np.float64), PAIR17).swapaxes(0, 1)
    take_ids = [take_id or "" for take_id in draws["take_id"]]
    return _PosesTogether(take_ids, pairs, np.stack([bodies_of_op14(people) for people in pairs]), has_past=False)


def bodies_of_op14(op14_m: np.ndarray) -> np.ndarray:
    """Return local rotations (row, 22, 4) for poses known only as op14: straight backs, feet square."""
    return pose_body(body_with_bones(REFERENCE_LENGTHS_M, REFERENCE_HIP_WIDTH_M), retarget_proportions(op14_m))[1]


def _rows(group: _PosesTogether) -> dict[str, Any]:
    """Return which person and frame each row is, person after person, and for two people the other's row."""
    num_people, num_frames = group.op14_m.shape[:2]
    count = num_people * num_frames
    frame = np.tile(np.arange(num_frames), num_people)
    return {
        "take_id": [*group.take_ids] * num_people,
        "person": np.repeat(np.arange(num_people), num_frames),
        "partner_row": (np.arange(count) + num_frames) % count if num_people == 2 else [None] * count,
        "frame": frame,
        "is_sequence_start": (frame == 0) | (not group.has_past),
    }


_READERS = {"take": _of_take, "draw": _of_draws}

STAGE = Stage(
    *PROJECTIONS,
    reads=("poses", "draws"),
    writes=("projections", "projection_clusters"),
    parameters=ProjectionsParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Builds the projection database: poses on one body, mid-hip at the origin, heading removed",
    needs="takes that are not held out ([[ingest.takes]], ingest.held_out), or draws (projections.include_draws)",
    early=(EarlyPlan(_plan_early, each=("poses", "draws")),),
    unread=_unread,
)
