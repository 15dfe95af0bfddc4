"""Stage `lifting`: annotations lifted to 3D by the draws that look like them, and the pairs between them."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field

from pasdedeux.cameras.views import pair_in_metres
from pasdedeux.completion import (
    DrawIndex,
    FitOptions,
    Retrieval,
    complete_pair,
    fill_between,
    fit_pair,
    image_residual,
    lift_by_ik,
    pooled_lengths,
    retrieve,
    sample_naively,
    straight_between,
)
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.direct_lifting import apparent_bone_lengths, lift_pair
from storage_schema import ArtifactRef, Store
from tasks.draw_sets import DrawSet, draw_manifests, join_draws, read_draw_sets
from tasks.priors import read_limits
from tasks.stage import Parameters, Shard, Stage, StageInputs, commit, merge_takes, stream
from tasks.torso_bases import read_torso_basis, shares_takes

__all__ = ["STAGE", "VERSION", "LiftingParameters", "plan", "run_shard"]

VERSION = 1

LEAST_SEEN = 10
"""Joints of the two people that an annotation must show to be lifted."""


class LiftingParameters(Parameters):
    """Which annotations are lifted, from which draws, and how."""

    left_out: tuple[str, ...] = Field(("prior_only",), description="Densities whose draws are not looked among")
    max_frames: int = Field(40, ge=1, description="Annotated pairs lifted of each source of annotations, evenly spread")
    num_neighbours: int = Field(8, ge=1, le=1000, description="Near draws that a pair's depth is averaged over")
    num_hypotheses: int = Field(8, ge=1, description="Likeliest view hypotheses of an annotation that draws compete in")
    neighbour_deviation_m: float = Field(0.03, gt=0, description="Width of the weights of near draws, metres")
    image_deviation_m: float = Field(0.015, gt=0, description="Error of a seen joint in the final fit, metres")
    bone_deviation_m: float = Field(0.03, gt=0, description="Error of a retrieved bone's vector in the fit, metres")
    num_completing: int = Field(100, ge=1, description="Draws nearest in D_I that joints not seen are taken from")
    between_frames: int = Field(15, ge=0, description="Frames from one lifted pair of a video to the next; 0: none")
    num_spans: int = Field(2, ge=0, description="Places of each video where the pairs between are filled in")
    baselines: tuple[Literal["lifting", "lifting_ik", "naive_sampling"], ...] = Field(
        (), description="Direct lifting and what is built on it, to compare with (a second for each pair)"
    )
    num_naive: int = Field(1000, ge=1, description="Samples round each pair of the baseline naive_sampling")


def plan(inputs: StageInputs, parameters: LiftingParameters) -> list[Shard]:
    """Plan a shard per artifact of annotated pairs that has views; none without draws."""
    draws = [
        manifest for manifest in draw_manifests(inputs) if manifest.facts.get("density") not in parameters.left_out
    ]
    if not draws:
        return []
    views = {ref: manifest for manifest in inputs.of("views") for ref in manifest.inputs}
    limits = inputs.of("joint_limits") if parameters.baselines else ()
    shards = []
    for annotated in inputs.of("annotations"):
        if annotated.ref not in views or int(annotated.facts.get("num_persons", 2)) < 2:
            continue
        bases = [one for one in inputs.of("torso_basis") if parameters.baselines and not shares_takes(annotated, one)]
        refs = (annotated, views[annotated.ref], *limits, *bases, *draws)
        shards.append(
            Shard(
                stage="lifting",
                version=VERSION,
                partition=annotated.partition,
                name=annotated.name,
                parameters={**parameters.model_dump(mode="json"), "num_draws": len(draws)},
                inputs=tuple(manifest.ref for manifest in refs),
                seed=inputs.seed,
            )
        )
    return shards


@dataclass(frozen=True)
class _Annotated:
    """One annotated pair in metres (2, 17, 2), NaN where not seen, with its views (hypothesis, 3), likeliest first."""

    sequence_id: str
    frame: int
    image_m: np.ndarray
    directions: np.ndarray
    hypotheses: np.ndarray


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Lift the chosen pairs of one artifact of annotations and fill in between them."""
    options = shard.parameters
    annotated = store.manifest(shard.inputs[0])
    draw_refs = shard.inputs[len(shard.inputs) - int(options["num_draws"]) :]
    draws, index = _index(store, draw_refs)
    every, num_skipped = _read(store, shard.inputs[0], shard.inputs[1], int(options["num_hypotheses"]))
    is_video = annotated.facts.get("purpose") == "video" and int(options["between_frames"]) > 0
    chosen = _spread(every, int(options["max_frames"]))
    spans = _spans(every, int(options["num_spans"]), int(options["between_frames"])) if is_video else []
    wanted = sorted({*chosen, *(end for span in spans for end in span)})
    rows: list[dict[str, Any]] = []
    fitted: dict[tuple[str, int], np.ndarray] = {}
    for place in wanted:
        found, fit = _lift(every[place], draws, index, options)
        rows += found
        fitted[place] = fit
    rows += _baselines(shard, store, [every[place] for place in wanted], every)
    between = [row for span in spans for row in _fill(span, fitted, draws)]
    facts = {
        "kind": "lifted_pairs",
        "sequence_ids": annotated.facts.get("sequence_ids", []),
        "purpose": annotated.facts.get("purpose"),
        "is_held_out": bool(annotated.facts.get("is_held_out", False)),
        "num_draws": len(draws.pairs_m),
        "num_lifted": len(wanted),
        "learned_takes": merge_takes(*(store.manifest(ref) for ref in draw_refs)),
        "takes": merge_takes(*(store.manifest(ref) for ref in shard.inputs)),
        "skipped": [f"{annotated.partition}: {num_skipped} annotated pairs were not lifted, too little was seen"]
        if num_skipped
        else [],
    }
    tables = {"lifted_pairs": _columns(rows)} if rows else {}
    if between:
        tables["in_betweens"] = _columns(between)
    return commit(shard, store, tables=tables, facts=facts)


_KEPT: OrderedDict[tuple[str, ...], tuple[DrawSet, DrawIndex]] = OrderedDict()
"""Draws and their index: the shards that one worker runs in a row share them."""


def _index(store: Store, refs: tuple[ArtifactRef, ...]) -> tuple[DrawSet, DrawIndex]:
    identity = (str(store.root), *(ref.content_digest for ref in refs))
    if identity not in _KEPT:
        _KEPT.clear()
        sets = read_draw_sets(store, refs).values()
        parts = [(ref, one.pairs_m[one.artifacts == number]) for one in sets for number, ref in enumerate(one.refs)]
        draws = join_draws("all", parts)
        _KEPT[identity] = (draws, DrawIndex(draws.pairs_m))
    return _KEPT[identity]


def _read(
    store: Store, annotation_ref: ArtifactRef, view_ref: ArtifactRef, num_hypotheses: int
) -> tuple[dict[tuple[str, int], _Annotated], int]:
    """Return the annotated pairs with enough joints and a view, by sequence and frame, and how many had not."""
    table = store.read(
        annotation_ref, "annotations", columns=["sequence_id", "frame", "person_id", "is_key", "pair17_px"]
    )
    points = np.asarray(table["pair17_px"], dtype=np.float64)
    people: dict[tuple[str, int], dict[int, np.ndarray]] = {}
    for row in np.flatnonzero(np.asarray(table["is_key"])).tolist():
        place = (str(table["sequence_id"][row]), int(table["frame"][row]))
        people.setdefault(place, {})[int(table["person_id"][row])] = points[row]
    views = store.read(
        view_ref, "views", columns=["sequence_id", "frame", "hypothesis", "direction", "weight", "metres_per_pixel"]
    )
    hypotheses: dict[tuple[str, int], list[int]] = {}
    for row in np.lexsort((np.asarray(views["hypothesis"]), -np.asarray(views["weight"]))).tolist():
        hypotheses.setdefault((str(views["sequence_id"][row]), int(views["frame"][row])), []).append(row)
    found: dict[tuple[str, int], _Annotated] = {}
    num_skipped = 0
    for place in sorted(people):
        seen = people[place]
        likeliest = hypotheses.get(place, [])[:num_hypotheses]
        if len(seen) < 2 or not likeliest:
            num_skipped += 1
            continue
        first, second = sorted(seen)[:2]
        scale = np.asarray(views["metres_per_pixel"][likeliest[0]], dtype=np.float64)
        image = pair_in_metres(np.stack([seen[first], seen[second]]), scale)
        if np.isfinite(image).all(axis=-1).sum() < LEAST_SEEN:
            num_skipped += 1
            continue
        directions = np.asarray(views["direction"], dtype=np.float64)[likeliest]
        found[place] = _Annotated(*place, image, directions, np.asarray(views["hypothesis"])[likeliest])
    return found, num_skipped


def _spread(every: dict[tuple[str, int], _Annotated], count: int) -> list[tuple[str, int]]:
    places = list(every)
    if not places:
        return []
    return [
        places[at] for at in np.unique(np.linspace(0, len(places) - 1, min(count, len(places))).round().astype(int))
    ]


def _spans(
    every: dict[tuple[str, int], _Annotated], num_spans: int, gap: int
) -> list[tuple[tuple[str, int], tuple[str, int]]]:
    """Return pairs of places of one sequence that are `gap` frames apart, spread over all, not overlapping."""
    starts = [place for place in every if (place[0], place[1] + gap) in every]
    if not starts or not num_spans:
        return []
    chosen = np.unique(np.linspace(0, len(starts) - 1, num_spans).round().astype(int))
    return [(starts[at], (starts[at][0], starts[at][1] + gap)) for at in chosen]


def _row(one: _Annotated, method: str, pair_m: np.ndarray, **more: Any) -> dict[str, Any]:
    is_seen = np.isfinite(one.image_m).all(axis=-1)
    return {
        "sequence_id": one.sequence_id,
        "frame": one.frame,
        "method": method,
        "num_joints_seen": int(is_seen.sum()),
        "residual_m": image_residual(pair_m, one.image_m),
        "draw": None,
        "hypothesis": None,
        "pair17_m": pair_m - pair_m.reshape(-1, 3).mean(axis=0),
        **more,
    }


def _lift(one: _Annotated, draws: DrawSet, index: DrawIndex, options: Any) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Return the rows of one annotation, and its last pair in place."""
    found: Retrieval = retrieve(
        index,
        one.image_m,
        one.directions,
        count=int(options["num_neighbours"]),
        deviation_m=options["neighbour_deviation_m"],
    )
    known = {
        "draw": draws.reference(int(found.nearest.draw[0])),
        "hypothesis": int(one.hypotheses[found.nearest.view[0]]),
    }
    lengths = pooled_lengths(found.pairs_m, found.weight)
    fit = FitOptions(image_deviation_m=options["image_deviation_m"], bone_deviation_m=options["bone_deviation_m"])
    fitted = fit_pair(one.image_m, found.mean_m, lengths, fit)
    rows = [
        _row(one, "nearest", found.pairs_m[0], **known),
        _row(one, "neighbours", found.mean_m, **known),
        _row(one, "fitted", fitted, **known),
    ]
    is_seen = np.isfinite(one.image_m).all(axis=-1)
    if not is_seen.all():
        incomplete = np.where(is_seen[..., None], fitted, np.nan)
        count = min(int(options["num_completing"]), len(draws.pairs_m))
        fitted = complete_pair(incomplete, draws.pairs_m, num_nearest=count, num_ranked=2 * count).fitted_m
        rows.append(_row(one, "completed", fitted, **known))
    # The mean of all draws, seen from the likeliest view: what the draws alone say of any pair.
    rows.append(_row(one, "mean_pair", index.placed_mean(one.directions[0], one.image_m)))
    return rows, fitted


def _baselines(
    shard: Shard,
    store: Store,
    wanted: list[_Annotated],
    every: dict[tuple[str, int], _Annotated],
) -> list[dict[str, Any]]:
    """Lift whole annotations without draws, where the study asks for it."""
    baselines = shard.parameters["baselines"]
    whole = [one.image_m for one in every.values() if np.isfinite(one.image_m).all()]
    if not baselines or not whole:
        return []
    limits: JointLimits = read_limits(shard, store)
    basis = read_torso_basis(store, shard.inputs)
    lengths = apparent_bone_lengths(np.stack(whole))
    rows = []
    for one in wanted:
        if not np.isfinite(one.image_m).all():
            continue
        lifted = lift_pair(one.image_m, one.directions[0], lengths, limits, basis)
        if lifted is None:
            continue
        by_ik = lift_by_ik(one.image_m, lifted, lengths, limits)
        if "lifting" in baselines:
            rows.append(_row(one, "lifting", lifted))
        if "lifting_ik" in baselines:
            rows.append(_row(one, "lifting_ik", by_ik))
        if "naive_sampling" in baselines:
            rng = stream(shard.seed, "lifting", one.sequence_id, one.frame)
            count = int(shard.parameters["num_naive"])
            sampled = sample_naively(rng, one.image_m, by_ik, limits, num_samples=count)
            rows.append(_row(one, "naive_sampling", sampled.pairs_m[sampled.nearest]))
    return rows


def _fill(
    span: tuple[tuple[str, int], tuple[str, int]], fitted: dict[tuple[str, int], np.ndarray], draws: DrawSet
) -> list[dict[str, Any]]:
    """Return the rows between two lifted pairs of a sequence."""
    (sequence_id, first), (_, last) = span
    ends = [fitted[end] - fitted[end].reshape(-1, 3).mean(axis=0) for end in span]
    count = last - first - 1
    if count < 1:
        return []
    filled = {
        "draws": fill_between(ends[0], ends[1], count, draws.pairs_m),
        "straight": straight_between(ends[0], ends[1], count),
    }
    return [
        {
            "sequence_id": sequence_id,
            "frame": first + 1 + at,
            "method": method,
            "first_frame": first,
            "last_frame": last,
            "pair17_m": pair,
        }
        for method, pairs in filled.items()
        for at, pair in enumerate(pairs)
    ]


def _columns(rows: list[dict[str, Any]]) -> dict[str, list[Any]]:
    """Return rows as columns, in the order of the table."""
    ordered = sorted(rows, key=lambda row: (row["sequence_id"], row["frame"], row["method"], row.get("first_frame", 0)))
    return {name: [row[name] for row in ordered] for name in ordered[0]}


STAGE = Stage(
    name="lifting",
    version=VERSION,
    reads=("annotations", "views", "seeds", "draws", "joint_limits", "torso_basis"),
    writes=("lifted_pairs", "in_betweens"),
    parameters=LiftingParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="annotations lifted to 3D by the draws that look like them",
)
