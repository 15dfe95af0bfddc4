"""Stage `reconstruction`: 3D motions of the people of annotated sequences, matched to a projection database."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.evaluation.verdicts import merge_verdicts
from pasdedeux.formats.humanoid import write_npz
from pasdedeux.people.video import why_no_video
from pasdedeux.projections.database import Database
from pasdedeux.reconstruction.body import EmbodiedMotion
from pasdedeux.reconstruction.people import reconstruct_people
from pasdedeux.reconstruction.pitch import choose_camera, searchers_tried
from pasdedeux.reconstruction.reconstruct import (
    HOW_TO_CLUSTER,
    Method,
    ReconstructedTrack,
    ReconstructionOptions,
    Searcher,
)
from pasdedeux.reconstruction.reliability import judge_tracks, left_out_misfit_m
from pasdedeux.reconstruction.tracks import Track, tracks_from_rows
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Manifest, Store
from tasks.facts import MotionFacts, SequenceFacts
from tasks.projections import clusters_of, read_cameras, read_clusters, read_database, read_pairs
from tasks.stage import (
    Parameters,
    Shard,
    Stage,
    StageInputs,
    StageName,
    commit,
    join_columns,
    kept,
    merge_takes,
    shares_takes,
)

RECONSTRUCTION = StageName("reconstruction", 23)

LEVEL = "level"
"""Name of what is made as if the camera were level."""
MAX_PAIRS = 30_000
"""Pairs that are searched at most, evenly chosen: with 30 yaws about a million projections."""
_MAX_KEPT = 1_250_000
"""Projections before all cameras that a worker keeps from shard to shard, at most: 160 MB."""


class SequenceSettings(Parameters):
    """How the people of a sequence are reconstructed."""

    methods: tuple[Method, ...] = Field(
        (Method.NEAREST, Method.VITERBI, Method.FIT),
        min_length=1,
        description="Methods, each gives a motion; the last one is cleaned up (planted feet still, nothing below "
        "the floor), as one more motion `<method>_clean`, and written as BVH",
    )


class ReconstructionParameters(SequenceSettings):
    """Which sequences are reconstructed, and how."""

    sequences: Literal["held_out", "given", "all"] = Field(
        "held_out", description="Virtual video of held-out takes and given sequences, given ones only, or every video"
    )


class SequenceShard(SequenceSettings):
    """Parameters of a shard: its sequence, how, and what was stated of it.

    A film with a captured take of it is made again by the last method as if the camera were level, first of all: the
    baseline `level`.
    """

    sequence_id: str
    has_level_camera: bool = False
    camera_height_m: float | None = None
    statures_m: dict[int, float] = Field({})


def plan(inputs: StageInputs, parameters: ReconstructionParameters) -> list[Shard]:
    """Plan a shard per video sequence, with every projections artifact that has not seen the sequence's take."""
    shards = []
    databases = inputs.of("projections")
    for manifest in inputs.of("annotations"):
        if not _is_wanted(manifest, parameters.sequences):
            continue
        allowed = [database for database in databases if not shares_takes(manifest, database)]
        facts = SequenceFacts.of(manifest)
        for sequence_id in facts.sequence_ids:
            own = parameters.part(
                SequenceShard,
                sequence_id=sequence_id,
                has_level_camera=facts.purpose == "given" and bool(facts.takes),
                camera_height_m=facts.camera_height_m,
                statures_m=facts.statures_m,
            )
            read = {"annotations": [manifest], "projections": allowed}
            if Method.PUBLISHED in parameters.methods and allowed:
                clusters, parts = clusters_of(inputs, allowed)
                if not clusters:
                    raise InputError(
                        f"{sequence_id}: the projection database without its own take has no clusters; "
                        f"{HOW_TO_CLUSTER}, and hold the take out (ingest.held_out)"
                    )
                read |= {"clusters": clusters, "projections": parts}
            shards.append(RECONSTRUCTION.shard(inputs, sequence_id, sequence_id, own, read))
    return shards


def check_study(sections: Mapping[str, Any]) -> None:
    """Refuse the method `published` over a database without clusters.

    Raises:
        InputError: Says what to set.
    """
    projections = sections.get("projections")
    if Method.PUBLISHED in sections["reconstruction"].methods and projections and not projections.num_clusters:
        raise InputError(f"the projection database has no clusters; {HOW_TO_CLUSTER}")


def _is_wanted(manifest: Manifest, sequences: str) -> bool:
    facts = SequenceFacts.of(manifest)
    if facts.purpose == "given":
        return True
    return facts.purpose == "video" and (sequences == "all" or (sequences == "held_out" and facts.is_held_out))


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Reconstruct every person of a sequence with every method; tracks that cannot be are named in the facts."""
    annotations, database_refs = shard.ref("annotations"), shard.refs("projections")
    manifest, parameters = store.manifest(annotations), shard.options(SequenceShard)
    sequence_id = parameters.sequence_id
    facts: dict[str, Any] = {
        "sequence_ids": [sequence_id],
        "takes": merge_takes(manifest, *(store.manifest(ref) for ref in database_refs)),
        "sequence_takes": merge_takes(manifest),
        "database_takes": merge_takes(*(store.manifest(ref) for ref in database_refs)),
        "methods": [method.value for method in parameters.methods],
        "skipped": [],
    }
    people = read_tracks(store, annotations, parameters, facts)
    rows: list[dict[str, Any]] = []
    attachments: dict[str, bytes] = {}
    judged: dict[str, Verdict] = {}
    if not database_refs:
        facts["skipped"].append(f"{sequence_id}: there is no projection database without the sequence's own take")
    elif people:
        rows, attachments, judged = _reconstruct(
            store, database_refs, people, parameters, facts, clusters=shard.refs("clusters")
        )
    facts["num_persons"] = len({row["person_id"][0] for row in rows})
    return commit(
        shard,
        store,
        tables={"motions": join_columns(rows)},
        facts=MotionFacts(**facts),
        attachments=attachments,
        verdict=(merge_verdicts(judged.values()) if rows else None)
        or Verdict(Level.FAIL, facts["skipped"][0] if facts["skipped"] else "the sequence shows nobody"),
        parts=judged,
    )


def read_tracks(store: Store, ref: ArtifactRef, parameters: SequenceShard, facts: dict[str, Any]) -> list[Track]:
    """Return the tracks of the sequence, by person; the facts say why there are none."""
    sequence_id = parameters.sequence_id
    columns = ["sequence_id", "frame", "person_id", "partner_id", "time_s", "op14_px", "op14_confidence"]
    table = store.read(ref, "annotations", columns=[*columns, "image_width_px", "image_height_px", "focal_px"])
    rows = np.flatnonzero(np.array(list(table["sequence_id"]), dtype=object) == sequence_id)
    if len(rows) == 0:
        return []
    is_unknown = table.is_null("image_width_px")[rows[0]] or table.is_null("image_height_px")[rows[0]]
    frame, time_s = np.asarray(table["frame"])[rows], np.asarray(table["time_s"])[rows]
    # What ingest decided counts: stills numbered one by one look like a video by their numbers alone.
    decided = SequenceFacts.of(store.manifest(ref)).why_no_video
    reason = decided.get(sequence_id) or why_no_video(frame)
    if reason:
        facts["skipped"].append(f"{sequence_id}: {reason}")
        return []
    partner, is_alone = np.asarray(table["partner_id"])[rows], table.is_null("partner_id")[rows]
    sides = ("image_width_px", "image_height_px")
    width, height = (None if is_unknown else int(table[side][rows[0]]) for side in sides)
    return tracks_from_rows(
        frame,
        np.asarray(table["person_id"])[rows],
        time_s,
        np.asarray(table["op14_px"], dtype=np.float64)[rows],
        np.asarray(table["op14_confidence"], dtype=np.float64)[rows],
        partner_id=np.where(is_alone, -1, partner).astype(np.int64),
        width_px=width,
        height_px=height,
        focal_px=None if table.is_null("focal_px")[rows[0]] else float(table["focal_px"][rows[0]]),
    )


class _SeenByAll(NamedTuple):
    """The poses of a database before each camera, and the searchers that try the cameras where these are kept."""

    databases: list[Database]
    take_ids: np.ndarray
    frames: np.ndarray
    searchers: tuple[Searcher, ...]


def _seen_by_all(store: Store, refs: tuple[ArtifactRef, ...]) -> _SeenByAll:
    """Return what all shards over a database have in common; a worker makes a small one ready once."""
    cameras = read_cameras([store.manifest(ref) for ref in refs])
    num_rows = sum(store.manifest(ref).tables["projections"].rows for ref in refs)
    is_kept = len(cameras) * num_rows * Database.num_yaws <= _MAX_KEPT
    return (_kept if is_kept else _make_ready)(store, refs, is_kept=is_kept)


def _make_ready(store: Store, refs: tuple[ArtifactRef, ...], *, is_kept: bool) -> _SeenByAll:
    level, take_ids, frames = read_database(store, refs)
    cameras = read_cameras([store.manifest(ref) for ref in refs])
    databases = [replace(level, camera=camera) for camera in cameras]
    searchers = tuple(searchers_tried(databases)) if is_kept and len(databases) > 1 else ()
    return _SeenByAll(databases, take_ids, frames, searchers)


_kept = kept()(_make_ready)
_read_pairs = kept()(partial(read_pairs, max_pairs=MAX_PAIRS))


def _reconstruct(
    store: Store,
    database_refs: Sequence[ArtifactRef],
    people: Sequence[Track],
    parameters: SequenceShard,
    facts: dict[str, Any],
    *,
    clusters: Sequence[ArtifactRef],
) -> tuple[list[dict[str, Any]], dict[str, bytes], dict[str, Verdict]]:
    """Return the rows of `motions` of every method and person, and of each person files and how good it is."""
    sequence_id = parameters.sequence_id
    options = ReconstructionOptions()
    if all(store.manifest(ref).tables["projections"].rows == 0 for ref in database_refs):
        facts["skipped"].append(f"{sequence_id}: the projection database has no pose")
        return [], {}, {}
    seen = _seen_by_all(store, tuple(database_refs))
    take_ids, frames, cameras = seen.take_ids, seen.frames, [one.camera for one in seen.databases]
    pitch = choose_camera(seen.databases, people, options, ready=seen.searchers)
    level = seen.databases[0]
    suited = replace(level, camera=replace(level.camera, pitch_rad=pitch.pitch_rad))
    chosen = Searcher.of(suited, *(read_clusters(store, ref) for ref in clusters))
    pairs_m = _read_pairs(store, tuple(database_refs)) if len(people) > 1 else None
    stated: dict[str, Any] = {
        "pairs_m": pairs_m,
        "camera_height_m": parameters.camera_height_m,
        "statures_m": parameters.statures_m,
    }
    found = reconstruct_people(chosen, people, parameters.methods, options, pitch=pitch, **stated)
    pitch = found.pitch
    level_camera = replace(level.camera, pitch_rad=0.0)
    made_level = (
        reconstruct_people(
            chosen.pitched(level_camera.pitch_rad), people, parameters.methods[-1:], options, **stated
        ).methods[-1:]
        if parameters.has_level_camera
        else ()
    )
    if found.scene is not None:
        facts["camera_height_m"] = found.scene.camera_height_m
        facts["lens_factor"] = found.scene.lens_factor
    pitches = [camera.pitch_rad for camera in cameras]
    facts["pitch_deg"] = float(np.rad2deg(pitch.pitch_rad))
    facts["pitch_deviation_deg"] = float(np.rad2deg(pitch.deviation_rad))
    facts["num_projections"] = chosen.database.num_projections
    facts["skipped"] += [f"{sequence_id}, person {person_id}: {why}" for person_id, why in found.skipped.items()]
    upright = np.asarray(replace(suited.camera, pitch_rad=pitch.pitch_rad).camera_from_upright_rotmat)
    rows = [
        _rows_of(sequence_id, name, one, made.origin_m, body.turned(turn), take_ids, frames)
        for name, made, turn in (
            *((LEVEL, made, np.asarray(level_camera.camera_from_upright_rotmat)) for made in made_level),
            *((made.name, made, upright) for made in found.methods),
        )
        for one, body in zip(made.people, made.bodies, strict=True)
    ]
    left_out_m = left_out_misfit_m(chosen.database, chosen.index, take_ids)
    judged = judge_tracks(found, left_out_m, sequence_id=sequence_id, pitches_rad=pitches).verdicts
    judged |= {f"person {person_id}": Verdict(Level.WARN, why) for person_id, why in found.skipped.items()}
    attachments = {
        f"{sequence_id}_{person_id}.{kind}": data
        for person_id, motion in found.motions.items()
        for kind, data in (("bvh", motion.bvh().encode()), ("npz", write_npz(motion)))
    }
    return rows, attachments, judged


def _rows_of(
    sequence_id: str,
    method: str,
    found: ReconstructedTrack,
    origin: np.ndarray,
    body: EmbodiedMotion,
    take_ids: np.ndarray,
    frames: np.ndarray,
) -> dict[str, Any]:
    count, track = len(found.positions_m), found.track
    is_known = found.row >= 0
    row = np.maximum(found.row, 0)
    return {
        "sequence_id": [sequence_id] * count,
        "person_id": np.full(count, track.person_id),
        "frame": track.frames,
        "time_s": track.times_s,
        "method": [method] * count,
        "op14_m": found.positions_m - origin,
        "op14_unitquat": found.bone_unitquat,
        "body22_m": body.motion(track.rate_hz).world()[0],
        "body22_unitquat": body.unitquat,
        "root_translation_m": found.root_m - origin,
        "metres_per_pixel": found.metres_per_pixel,
        "yaw_rad": found.yaw_rad,
        "score_m": found.score_m,
        "match_take_id": [str(name) if known else "" for name, known in zip(take_ids[row], is_known, strict=True)],
        "match_frame": np.where(is_known, frames[row], -1),
        "num_joints_seen": found.num_joints_seen,
        "is_bridged": found.is_bridged,
    }


STAGE = Stage(
    *RECONSTRUCTION,
    reads=("annotations", "projections", "projection_clusters"),
    writes=("motions",),
    parameters=ReconstructionParameters,
    plan=plan,
    run_shard=run_shard,
    check_study=check_study,
    meaning="Reconstructs 3D motions of annotated people from the projection database",
    needs="videos ([[ingest.annotations]], [[ingest.videos]], or ingest.virtual_video.num_videos of takes that "
    "ingest.held_out names; reconstruction.sequences), and projections of other takes or of "
    "draws (projections.include_draws)",
)
