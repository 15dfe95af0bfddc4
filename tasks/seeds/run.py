"""Making of seeds: read or choose frames, import files, lift annotations (also over time), grow and fill in pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from pasdedeux.completion.neighbours import nearest_rigid
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.reconstruction.annotated import MAX_PAIRS, as_pair17, database_of_draws
from pasdedeux.sampling.direct_lifting import lift_seeds
from pasdedeux.sampling.growth import FARTHEST_M, Growth, grow
from pasdedeux.sampling.neighbourhoods import NUM_PARENTS, pairs_between
from pasdedeux.sampling.parameters import gauge_fix
from pasdedeux.sampling.prior import PriorSettings
from pasdedeux.sampling.seeds import choose_seeds, seed_quality
from pasdedeux.skeletons import PAIR17
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, SourceCredit, Store
from tasks.priors import read_limits, read_torso_basis
from tasks.projections import ProjectionsParameters
from tasks.rows.annotated_pairs import PairPlace, PlacedPairs, annotation_columns, gather, read_pair_points
from tasks.rows.takes import read_motion
from tasks.seeds.files import FileSeed, credits_of, read_seed
from tasks.seeds.over_time import lift_couple, places_by_couple
from tasks.seeds.parameters import ChosenSeed, FilledSeeds, FrameSeed, GrownSeeds, LiftedSeedsShard, OverTimeSeeds
from tasks.stage import Shard
from tasks.stage.committing import commit, followed
from tasks.stage.facts import SeedFacts, SequenceFacts, TakeFacts, merge_takes
from tasks.stage.streams import stream

MIN_GROWN_SHARE = 0.5
"""Share of the annotations asked for that must have grown to be no warning."""
_COPIED = ("generation", "sequence_id", "sequence_frame", "sequence_person_id")
"""Columns that a filled pair has from its first parent."""
_NUM_LOOKED_AT = 300
"""Frames of each take among which seeds are chosen: the choice compares every frame with every chosen one."""


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Read or choose one seed, lift, grow or fill in many, and commit them, gauge-fixed."""
    match shard.parameters:
        case FrameSeed() as options:
            pair = read_motion(store, shard.ref("poses"), "pair17_m")["pair17_m"][options.frame]
            return _commit_frame(shard, store, options, pair, options.take, options.frame)
        case ChosenSeed() as options:
            return _commit_frame(shard, store, options, *_choose(shard, store, options))
        case FileSeed() as options:
            return _take_in(shard, store, options)
        case LiftedSeedsShard() as options:
            return _lift(shard, store, options)
        case OverTimeSeeds() as options:
            return _lift_over_time(shard, store, options)
        case FilledSeeds() as options:
            return _fill(shard, store, options)
    return _grow(shard, store, shard.options(GrownSeeds))


def _commit_frame(
    shard: Shard, store: Store, options: FrameSeed | ChosenSeed, pair_m: np.ndarray, take_id: str, frame: int
) -> ArtifactRef:
    facts = SeedFacts(
        kind="seed",
        seed_index=options.seed_index,
        take_id=take_id,
        take_frame=frame,
        takes=_takes(shard, store),
    )
    return _commit_one(shard, store, options, pair_m, "frame", facts, take_id=[take_id], take_frame=[frame])


def _take_in(shard: Shard, store: Store, options: FileSeed) -> ArtifactRef:
    """Commit a seed that came in a file, with the lineage that the file states."""
    pair = read_seed(shard)
    origin = "draw" if pair.made_from.startswith("draws@") else "file"
    takes = tuple(sorted({*pair.takes, *_takes(shard, store)}))
    facts = SeedFacts(kind="seed", seed_index=options.seed_index, made_from=pair.made_from, takes=takes)
    return _commit_one(
        shard, store, options, pair.pair_m, origin, facts, sources=credits_of(pair), made_from=[pair.made_from or None]
    )


def _commit_one(
    shard: Shard,
    store: Store,
    options: FrameSeed | ChosenSeed | FileSeed,
    pair_m: np.ndarray,
    origin: str,
    facts: SeedFacts,
    *,
    sources: Sequence[SourceCredit] = (),
    **known: Any,
) -> ArtifactRef:
    """Commit a single seed, gauge-fixed, and judge whether chains can start from it."""
    quality = seed_quality(pair_m[None], read_limits(store, shard.refs("joint_limits")), options.part(PriorSettings))
    verdict = Verdict(Level.PASS)
    if not quality.is_possible[0]:
        reason = f"{quality.num_invalid[0]} joint angles are out of range, at most {options.max_invalid_angles} may be"
        verdict = Verdict(Level.FAIL, f"{reason}: no chain can start here")
    columns = _columns(origin, [facts.seed_index], gauge_fix(pair_m)[None], quality.log_prior, **known)
    return commit(shard, store, tables={"seeds": columns}, facts=facts, sources=sources, verdict=verdict)


def _takes(shard: Shard, store: Store) -> tuple[str, ...]:
    return merge_takes(*(store.manifest(ref) for ref in shard.all_inputs))


def _columns(
    origin: str, indices: Sequence[int] | np.ndarray, pairs_m: np.ndarray, log_prior: np.ndarray, **known: Any
) -> dict[str, Any]:
    """Return the table of seeds of one origin; unknown columns are null."""
    count = len(pairs_m)
    return {
        "seed_index": indices,
        "origin": [origin] * count,
        "generation": [0] * count,
        "log_prior": log_prior,
        "pair17_m": pairs_m,
        "filled_from": np.full((count, NUM_PARENTS), -1),
        "filled_weight": np.full((count, NUM_PARENTS), np.nan),
        **known,
    }


def _annotated(shard: Shard, store: Store) -> PlacedPairs:
    """Return the annotated pairs under their likeliest views: more hypotheses of a view did not help."""
    return gather(store, annotations=shard.refs("annotations"), views=shard.refs("views"), num_hypotheses=1)


def _places(placed: PlacedPairs, entries: np.ndarray) -> dict[str, list[Any]]:
    """Return the columns that say which annotations these entries are."""
    return annotation_columns([placed.places[at] for at in placed.gathered.pairs.annotation_index[entries].tolist()])


def _lift(shard: Shard, store: Store, options: LiftedSeedsShard) -> ArtifactRef:
    """Lift representative annotations from 2D alone."""
    placed = _annotated(shard, store)
    seeds = lift_seeds(
        placed.gathered.pairs,
        read_limits(store, shard.refs("joint_limits")),
        read_torso_basis(store, (*shard.refs("torso_basis"), *shard.refs("annotations"))),
        num_seeds=options.num_lifted,
        prior=options.part(PriorSettings),
    )
    indices = options.first_index + np.arange(len(seeds.pairs_m))
    columns = _columns("lifted", indices, seeds.pairs_m, seeds.log_prior, **_places(placed, seeds.entry))
    facts = SeedFacts(
        kind="lifted_seeds",
        starts=indices.tolist(),
        num_annotations_skipped=placed.gathered.num_skipped,
        takes=_takes(shard, store),
    )
    verdict = _share_verdict(
        len(indices),
        options.num_lifted,
        "seeds lifted of those asked for",
        thing="seeds",
        warning="near the other annotations chosen no pair keeps the joint limits",
    )
    return commit(shard, store, tables={"seeds": columns}, facts=facts, verdict=verdict)


def _lift_over_time(shard: Shard, store: Store, options: OverTimeSeeds) -> ArtifactRef:
    """Lift frames of a video together with poses of other takes; trunks and heads are those of the nearest pair."""
    ref = shard.ref("annotations")
    couples = places_by_couple(
        SequenceFacts.of(store.manifest(ref)),
        sorted(place for place, people in read_pair_points(store, [ref]).items() if len(people) == 2),
    )
    every = [place for places in couples.values() for place in places]
    wanted = {every[at] for at in evenly_spread(len(every), options.num_over_time)}
    takes = np.concatenate([read_motion(store, take, "pair17_m")["pair17_m"] for take in shard.refs("poses")])
    takes = takes[evenly_spread(len(takes), MAX_PAIRS)]
    database = cache(lambda: database_of_draws(takes, np.deg2rad(ProjectionsParameters().pitches_deg).tolist()))
    lifted_places: dict[PairPlace, tuple[np.ndarray, float]] = {}
    for places in couples.values():
        lifted_places |= lift_couple(store, ref, places, wanted, database)
    known = op14_from_working(takes, PAIR17)
    places = sorted(wanted.intersection(lifted_places))
    pairs = [
        gauge_fix(as_pair17(people, takes[nearest_rigid(known, people, count=1).draw[0]]))
        for people, _ in (lifted_places[place] for place in places)
    ]
    pairs_m = np.array(pairs).reshape(-1, 2, PAIR17.num_joints, 3)
    quality = seed_quality(pairs_m, read_limits(store, shard.refs("joint_limits")), options.part(PriorSettings))
    kept = np.flatnonzero(quality.is_possible)
    columns = _columns(
        "over_time",
        options.first_index + np.arange(len(kept)),
        pairs_m[kept],
        quality.log_prior[kept],
        **annotation_columns([places[at] for at in kept]),
    )
    facts = SeedFacts(
        kind="grown_seeds", num_grown=len(kept), num_left=len(wanted) - len(kept), takes=_takes(shard, store)
    )
    verdict = _share_verdict(
        len(kept),
        len(wanted),
        "frames lifted over time",
        thing="frames",
        warning="the frames of the video could not be lifted together, or do not keep the joint limits",
        min_share=MIN_GROWN_SHARE,
    )
    return commit(shard, store, tables={"seeds": columns}, facts=facts, verdict=verdict)


def _grow(shard: Shard, store: Store, options: GrownSeeds) -> ArtifactRef:
    """Grow pairs over the annotations from the seeds of the shards before this one."""
    before = followed(shard, store)
    tables = [store.read(manifest.ref, "seeds", columns=["seed_index", "pair17_m"]) for manifest in before]
    roots = np.concatenate([np.asarray(table["pair17_m"], dtype=np.float64) for table in tables])
    placed = _annotated(shard, store)
    limits = read_limits(store, shard.refs("joint_limits"))
    growth = grow(
        roots,
        placed.gathered.pairs,
        limits,
        num_grown=options.num_grown,
        prior=options.part(PriorSettings),
    )
    # Neighbours agree on depths after pairs are judged, so a few may leave the joint limits and cannot start a chain.
    # Starts are drawn, not spread out: the farthest pairs are those with errors (14 against 59 real frames).
    possible = stream(shard.seed, "seeds", "starts").permutation(np.flatnonzero(growth.is_possible))
    seed_indices = options.first_index + np.arange(len(growth.pairs_m))
    columns = _columns(
        "grown",
        seed_indices,
        growth.pairs_m,
        growth.log_prior,
        parent_seed_index=np.concatenate([*(table["seed_index"] for table in tables), seed_indices])[growth.parent],
        generation=growth.generation,
        image_distance_m=growth.image_distance_m,
        **_places(placed, growth.entry),
    )
    facts = SeedFacts(
        kind="grown_seeds",
        num_grown=len(growth.pairs_m),
        num_refused=growth.num_refused,
        num_left=growth.num_left,
        num_annotations_skipped=placed.gathered.num_skipped,
        starts=(options.first_index + possible[: options.num_starts]).tolist(),
        takes=merge_takes(*before, *(store.manifest(ref) for ref in shard.all_inputs)),
    )
    return commit(shard, store, tables={"seeds": columns}, facts=facts, verdict=_growth_verdict(growth, options))


def _fill(shard: Shard, store: Store, options: FilledSeeds) -> ArtifactRef:
    """Fill in pairs between the grown ones of the shards before this one."""
    before = followed(shard, store)
    tables = [store.read(manifest.ref, "seeds", columns=[*_COPIED, "seed_index", "pair17_m"]) for manifest in before]
    grown = {name: [value for table in tables for value in table[name]] for name in tables[0]}
    filling = pairs_between(
        np.asarray(grown["pair17_m"], dtype=np.float64),
        options.num_filled,
        stream(shard.seed, "seeds", "filled"),
        read_limits(store, shard.refs("joint_limits")),
        options.part(PriorSettings),
    )
    first, count = filling.parents[:, 0], len(filling.pairs_m)
    columns = _columns(
        "filled",
        options.first_index + np.arange(count),
        filling.pairs_m,
        filling.log_prior,
        filled_from=np.asarray(grown["seed_index"])[filling.parents],
        filled_weight=filling.weights,
        **{name: [grown[name][row] for row in first] for name in _COPIED},
    )
    facts = SeedFacts(
        kind="filled_seeds",
        num_grown=count,
        num_refused=filling.num_refused,
        takes=merge_takes(*before, *(store.manifest(ref) for ref in shard.all_inputs)),
    )
    verdict = _share_verdict(
        count,
        options.num_filled,
        "pairs filled in of those asked for",
        thing="pairs",
        warning="most means of grown pairs are not plausible, or like a pair that is there",
    )
    return commit(shard, store, tables={"seeds": columns}, facts=facts, verdict=verdict)


def _share_verdict(
    count: int, wanted: int, figure: str, *, thing: str, warning: str, min_share: float = 1.0
) -> Verdict:
    """Return the verdict on the share of the wanted items that were made: a warning below the smallest good share."""
    is_good = count >= min_share * wanted
    level, reason = (Level.PASS, "") if is_good else (Level.WARN, warning)
    return Verdict(level, reason, figure, 100.0 * count / max(wanted, 1), "%", count=wanted, thing=thing)


def _growth_verdict(growth: Growth, options: GrownSeeds) -> Verdict:
    """Return how many pairs grew of how many could have."""
    count = len(growth.pairs_m)
    possible = min(options.num_grown, count + growth.num_refused + growth.num_left)
    level, reason = Level.PASS, ""
    if count < MIN_GROWN_SHARE * possible:
        level = Level.WARN if count else Level.FAIL
        reason = (
            f"{count} of {possible} pairs grew: {growth.num_refused} lifted pairs broke the joint limits, and "
            f"{growth.num_left} annotations lie farther than {FARTHEST_M} m from everything lifted"
        )
    share = 100.0 * count / possible if possible else math.nan
    return Verdict(level, reason, "pairs grown of those asked for", share, "%", count=possible or 1, thing="pairs")


def _choose(shard: Shard, store: Store, options: ChosenSeed) -> tuple[np.ndarray, str, int]:
    """Return the pair, take and frame of an automatically chosen seed; the choice of earlier seeds is repeated."""
    pairs, take_of, frame_of, take_ids = [], [], [], []
    for take, ref in enumerate(shard.refs("poses")):
        facts = TakeFacts.of(store.manifest(ref))
        frames = evenly_spread(facts.num_frames, _NUM_LOOKED_AT)
        pairs.append(read_motion(store, ref, "pair17_m")["pair17_m"][frames])
        take_of.append(np.full(len(frames), take))
        frame_of.append(frames)
        take_ids.append(facts.take_id)
    every, takes = np.concatenate(pairs), np.concatenate(take_of)
    quality = seed_quality(every, read_limits(store, shard.refs("joint_limits")), options.part(PriorSettings))
    chosen = choose_seeds(every, takes, quality, options.seed_index + 1)[options.seed_index]
    return every[chosen], take_ids[int(takes[chosen])], int(np.concatenate(frame_of)[chosen])
