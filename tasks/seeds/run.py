"""Seeds made: frames read or chosen, files taken in, annotations lifted, grown over and filled in between."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from pasdedeux.sampling.direct_lifting import lift_seeds
from pasdedeux.sampling.growth import FARTHEST_M, Growth, grow
from pasdedeux.sampling.neighbourhoods import NUM_PARENTS, fill
from pasdedeux.sampling.parameters import gauge_fix
from pasdedeux.sampling.prior import PriorSettings
from pasdedeux.sampling.seeds import choose_seeds, seed_quality
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, SourceCredit, Store
from tasks.annotated_pairs import PlacedPairs, gather
from tasks.committing import commit, followed
from tasks.facts import SeedFacts, TakeFacts, merge_takes
from tasks.priors import read_limits, read_torso_basis
from tasks.seeds.files import FileSeed, credits_of, read_seed
from tasks.seeds.parameters import ChosenSeed, FilledSeeds, FrameSeed, GrownSeeds, LiftedSeedsShard
from tasks.stage import Shard
from tasks.streams import stream
from tasks.takes import read_motion

MIN_GROWN_SHARE = 0.5
"""Share of the annotations asked for that must have grown to be no warning."""
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
    """Commit a seed that stands alone, gauge-fixed, and say whether chains can start from it."""
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
    """Return the table of seeds of one origin; what is not known of them is null."""
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
    """Return the annotated pairs under their likeliest views: more hypotheses of a view brought nothing."""
    return gather(store, annotations=shard.refs("annotations"), views=shard.refs("views"), num_hypotheses=1)


def _places(placed: PlacedPairs, entries: np.ndarray) -> dict[str, list[Any]]:
    """Return the columns that say which annotations these entries are."""
    places = [placed.places[index] for index in placed.gathered.pairs.annotation_index[entries].tolist()]
    return {
        "sequence_id": [place.sequence_id for place in places],
        "sequence_frame": [place.frame for place in places],
        "sequence_person_id": [place.person_id for place in places],
    }


def _lift(shard: Shard, store: Store, options: LiftedSeedsShard) -> ArtifactRef:
    """Lift annotations that stand for all of them from 2D alone."""
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
    is_short = len(indices) < options.num_lifted
    verdict = Verdict(
        Level.WARN if is_short else Level.PASS,
        "near the other annotations chosen no pair keeps the joint limits" if is_short else "",
        figure="seeds lifted of those asked for",
        value=100.0 * len(indices) / options.num_lifted,
        unit="%",
        count=options.num_lifted,
        thing="seeds",
    )
    return commit(shard, store, tables={"seeds": columns}, facts=facts, verdict=verdict)


def _grow(shard: Shard, store: Store, options: GrownSeeds) -> ArtifactRef:
    """Grow pairs over the annotations from the seeds of the shards before this one."""
    before = followed(shard, store)
    roots = np.concatenate(
        [np.asarray(store.read(manifest.ref, "seeds")["pair17_m"], dtype=np.float64) for manifest in before]
    )
    placed = _annotated(shard, store)
    limits = read_limits(store, shard.refs("joint_limits"))
    growth = grow(
        roots,
        placed.gathered.pairs,
        limits,
        num_grown=options.num_grown,
        prior=options.part(PriorSettings),
    )
    # Neighbours agree after the last pair was judged: a few may have left the joint limits and can start no chain.
    # Starts are drawn, not spread out: the farthest ones are those that went wrong (14 against 59 real frames).
    possible = stream(shard.seed, "seeds", "starts").permutation(np.flatnonzero(growth.is_possible))
    columns = _columns(
        "grown",
        options.first_index + np.arange(len(growth.pairs_m)),
        growth.pairs_m,
        growth.log_prior,
        parent_seed_index=growth.parent,
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
    """Fill in pairs between the grown ones of the shard before this one."""
    (before,) = followed(shard, store)
    grown = store.read(before.ref, "seeds")
    filling = fill(
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
        **{
            name: [grown[name][row] for row in first]
            for name in ("generation", "sequence_id", "sequence_frame", "sequence_person_id")
        },
    )
    facts = SeedFacts(
        kind="filled_seeds",
        num_grown=count,
        num_refused=filling.num_refused,
        takes=merge_takes(before, *(store.manifest(ref) for ref in shard.all_inputs)),
    )
    is_short = count < options.num_filled
    verdict = Verdict(
        Level.WARN if is_short else Level.PASS,
        "most means of grown pairs are not plausible, or like a pair that is there" if is_short else "",
        figure="pairs filled in of those asked for",
        value=100.0 * count / options.num_filled,
        unit="%",
        count=options.num_filled,
        thing="pairs",
    )
    return commit(shard, store, tables={"seeds": columns}, facts=facts, verdict=verdict)


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
