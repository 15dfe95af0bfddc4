"""Stage `views`: where the camera stood for every annotated pair, as weighted hypotheses with a trust."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from pasdedeux.cameras import DEPTH_RULES, ViewOptions, estimate_views
from storage_schema import ArtifactRef, Store
from tasks.stage import Parameters, Shard, Stage, StageInputs, commit, merge_takes
from tasks.torso_bases import default_origin, read_torso_basis, shares_takes

__all__ = ["STAGE", "VERSION", "ViewsParameters", "plan", "run_shard"]

VERSION = 2

_MOST_NAMED = 20


class ViewsParameters(Parameters):
    """What is assumed of cameras and people when views are estimated."""

    distance_m: float | None = Field(
        4.0, gt=0, description="Distance of the cameras, known or assumed; none: apparent size says nothing of depth"
    )
    calibrate_sizes: bool = Field(
        True, description="Learn the ratio of body sizes from apparent sizes over many cameras; one camera says little"
    )
    size_deviation: float = Field(0.035, gt=0, le=1, description="Relative error of the ratio of apparent sizes")
    depth_deviation_m: float = Field(0.6, gt=0, description="Standard deviation of the relative depth of two roots")
    contact_distance_m: float = Field(0.35, gt=0, description="Distance of the roots of two people in close contact")
    least_root_distance_m: float = Field(0.2, gt=0, description="Roots closer than this share one place")
    camera_pitch_deg: float = Field(10.0, ge=-89, le=89, description="Mean elevation of the cameras")
    camera_pitch_deviation_deg: float = Field(12.0, gt=0, description="Standard deviation of the elevation")
    lean_deviation_deg: float = Field(20.0, gt=0, description="Standard deviation of a backbone from the vertical")
    least_weight: float = Field(1e-3, ge=0, lt=0.05, description="Hypotheses of less weight are dropped")

    def options(self) -> ViewOptions:
        """Return them in radians, as the numerics take them."""
        return ViewOptions(
            distance_m=self.distance_m,
            calibrate_sizes=self.calibrate_sizes,
            size_deviation=self.size_deviation,
            depth_deviation_m=self.depth_deviation_m,
            contact_distance_m=self.contact_distance_m,
            least_root_distance_m=self.least_root_distance_m,
            camera_pitch_rad=float(np.deg2rad(self.camera_pitch_deg)),
            camera_pitch_deviation_rad=float(np.deg2rad(self.camera_pitch_deviation_deg)),
            lean_deviation_rad=float(np.deg2rad(self.lean_deviation_deg)),
            least_weight=self.least_weight,
        )


def plan(inputs: StageInputs, parameters: ViewsParameters) -> list[Shard]:
    """Plan a shard per artifact of annotations, also of single people: their shard says that it skipped them.

    Annotations of a take that the torso basis was learned from are lifted with a default basis instead, so that no
    view rests on the 3D of its own take.
    """
    bases = inputs.of("torso_basis")
    return [
        Shard(
            stage="views",
            version=VERSION,
            partition=manifest.partition,
            name=manifest.name,
            parameters=parameters.model_dump(mode="json"),
            inputs=(manifest.ref, *(basis.ref for basis in bases if not shares_takes(manifest, basis))),
            seed=inputs.seed,
        )
        for manifest in inputs.of("annotations")
    ]


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Estimate the views of one artifact's annotated pairs and commit them, with what was skipped and why."""
    annotations = store.manifest(shard.inputs[0])
    pairs = _read_pairs(store, shard.inputs[0])
    options = ViewsParameters.model_validate(shard.parameters, strict=False).options()
    estimates = estimate_views(
        pairs.px,
        read_torso_basis(store, shard.inputs),
        confidence=pairs.confidence,
        camera_index=np.unique(pairs.sequence_id.astype(str), return_inverse=True)[1],
        options=options,
    )
    psi, phi = estimates.angles()
    columns = {
        "sequence_id": pairs.sequence_id[estimates.annotation].tolist(),
        "frame": pairs.frame[estimates.annotation],
        "hypothesis": estimates.hypothesis,
        "depth_rule": [DEPTH_RULES[rule] for rule in estimates.depth_rule],
        "flip": estimates.flip,
        "root_depth_m": estimates.root_depth_m,
        "direction": estimates.direction,
        "psi_rad": psi,
        "phi_rad": phi,
        "weight": estimates.weight,
        "trust": estimates.trust[estimates.annotation],
        "metres_per_pixel": estimates.metres_per_pixel,
    }
    without = np.flatnonzero(~estimates.is_lifted)
    skipped = list(pairs.skipped)
    if len(without):
        frames = Counter(pairs.sequence_id[without].tolist())
        skipped += _in_words(frames, "fewer than 4 torso joints of one of the two people were seen")
    facts = {
        "kind": "views",
        "takes": merge_takes(*(store.manifest(ref) for ref in shard.inputs)),
        "learned_takes": merge_takes(*(store.manifest(ref) for ref in shard.inputs[1:])),
        "torso_basis": "prior takes" if len(shard.inputs) > 1 else default_origin([annotations]),
        "sequence_ids": annotations.facts.get("sequence_ids", []),
        "purpose": annotations.facts.get("purpose"),
        "is_held_out": bool(annotations.facts.get("is_held_out", False)),
        "num_annotations": len(pairs.frame),
        "num_without_view": len(without),
        "num_hypotheses": len(estimates.weight),
        "size_ratio": estimates.size_ratio,
        "median_trust": float(np.median(estimates.trust)) if len(estimates.trust) else None,
        "skipped": skipped,
    }
    return commit(shard, store, tables={"views": columns}, facts=facts)


@dataclass(frozen=True)
class _Pairs:
    """Annotated pairs by sequence and frame, person A the one with the smaller id, and what is no pair, in words."""

    sequence_id: np.ndarray
    frame: np.ndarray
    px: np.ndarray
    confidence: np.ndarray
    skipped: tuple[str, ...]


def _read_pairs(store: Store, ref: ArtifactRef) -> _Pairs:
    table = store.read(
        ref, "annotations", columns=["sequence_id", "frame", "person_id", "is_key", "pair17_px", "pair17_confidence"]
    )
    is_key = np.asarray(table["is_key"])
    sequence, frame = np.asarray(table["sequence_id"], dtype=object)[is_key], np.asarray(table["frame"])[is_key]
    person = np.asarray(table["person_id"])[is_key]
    px = np.asarray(table["pair17_px"], dtype=np.float64)[is_key]
    confidence = np.asarray(table["pair17_confidence"], dtype=np.float64)[is_key]
    names, sequence_index = np.unique(sequence.astype(str), return_inverse=True)
    order = np.lexsort((person, frame, sequence_index))
    key = np.stack([sequence_index, frame], axis=1)[order]
    is_new = np.ones(len(key), dtype=bool)
    is_new[1:] = (key[1:] != key[:-1]).any(axis=1)
    starts = np.flatnonzero(is_new)
    people = np.diff(np.append(starts, len(key)))
    pair_rows = starts[people == 2]
    skipped: list[str] = []
    for number in sorted(set(people.tolist()) - {2}):
        others = Counter(names[key[starts[people == number], 0]].tolist())
        skipped += _in_words(others, f"{number} {'person is' if number == 1 else 'people are'} annotated, not two")
    rows = order[np.stack([pair_rows, pair_rows + 1], axis=1)]
    return _Pairs(
        sequence_id=names[key[pair_rows, 0]] if len(pair_rows) else np.zeros(0, dtype=object),
        frame=key[pair_rows, 1],
        px=px[rows],
        confidence=confidence[rows],
        skipped=tuple(skipped),
    )


def _in_words(frames: Counter[str], reason: str) -> list[str]:
    """Say for each sequence how many frames were skipped; after twenty the rest together."""
    named = sorted(frames.items())
    told = [f"{sequence}: {count} frames skipped, {reason}" for sequence, count in named[:_MOST_NAMED]]
    rest = named[_MOST_NAMED:]
    if rest:
        total = sum(count for _, count in rest)
        told.append(f"{len(rest)} more sequences: {total} frames skipped, {reason}")
    return told


STAGE = Stage(
    name="views",
    version=VERSION,
    reads=("annotations", "torso_basis"),
    writes=("views",),
    parameters=ViewsParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="view hypotheses of annotated pairs",
)
