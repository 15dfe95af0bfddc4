"""Stage `lifting`: lift annotations to 3D by draws that look like them, complete them, and fill in pairs between.

Frames of a video are also lifted together, by takes of the projection database if there are any.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import Field

from pasdedeux.completion.baselines import lift_by_ik, sample_naively
from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.completion.retrieval import retrieve
from pasdedeux.errors import InputError
from pasdedeux.reconstruction.annotated import database_of_draws, database_of_takes
from pasdedeux.reconstruction.sequence import SearchedDatabase
from pasdedeux.sampling.direct_lifting import apparent_bone_lengths, lift_pair
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Manifest, Store
from tasks.priors import read_limits, read_torso_basis
from tasks.projections import Pitches, ProjectionsParameters, read_database, read_pairs
from tasks.rows.annotated_pairs import PairPlace, SeenPair, read_seen_pairs
from tasks.rows.draw_sets import (
    DrawSet,
    density_of,
    draw_manifests,
    is_chain,
    knows_annotations,
    read_all_draws,
    read_draw_sets,
    reference_to,
)
from tasks.rows.lifted_rows import EXPECTED, Row, Together, as_columns, fill_span, lift_annotation, lifted_row
from tasks.seeds.over_time import is_video, lift_couple, places_by_couple
from tasks.stage import Parameters, Shard, Stage, StageInputs, StageName
from tasks.stage.committing import commit
from tasks.stage.facts import LiftedFacts, ProjectionFacts, SequenceFacts, merge_takes, shares_takes
from tasks.stage.kept import kept
from tasks.stage.streams import stream

LIFTING = StageName("lifting", 16)

DOUBTFUL_M = 0.15
"""Median expected error of lifted pairs above which there is a warning."""

_NUM_HYPOTHESES = 8
"""Number of likeliest view hypotheses of an annotation in which draws are compared."""
_NUM_NAIVE = 1000
"""Number of samples around each pair in the baseline naive_sampling."""


class LiftingParameters(Parameters):
    """Settings of lifting."""

    max_frames: int = Field(40, ge=1, description="Annotated pairs lifted of each source of annotations, evenly spread")
    between_frames: int = Field(
        15,
        ge=0,
        description="Frames from one lifted pair of a video to the next; where only key frames are annotated these, up "
        "to twice as far apart; 0: none",
    )
    num_spans: int = Field(2, ge=0, description="Places of each video where the pairs between are filled in")
    compared: tuple[str, ...] = Field(
        (), description="Draws, by their density or sweep, or grown_seeds, whose nearest one is compared"
    )
    baselines: tuple[Literal["lifting", "lifting_ik", "naive_sampling"], ...] = Field(
        (), description="Direct lifting and what is built on it, to compare with (a second for each pair)"
    )


class LiftingShard(LiftingParameters):
    """Parameters of a shard, including the pitches of the projection database, if there is one."""

    pitches_deg: Pitches = ProjectionsParameters().pitches_deg


def plan(inputs: StageInputs, parameters: LiftingParameters) -> list[Shard]:
    """Plan a shard per artifact of annotated pairs that has views; none without draws.

    Raises:
        InputError: Draws to compare are missing.
    """
    draws = [manifest for manifest in draw_manifests(inputs) if knows_annotations(manifest)]
    if not draws:
        return []
    names = sorted({density_of(manifest) for manifest in draws})
    if unknown := sorted(set(parameters.compared) - set(names)):
        raise InputError(f"lifting.compared: there are no draws '{unknown[0]}'; there are: {', '.join(names)}")
    views = {ref: manifest for manifest in inputs.of("views") for ref in manifest.inputs}
    return [
        _shard(inputs, parameters, annotated, views[annotated.ref], draws)
        for annotated in inputs.of("annotations")
        if annotated.ref in views and SequenceFacts.of(annotated).num_persons >= 2
    ]


def _shard(
    inputs: StageInputs, parameters: LiftingParameters, annotated: Manifest, views: Manifest, draws: list[Manifest]
) -> Shard:
    """Plan one source of annotations; joint limits and a torso basis of other takes serve the baselines."""
    read: dict[str, Sequence[Manifest]] = {"annotations": [annotated], "views": [views], "draws": draws}
    if parameters.baselines:
        bases = [manifest for manifest in inputs.of("torso_basis") if not shares_takes(annotated, manifest)]
        read |= {"joint_limits": inputs.of("joint_limits"), "torso_basis": bases}
    parts = [(part, ProjectionFacts.of(part)) for part in inputs.of("projections")]
    if is_video(SequenceFacts.of(annotated)):
        # Draws of a database are read anyway, and pairs lifted by them have other errors.
        takes = [part for part, facts in parts if facts.origin == "take"]
        read["projections"] = [part for part in takes if not shares_takes(annotated, part)]
    pitches = {pitch for _, facts in parts for pitch in facts.pitches_deg}
    cameras = {"pitches_deg": tuple(sorted(pitches))} if pitches else {}
    shard_parameters = parameters.part(LiftingShard, **cameras)
    return LIFTING.shard(inputs, annotated.partition, annotated.name, shard_parameters, read)


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Lift the chosen pairs of one artifact of annotations and fill in between them."""
    options = shard.options(LiftingShard)
    annotated = SequenceFacts.of(store.manifest(shard.ref("annotations")))
    draws, _ = _indexed_draws(store, shard.refs("draws"))
    seen, num_skipped = read_seen_pairs(
        store, shard.ref("annotations"), shard.ref("views"), num_hypotheses=_NUM_HYPOTHESES
    )
    in_time = sorted(place for places in places_by_couple(annotated, seen).values() for place in places)
    spans = _spans(in_time, options.num_spans, options.between_frames) if options.between_frames else []
    wanted = _wanted(list(seen), spans, options.max_frames)
    over_time = _over_time(shard, store, in_time, set(wanted), options.pitches_deg)
    rows, fitted = _lift(shard, store, wanted, seen, over_time)
    rows += _nearest_of_compared(shard, store, wanted, seen, options.compared)
    rows += _baselines(shard, store, [seen[place] for place in wanted], seen)
    between = [row for span in spans for row in fill_span(span, fitted, draws)]
    skipped = f"{shard.partition}: {num_skipped} annotated pairs were not lifted, too little was seen"
    facts = LiftedFacts(
        sequence_ids=annotated.sequence_ids,
        purpose=annotated.purpose,
        is_held_out=annotated.is_held_out,
        num_draws=len(draws.pairs_m),
        num_lifted=len(wanted),
        learned_takes=merge_takes(*map(store.manifest, (*shard.refs("draws"), *shard.refs("projections")))),
        takes=merge_takes(*(store.manifest(ref) for ref in shard.all_inputs)),
        skipped=(skipped,) if num_skipped else (),
    )
    tables = {"lifted_pairs": as_columns(rows)} if rows else {}
    if between:
        tables["in_betweens"] = as_columns(between)
    return commit(shard, store, tables=tables, facts=facts, verdict=_verdict(rows, num_skipped))


def _wanted(
    places: Sequence[PairPlace], spans: Sequence[tuple[PairPlace, PairPlace]], max_frames: int
) -> list[PairPlace]:
    """Return the places to lift: some evenly spread, and the ends of all spans."""
    chosen = [places[at] for at in evenly_spread(len(places), max_frames)]
    return sorted({*chosen, *(end for span in spans for end in span)})


def _lift(
    shard: Shard,
    store: Store,
    wanted: Sequence[PairPlace],
    seen: Mapping[PairPlace, SeenPair],
    over_time: Mapping[PairPlace, Together],
) -> tuple[list[Row], dict[PairPlace, np.ndarray]]:
    """Lift the pairs at the wanted places by the draws; return the rows and the fitted pair of each place."""
    draws, index = _indexed_draws(store, shard.refs("draws"))
    lifted_from = _lifted_from(store, shard.refs("draws"), draws)
    rows: list[Row] = []
    fitted: dict[PairPlace, np.ndarray] = {}
    for place in wanted:
        known = lifted_from.get(place[:3], ())
        new_rows, fitted[place] = lift_annotation(seen[place], draws, index, known, over_time.get(place))
        rows += new_rows
    return rows, fitted


def _nearest_of_compared(
    shard: Shard, store: Store, wanted: Sequence[PairPlace], seen: Mapping[PairPlace, SeenPair], names: tuple[str, ...]
) -> list[Row]:
    """Return the nearest draw at the wanted places, of each set of draws to compare."""
    rows = []
    for name, index in _compared(store, shard.refs("draws"), names).items():
        nearest = [retrieve(index, seen[place].image_m, seen[place].directions).pairs_m[0] for place in wanted]
        rows += [
            lifted_row(seen[place], f"nearest_of_{name}", pair) for place, pair in zip(wanted, nearest, strict=True)
        ]
    return rows


def _verdict(rows: Sequence[Row], num_skipped: int) -> Verdict:
    """Return the verdict by the distance of the nearest draws from the images, against the mean of all draws."""
    distance = {
        method: [row["residual_m"] for row in rows if row["method"] == method] for method in ("nearest", "mean_pair")
    }
    nearest, mean_pair = (float(np.mean(distances)) if distances else math.nan for distances in distance.values())
    level, reason = Level.PASS, ""
    if not rows:
        level = Level.FAIL if num_skipped else Level.WARN
        reason = f"nothing was lifted: {num_skipped} annotated pairs show too little or have no view"
    elif nearest >= mean_pair:
        level, reason = Level.WARN, "the nearest draws look no more like the images than the mean of all draws does"
    elif (
        expected := float(np.median([error for row in rows if (error := row[EXPECTED[0]]) is not None]))
    ) > DOUBTFUL_M:
        level, reason = Level.WARN, f"draws had to be bent far: joints are expected {100 * expected:.0f} cm off"
    return Verdict(
        level,
        reason,
        figure="distance between nearest draw and image",
        value=nearest,
        unit="m",
        baseline=mean_pair,
        baseline_name="mean of all draws",
        count=len(distance["nearest"]),
        thing="images",
    )


@kept()
def _indexed_draws(store: Store, refs: tuple[ArtifactRef, ...]) -> tuple[DrawSet, DrawIndex]:
    """Return the draws and their index, shared by the shards that a worker runs in a row."""
    draws = read_all_draws(store, refs)
    return draws, DrawIndex(draws.pairs_m)


@kept()
def _compared(store: Store, refs: tuple[ArtifactRef, ...], names: tuple[str, ...]) -> dict[str, DrawIndex]:
    """Return an index over the draws of each name."""
    compared_refs = [ref for ref in refs if density_of(store.manifest(ref)) in names]
    return {name: DrawIndex(draw_set.pairs_m) for name, draw_set in read_draw_sets(store, compared_refs).items()}


def _spans(places: Sequence[PairPlace], num_spans: int, gap: int) -> list[tuple[PairPlace, PairPlace]]:
    """Return evenly spread spans of one pair each: `gap` frames apart, or between key frames up to twice that."""
    there = set(places)
    spans = [(place, place._replace(frame=place.frame + gap)) for place in places]
    spans = [span for span in spans if span[1] in there]
    if not spans:
        in_order = sorted(places, key=lambda place: (place._replace(frame=0), place.frame))
        spans = [(first, last) for first, last in pairwise(in_order) if first._replace(frame=last.frame) == last]
        spans = [(first, last) for first, last in spans if 1 < last.frame - first.frame <= 2 * gap]
    return [spans[at] for at in evenly_spread(len(spans), num_spans)]


@kept()
def _searched(
    store: Store, database: tuple[ArtifactRef, ...], draws: tuple[ArtifactRef, ...], pitches_deg: Pitches
) -> tuple[SearchedDatabase, bool]:
    """Return the database for frames of a camera, shared by the shards of a worker, and whether it is made of draws.

    It is made of takes of the projection database; of draws and grown pairs if that has no pairs.
    """
    pitches = np.deg2rad(pitches_deg).tolist()
    if len(pairs_m := read_pairs(store, database)):
        return database_of_takes(read_database(store, database)[0], pairs_m, pitches), False
    return database_of_draws(_indexed_draws(store, draws)[0].pairs_m, pitches), True


def _over_time(
    shard: Shard, store: Store, places: Sequence[PairPlace], wanted: set[PairPlace], pitches_deg: Pitches
) -> dict[PairPlace, Together]:
    """Return both people at the wanted places of videos, reconstructed from these and other places."""
    facts = SequenceFacts.of(store.manifest(shard.ref("annotations")))

    def database() -> SearchedDatabase:
        return _searched(store, shard.refs("projections"), shard.refs("draws"), pitches_deg)[0]

    lifted: dict[PairPlace, tuple[np.ndarray, float]] = {}
    for of_couple in places_by_couple(facts, places).values():
        lifted |= lift_couple(store, shard.ref("annotations"), of_couple, wanted, database)
    is_of_draws = bool(lifted) and _searched(store, shard.refs("projections"), shard.refs("draws"), pitches_deg)[1]
    return {place: Together(*pair, is_of_draws) for place, pair in lifted.items()}


def lift_again(
    store: Store,
    annotations: ArtifactRef,
    views: ArtifactRef,
    at_hand: Sequence[ArtifactRef],
    moment: tuple[str, int],
    points_px: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Lift the annotation of a sequence and frame, and again with other points; return both pairs (2, 17, 3).

    Args:
        store: Store.
        annotations: Artifact of the annotation.
        views: Its views, the same for both.
        at_hand: Artifacts, of which those with draws or grown pairs are used.
        moment: Sequence and frame.
        points_px: Points (2, 17, 2), pixels, that replace the annotated ones.

    Raises:
        InputError: There are no draws, or the annotation shows too little or has no view.
    """
    inputs = [store.manifest(ref) for ref in at_hand]
    tables = {table: [manifest for manifest in inputs if table in manifest.tables] for table in ("draws", "seeds")}
    draws_of = [manifest for manifest in draw_manifests(StageInputs(tables, seed=0)) if knows_annotations(manifest)]
    if not draws_of:
        raise InputError("lifting needs grown pairs, or draws of a density other than prior_only; there are none")
    draws, index = _indexed_draws(store, tuple(manifest.ref for manifest in draws_of))
    pairs = []
    for instead in (None, {moment: points_px}):
        every, _ = read_seen_pairs(store, annotations, views, num_hypotheses=_NUM_HYPOTHESES, instead=instead)
        seen = next((pair for place, pair in every.items() if place[:2] == moment), None)
        if seen is None:
            raise InputError(f"{moment[0]} frame {moment[1]} has no view, or shows too little to be lifted")
        pairs.append(lift_annotation(seen, draws, index, ())[1])
    return pairs[0], pairs[1]


def _lifted_from(store: Store, refs: Sequence[ArtifactRef], draws: DrawSet) -> dict[tuple[str, int, int], list[int]]:
    """Return the draws lifted from each annotation, by sequence, frame and person A.

    Couples that share person A are not distinguished, because they show the same person at the same moment.
    """
    names = ["seed_index", "sequence_id", "sequence_frame", "sequence_person_id", "filled_from"]
    images: dict[int, tuple[str, int, int]] = {}
    parents: dict[int, list[int]] = {}
    seeds: dict[str, np.ndarray] = {}
    for manifest in map(store.manifest, refs):
        if is_chain(manifest):
            continue
        kind = "seeds" if "seeds" in manifest.tables else "draws"
        table = store.read(manifest.ref, kind, columns=names if kind == "seeds" else names[:1])
        seeds[reference_to(kind, manifest.ref)] = np.asarray(table["seed_index"])
        if kind == "draws":
            continue
        for seed, sequence, frame, person, filled_from in zip(*(table[name] for name in names), strict=True):
            parents[int(seed)] = [int(seed), *filled_from.tolist()]
            if sequence is not None:
                images[int(seed)] = str(sequence), int(frame), int(person)
    by_image: dict[tuple[str, int, int], list[int]] = {}
    for artifact, reference in enumerate(draws.refs):
        rows = np.flatnonzero(draws.artifacts == artifact)
        for draw, seed in zip(rows.tolist(), seeds.get(reference, ()), strict=False):
            for image in {images[parent] for parent in parents.get(int(seed), ()) if parent in images}:
                by_image.setdefault(image, []).append(draw)
    return by_image


def _baselines(
    shard: Shard, store: Store, wanted: Sequence[SeenPair], every: Mapping[PairPlace, SeenPair]
) -> list[Row]:
    """Lift complete annotations without draws, by the baselines of the study."""
    options = shard.options(LiftingShard)
    whole = [seen.image_m for seen in every.values() if seen.is_seen.all()]
    if not options.baselines or not whole:
        return []
    limits = read_limits(store, shard.refs("joint_limits"))
    basis = read_torso_basis(store, (*shard.refs("torso_basis"), *shard.refs("annotations")))
    lengths = apparent_bone_lengths(np.stack(whole))
    rows = []
    for seen in wanted:
        if not seen.is_seen.all():
            continue
        lifted = lift_pair(seen.image_m, seen.directions[0], lengths, limits, basis)
        if lifted is None:
            continue
        by_ik = lift_by_ik(seen.image_m, lifted, lengths, limits)
        methods = {"lifting": lifted, "lifting_ik": by_ik}
        if "naive_sampling" in options.baselines:
            rng = stream(shard.seed, "lifting", *seen.place)
            methods["naive_sampling"] = sample_naively(rng, seen.image_m, by_ik, limits, num_samples=_NUM_NAIVE)
        rows += [lifted_row(seen, method, pair_m) for method, pair_m in methods.items() if method in options.baselines]
    return rows


STAGE = Stage(
    *LIFTING,
    reads=("annotations", "views", "seeds", "draws", "joint_limits", "torso_basis", "projections"),
    writes=("lifted_pairs", "in_betweens"),
    parameters=LiftingParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="annotations lifted to 3D by the draws that look like them",
    needs="annotations of two people ([[ingest.annotations]], [[ingest.videos]]), and draws of a density "
    "beside prior_only (chains.densities) or grown pairs (seeds.num_grown)",
)
