"""Stage `reconstruction`: 3D motions of the people of annotated sequences, matched to a projection database."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from pasdedeux.errors import InputError, named
from pasdedeux.evaluation.verdicts import merge_verdicts
from pasdedeux.formats.humanoid import write_npz
from pasdedeux.formats.poses2d.calibration import CalibratedCamera, calibrated_camera
from pasdedeux.formats.poses2d.camera_motion import CameraMotion
from pasdedeux.people.video import check_one_video, why_no_video
from pasdedeux.projections.database import Database
from pasdedeux.reconstruction.matching import Method
from pasdedeux.reconstruction.moving_camera import subtract_motion
from pasdedeux.reconstruction.people import MethodMotions, ReconstructedPeople, SequenceOptions
from pasdedeux.reconstruction.reconstruct import HOW_TO_CLUSTER
from pasdedeux.reconstruction.sequence import SearchedDatabase, StatedCamera, reconstruct_sequence
from pasdedeux.reconstruction.tracks import TRACK_COLUMNS, Track, tracks_of
from pasdedeux.reconstruction.views.cameras import camera_facts, upright_m
from pasdedeux.reconstruction.views.together import SeenTogether, reconstruct_views
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Manifest, Store
from tasks.projections import clusters_of, read_cameras, read_clusters, read_pairs, read_searched
from tasks.rows.camera_motions import read_camera_motion
from tasks.stage import Parameters, Shard, Stage, StageInputs, StageName
from tasks.stage.committing import commit, join_columns
from tasks.stage.facts import MotionFacts, SequenceFacts, merge_takes, shares_takes
from tasks.stage.kept import kept

RECONSTRUCTION = StageName("reconstruction", 25)

LEVEL = "level"
"""Name of the baseline that assumes a level camera."""
_MAX_KEPT = 1_250_000
"""Largest number of projections, over all cameras, that a worker keeps from shard to shard: 160 MB."""


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
    """Parameters of a shard: its sequence, settings, and stated facts.

    A film with a captured take is also reconstructed by the last method with a level camera: the baseline `level`,
    which comes first.
    """

    sequence_id: str
    has_level_camera: bool = False
    camera_height_m: float | None = None
    statures_m: dict[int, float] = Field({})


def plan(inputs: StageInputs, parameters: ReconstructionParameters) -> list[Shard]:
    """Plan a shard per video sequence, with all projections except those of the sequence's take."""
    shards = []
    databases, annotations = inputs.of("projections"), inputs.of("annotations")
    others: dict[str, list[Manifest]] = {}
    for manifest in annotations:
        if first := SequenceFacts.of(manifest).camera_of:
            others.setdefault(first, []).append(manifest)
    if unknown := sorted(others.keys() - {manifest.partition for manifest in annotations}):
        raise InputError(f"'{unknown[0]}', which camera_of names, has no 2D poses under this name")
    for manifest in annotations:
        if SequenceFacts.of(manifest).camera_of or manifest.partition in others:
            check_one_video(f"camera {manifest.partition}", SequenceFacts.of(manifest).sequence_ids)
    for manifest in annotations:
        facts = SequenceFacts.of(manifest)
        if facts.camera_of or not _is_wanted(manifest, parameters.sequences):
            continue
        cameras = [manifest, *others.get(manifest.partition, ())]
        allowed = [database for database in databases if not any(shares_takes(camera, database) for camera in cameras)]
        for sequence_id in facts.sequence_ids:
            of_sequence = parameters.part(
                SequenceShard,
                sequence_id=sequence_id,
                has_level_camera=facts.purpose == "given" and bool(facts.takes) and len(cameras) == 1,
                camera_height_m=facts.camera_height_m,
                statures_m=facts.statures_m,
            )
            read = {"annotations": cameras, "projections": allowed}
            if Method.PUBLISHED in parameters.methods and allowed:
                clusters, parts = clusters_of(inputs, allowed)
                if not clusters:
                    raise InputError(
                        f"{sequence_id}: the projection database without its own take has no clusters; "
                        f"{HOW_TO_CLUSTER}, and hold the take out (ingest.held_out)"
                    )
                read |= {"clusters": clusters, "projections": parts}
            shards.append(RECONSTRUCTION.shard(inputs, sequence_id, sequence_id, of_sequence, read))
    return shards


def check_study(sections: Mapping[str, Any]) -> None:
    """Refuse the method `published` over a database without clusters.

    Raises:
        InputError: The method `published` is wanted, and num_clusters of [projections] is not set.
    """
    projections = sections.get("projections")
    if Method.PUBLISHED in sections["reconstruction"].methods and projections and not projections.num_clusters:
        raise InputError(f"the projection database has no clusters; {HOW_TO_CLUSTER}")


def _is_wanted(manifest: Manifest, sequences: str) -> bool:
    facts = SequenceFacts.of(manifest)
    if facts.purpose == "given":
        return True
    return facts.purpose == "video" and (sequences == "all" or (sequences == "held_out" and facts.is_held_out))


class _SequenceResult(NamedTuple):
    """The people of a sequence, their verdicts by part, the arrays of its cameras, and facts about these."""

    people: ReconstructedPeople
    verdicts: Mapping[str, Verdict]
    cameras: Mapping[str, np.ndarray]
    facts: Mapping[str, Any]
    skipped: Sequence[str]


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Reconstruct every person of a sequence with every method; facts name the people who could not be."""
    parameters = shard.options(SequenceShard)
    sequence_id, facts = parameters.sequence_id, _facts_of_inputs(shard, store, parameters)
    tracks, reasons = read_tracks(store, shard.refs("annotations")[0], sequence_id)
    reasons += _faults_of_database(shard, store, tracks)
    rows: list[dict[str, Any]] = []
    attachments: dict[str, bytes] = {}
    judged: dict[str, Verdict] = {}
    skipped: list[str] = []
    if tracks and not reasons:
        database = _database(store, shard.refs("projections"), shard.refs("clusters"), num_people=len(tracks))
        result = _reconstruct(shard, store, parameters, tracks, database)
        if isinstance(result, str):
            reasons.append(result)
        else:
            people = result.people
            rows = _rows_of_methods(people, tracks, database, parameters)
            attachments = _motion_files(sequence_id, people, result.cameras)
            judged |= result.verdicts
            judged |= {f"person {person_id}": Verdict(Level.WARN, why) for person_id, why in people.skipped.items()}
            skipped += result.skipped
            skipped += [f"{sequence_id}, person {person_id}: {why}" for person_id, why in people.skipped.items()]
            facts |= {**_facts_of_scene(people), "num_projections": database.poses.num_projections, **result.facts}
    facts["skipped"] = [*(f"{sequence_id}: {reason}" for reason in reasons), *skipped]
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


def _facts_of_inputs(shard: Shard, store: Store, parameters: SequenceShard) -> dict[str, Any]:
    """Return the facts that are known before the reconstruction."""
    sequence = store.manifest(shard.refs("annotations")[0])
    database = [store.manifest(ref) for ref in shard.refs("projections")]
    return {
        "sequence_ids": [parameters.sequence_id],
        "takes": merge_takes(sequence, *database),
        "sequence_takes": merge_takes(sequence),
        "database_takes": merge_takes(*database),
        "methods": [method.value for method in parameters.methods],
    }


def _faults_of_database(shard: Shard, store: Store, tracks: Sequence[Track]) -> list[str]:
    """Return the reason why these tracks cannot be matched to the database, if there is one."""
    parts = [store.manifest(ref) for ref in shard.refs("projections")]
    if not parts:
        return ["there is no projection database without the sequence's own take"]
    is_empty = not any(part.tables["projections"].rows for part in parts)
    return ["the projection database has no pose"] if tracks and is_empty else []


def _reconstruct(
    shard: Shard, store: Store, parameters: SequenceShard, tracks: Sequence[Track], database: SearchedDatabase
) -> _SequenceResult | str:
    """Reconstruct the people seen by one or several cameras; return the reason if several cannot be used together."""
    (first, *others), stated = shard.refs("annotations"), StatedCamera(height_m=parameters.camera_height_m)
    if not others:
        alone = reconstruct_sequence(tracks, database, stated, _options(parameters))
        return _SequenceResult(alone.people, alone.judged.verdicts, {}, {}, ())
    try:
        together = _reconstruct_together(store, first, others, tracks, database, stated, parameters)
    except InputError as error:
        return str(error)
    placed_m = upright_m(together.people)
    facts = {
        "cameras": [seen.in_words(placed_m) for seen in together.cameras],
        "methods": [parameters.methods[-1].value],
    }
    cameras = camera_facts(together.cameras, placed_m)
    return _SequenceResult(together.people, together.judged.verdicts, cameras, facts, together.left_out)


def _rows_of_methods(
    people: ReconstructedPeople, tracks: Sequence[Track], database: SearchedDatabase, parameters: SequenceShard
) -> list[dict[str, Any]]:
    """Return the rows of every person by every method, those of the baseline `level` first."""
    methods = [(motions.name, motions, people.camera_from_upright_rotmat) for motions in people.methods]
    if parameters.has_level_camera:
        methods = [*_made_level(tracks, database, parameters), *methods]
    return [row for of_method in methods for row in _rows(parameters.sequence_id, *of_method, database)]


def _motion_files(sequence_id: str, people: ReconstructedPeople, cameras: Mapping[str, np.ndarray]) -> dict[str, bytes]:
    """Return a BVH and an npz file of every person, by name."""
    return {
        f"{sequence_id}_{person_id}.{kind}": data
        for person_id, motion in people.motions.items()
        for kind, data in (
            ("bvh", motion.bvh().encode()),
            ("npz", write_npz(motion, **people.camera_facts, **cameras)),
        )
    }


def _facts_of_scene(people: ReconstructedPeople) -> dict[str, Any]:
    """Return the estimates of the camera."""
    facts = {
        "pitch_deg": float(np.rad2deg(people.pitch.pitch_rad)),
        "pitch_deviation_deg": float(np.rad2deg(people.pitch.deviation_rad)),
    }
    if people.scene is not None:
        facts |= {"camera_height_m": people.scene.camera_height_m, "lens_factor": people.scene.lens_factor}
    return facts


def _reconstruct_together(
    store: Store,
    first: ArtifactRef,
    others: Sequence[ArtifactRef],
    tracks: Sequence[Track],
    database: SearchedDatabase,
    stated: StatedCamera,
    parameters: SequenceShard,
) -> SeenTogether:
    """Return the people of a take that other cameras saw beside the first, which has these tracks.

    Raises:
        InputError: A camera shows nobody, its images differ in shape from those of the calibration, or an error of
            `reconstruct_views`.
    """
    seen, names, calibration = [tracks], [parameters.sequence_id], list[CalibratedCamera]()
    for ref in others:
        names.append(store.manifest(ref).partition)
        (sequence_id,) = SequenceFacts.of(store.manifest(ref)).sequence_ids
        of_other, reasons = read_tracks(store, ref, sequence_id)
        if not of_other:
            raise InputError(f"camera {names[-1]}: {next(iter(reasons), 'it shows nobody')}")
        seen.append(of_other)
    for name, ref in zip(names, (first, *others), strict=True):
        if stated_calibration := SequenceFacts.of(store.manifest(ref)).calibration:
            sizes = store.read(ref, "annotations", columns=["image_width_px", "image_height_px"], rows=slice(1))
            width, height = (sizes[column][0] for column in ("image_width_px", "image_height_px"))
            with named(f"camera {name}"):
                size_px = None if width is None or height is None else (width, height)
                calibration.append(calibrated_camera(*stated_calibration, size_px))
    options = replace(_options(parameters), methods=parameters.methods[-1:])
    return reconstruct_views(seen, database, stated, options, names=names, calibration=calibration)


def read_tracks(store: Store, ref: ArtifactRef, sequence_id: str) -> tuple[list[Track], list[str]]:
    """Return the tracks of a sequence in its steady image, or the reasons why it is no video."""
    table = store.read(ref, "annotations", columns=["sequence_id", *TRACK_COLUMNS])
    frames = np.asarray(table["frame"])[table["sequence_id"] == sequence_id]
    # The decision of ingest counts, because stills numbered one by one look like a video.
    decided = SequenceFacts.of(store.manifest(ref)).why_no_video.get(sequence_id)
    if reason := decided or (why_no_video(frames) if len(frames) else ""):
        return [], [reason]
    motion = read_camera_motion(store, ref, sequence_id)
    return subtract_motion(tracks_of({name: table[name] for name in table}, sequence_id), motion)[0], []


def read_subtracted_motion(store: Store, ref: ArtifactRef, sequence_id: str) -> CameraMotion | None:
    """Return the camera motion that was subtracted before the reconstruction of a sequence; None if none was."""
    motion = read_camera_motion(store, ref, sequence_id)
    if motion is None:
        return None
    table = store.read(ref, "annotations", columns=["sequence_id", *TRACK_COLUMNS])
    return motion if subtract_motion(tracks_of({name: table[name] for name in table}, sequence_id), motion)[1] else None


def _database(
    store: Store, refs: tuple[ArtifactRef, ...], clusters: tuple[ArtifactRef, ...], *, num_people: int
) -> SearchedDatabase:
    """Return the projection database; if it is small, a worker keeps its searchers for all shards."""
    num_rows = sum(store.manifest(ref).tables["projections"].rows for ref in refs)
    num_cameras = len(read_cameras([store.manifest(ref) for ref in refs]))
    is_small = num_cameras * num_rows * Database.num_yaws <= _MAX_KEPT
    return replace(
        (_read_ready if is_small else read_searched)(store, refs),
        pairs_m=_read_pairs(store, refs) if num_people > 1 else None,
        clusters=read_clusters(store, clusters[0]) if clusters else None,
    )


@kept()
def _read_ready(store: Store, refs: tuple[ArtifactRef, ...]) -> SearchedDatabase:
    database = read_searched(store, refs)
    return replace(database, ready=tuple(database.searchers_tried()) if len(database.pitches_rad) > 1 else ())


_read_pairs = kept()(read_pairs)


def _options(parameters: SequenceShard) -> SequenceOptions:
    return SequenceOptions(parameters.methods, statures_m=parameters.statures_m)


def _made_level(
    tracks: Sequence[Track], database: SearchedDatabase, parameters: SequenceShard
) -> list[tuple[str, MethodMotions, np.ndarray]]:
    """Return the motions of the last method with a level camera; none if nobody matches."""
    camera = StatedCamera(0.0, parameters.camera_height_m)
    options = replace(_options(parameters), methods=parameters.methods[-1:])
    people = reconstruct_sequence(tracks, database, camera, options).people
    return [(LEVEL, motions, people.camera_from_upright_rotmat) for motions in people.methods[-1:]]


def _rows(
    sequence_id: str,
    method: str,
    motions: MethodMotions,
    camera_from_upright_rotmat: np.ndarray,
    database: SearchedDatabase,
) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table of motions for every person of a method."""
    for person, body in zip(motions.people, motions.bodies, strict=True):
        count, track, seen = len(person.positions_m), person.track, body.turned(camera_from_upright_rotmat)
        is_known = person.row >= 0
        row = np.maximum(person.row, 0)
        yield {
            "sequence_id": [sequence_id] * count,
            "person_id": np.full(count, track.person_id),
            "frame": track.frames,
            "time_s": track.times_s,
            "method": [method] * count,
            "op14_m": person.positions_m - motions.origin_m,
            "op14_unitquat": person.bone_unitquat,
            "body22_m": seen.motion(track.rate_hz).world()[0],
            "body22_unitquat": seen.unitquat,
            "root_translation_m": person.root_m - motions.origin_m,
            "metres_per_pixel": person.metres_per_pixel,
            "yaw_rad": person.yaw_rad,
            "score_m": person.score_m,
            "match_take_id": np.where(is_known, database.take_ids[row], "").tolist(),
            "match_frame": np.where(is_known, database.take_frames[row], -1),
            "num_joints_seen": person.num_joints_seen,
            "is_bridged": person.is_bridged,
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
