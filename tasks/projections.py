"""Stage `projections`: the poses of a projection database, from takes, and from draws and variants when asked.

For comparison also the codebook of the published search, when asked: clusters of all projections of the takes.
"""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np
from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.projections.bones import bone_rotations
from pasdedeux.projections.database import Database
from pasdedeux.projections.published import PublishedSettings, build_codebook
from pasdedeux.projections.retarget import centre_and_face, retarget_proportions
from pasdedeux.projections.sources import op14_from_working, resample_positions
from pasdedeux.skeletons import BODY22, PAIR17
from storage_schema import ArtifactRef, Manifest, Store
from tasks.stage import Parameters, Shard, Stage, StageInputs, commit, merge_takes, stream

__all__ = ["STAGE", "VERSION", "ProjectionsParameters", "plan", "run_shard"]

VERSION = 1


class ProjectionsParameters(Parameters):
    """Which poses enter the database, and at which rate."""

    rate_hz: float = Field(24.0, gt=0, le=240, description="Frames per second of the database")
    include_draws: bool = Field(False, description="Poses of the chains' draws enter the database")
    include_variants: bool = Field(False, description="Poses of the variants enter the database")
    densities: tuple[str, ...] = Field(("ic",), description="Densities whose draws enter")
    num_clusters: int = Field(
        0,
        ge=0,
        le=100_000,
        description="Clusters of the published search (level orthographic camera, takes only), for comparison with the "
        "exact one; 0 for none, the paper has 500",
    )
    num_cluster_dimensions: int = Field(5, ge=1, le=100, description="Dimensions of the embedding that is clustered")


def plan(inputs: StageInputs, parameters: ProjectionsParameters) -> list[Shard]:
    """Plan a shard per take that is not held out, per artifact of draws and per artifact of variants."""
    shards = []
    wanted = [("take", "poses")]
    if parameters.include_draws:
        wanted.append(("draw", "draws"))
    if parameters.include_variants:
        wanted.append(("variant", "variants"))
    for origin, table in wanted:
        for manifest in inputs.of(table):
            facts = manifest.facts
            if facts.get("is_held_out", False):
                continue
            chosen: dict[str, Any] = {"origin": origin, "rate_hz": parameters.rate_hz}
            if origin == "draw":
                if "density" in facts and facts["density"] not in parameters.densities:
                    continue
                chosen["densities"] = list(parameters.densities)
            else:
                chosen["source_rate_hz"] = facts.get("rate_hz")
            shards.append(
                Shard(
                    stage="projections",
                    version=VERSION,
                    partition=facts.get("take_id", manifest.partition),
                    name=f"{origin}-{manifest.partition}-{manifest.name}",
                    parameters=chosen,
                    inputs=(manifest.ref,),
                    seed=inputs.seed,
                )
            )
    taken = [shard for shard in shards if shard.parameters["origin"] == "take"]
    if parameters.num_clusters and taken:
        shards.append(
            Shard(
                stage="projections",
                version=VERSION,
                partition="codebook",
                name="codebook",
                parameters={
                    "origin": "codebook",
                    "rate_hz": parameters.rate_hz,
                    "num_clusters": parameters.num_clusters,
                    "num_dimensions": parameters.num_cluster_dimensions,
                },
                after=tuple(shard.key for shard in taken),
                seed=inputs.seed,
            )
        )
    return shards


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Retarget the poses of one source to the reference body, take heading and place away, and commit them."""
    if shard.parameters["origin"] == "codebook":
        return _run_codebook(shard, store)
    (ref,) = shard.inputs
    origin = shard.parameters["origin"]
    rows = {"take": _take_rows, "draw": _draw_rows, "variant": _variant_rows}[origin](shard, store, ref)
    positions = rows.pop("positions")
    centred = centre_and_face(retarget_proportions(positions))
    columns: dict[str, Any] = {
        "origin": [origin] * len(positions),
        **rows,
        "op14_m": centred.poses_m,
        "op14_unitquat": bone_rotations(centred.poses_m),
        "heading_rad": centred.heading_rad,
        "root_translation_m": centred.root_translation_m,
        "joint_radius_m": np.hypot(centred.poses_m[..., 0], centred.poses_m[..., 2]),
    }
    facts = {
        "kind": "projections",
        "origin": origin,
        "takes": merge_takes(store.manifest(ref)),
        "num_poses": len(positions),
        "rate_hz": shard.parameters["rate_hz"],
    }
    return commit(shard, store, tables={"projections": columns}, facts=facts)


def _run_codebook(shard: Shard, store: Store) -> ArtifactRef:
    """Cluster the projections of all takes; members are numbered over the takes in the order of the plan."""
    parts: list[Manifest] = []
    for key in shard.after:
        manifest = store.find("projections", key)
        if manifest is None:
            raise InputError("a part of the projection database is not in the store; run the whole stage")
        parts.append(manifest)
    tables = [store.read(part.ref, "projections", columns=["op14_m", "is_sequence_start"]) for part in parts]
    database = Database(
        np.concatenate([np.asarray(table["op14_m"]) for table in tables]),
        np.concatenate([np.asarray(table["is_sequence_start"]) for table in tables]),
        rate_hz=shard.parameters["rate_hz"],
    )
    settings = PublishedSettings(
        num_clusters=shard.parameters["num_clusters"], num_dimensions=shard.parameters["num_dimensions"]
    )
    book = build_codebook(database, stream(shard.seed, "projections", "codebook"), settings)
    columns = {
        "cluster": np.arange(len(book.members)),
        "representative_m": book.representatives_m,
        "members": list(book.members),
    }
    facts = {
        "kind": "codebook",
        "takes": merge_takes(*parts),
        "num_clusters": len(book.members),
        "part_keys": [part.ref.key for part in parts],
    }
    sources = [source for part in parts for source in part.sources]
    return commit(shard, store, tables={"codebook": columns}, facts=facts, sources=sources)


def _take_rows(shard: Shard, store: Store, ref: ArtifactRef) -> dict[str, Any]:
    """Give the poses of every person of a take at the database's rate."""
    poses = store.read(ref, "poses", columns=["take_id", "person", "frame", "time_s", "op14_m"])
    person, take_ids = np.asarray(poses["person"]), list(poses["take_id"])
    from_hz = shard.parameters["source_rate_hz"] or _rate_of(np.asarray(poses["time_s"])[person == person[0]])
    parts = []
    for one in np.unique(person):
        chosen = np.flatnonzero(person == one)
        chosen = chosen[np.argsort(np.asarray(poses["frame"])[chosen], kind="stable")]
        moved = resample_positions(
            np.asarray(poses["op14_m"], dtype=np.float64)[chosen], from_hz=from_hz, to_hz=shard.parameters["rate_hz"]
        )
        parts.append(_one_motion(moved, take_ids[chosen[0]], int(one)))
    return _joined(parts)


def _draw_rows(shard: Shard, store: Store, ref: ArtifactRef) -> dict[str, Any]:
    """Give both people of every draw; draws have no past, so each is a motion of its own."""
    draws = store.read(ref, "draws", columns=["density", "pair17_m", "take_id"])
    is_wanted = np.isin(np.array(list(draws["density"]), dtype=object), list(shard.parameters["densities"]))
    rows = np.flatnonzero(is_wanted)
    pairs = op14_from_working(np.asarray(draws["pair17_m"], dtype=np.float64)[rows], PAIR17)
    take_ids = [list(draws["take_id"])[row] or "" for row in rows]
    parts = []
    for person in range(2):
        parts.append(
            {
                "take_id": take_ids,
                "person": np.full(len(rows), person),
                "frame": rows,
                "is_sequence_start": np.ones(len(rows), dtype=bool),
                "positions": pairs[:, person],
            }
        )
    return _joined(parts)


def _variant_rows(shard: Shard, store: Store, ref: ArtifactRef) -> dict[str, Any]:
    """Give both people of every variant at the database's rate."""
    table = store.read(ref, "variants", columns=["take_id", "variant_id", "frame", "time_s", "body22_m"])
    variant = np.array(list(table["variant_id"]), dtype=object)
    take_ids = list(table["take_id"])
    poses = np.asarray(table["body22_m"], dtype=np.float64)
    parts = []
    for one in sorted(set(variant)):
        chosen = np.flatnonzero(variant == one)
        chosen = chosen[np.argsort(np.asarray(table["frame"])[chosen], kind="stable")]
        from_hz = shard.parameters["source_rate_hz"] or _rate_of(np.asarray(table["time_s"])[chosen])
        pair = resample_positions(
            op14_from_working(poses[chosen], BODY22), from_hz=from_hz, to_hz=shard.parameters["rate_hz"]
        )
        parts += [_one_motion(pair[:, person], take_ids[chosen[0]], person) for person in range(2)]
    return _joined(parts)


def _one_motion(positions: np.ndarray, take_id: str, person: int) -> dict[str, Any]:
    frame = np.arange(len(positions))
    return {
        "take_id": [take_id] * len(positions),
        "person": np.full(len(positions), person),
        "frame": frame,
        "is_sequence_start": frame == 0,
        "positions": positions,
    }


def _joined(parts: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        name: list(chain.from_iterable(part[name] for part in parts))
        if name == "take_id"
        else np.concatenate([part[name] for part in parts])
        for name in ("take_id", "person", "frame", "is_sequence_start", "positions")
    }


def _rate_of(time_s: np.ndarray) -> float:
    return float(1.0 / np.median(np.diff(np.sort(time_s)))) if len(time_s) > 1 else 1.0


STAGE = Stage(
    name="projections",
    version=VERSION,
    reads=("poses", "draws", "variants"),
    writes=("projections", "codebook"),
    parameters=ProjectionsParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Builds the projection database: poses on one body, mid-hip at the origin, heading removed",
)
