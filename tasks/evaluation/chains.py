"""Topic `chains`: diagnostics of the Markov chains, and pictures of some draws."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pasdedeux.cameras.frames import project_pair
from pasdedeux.completion.retrieval import nearest_images
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.pictures import Picture, pack_player, people_panel
from pasdedeux.evaluation.scores import scores_of, summarise
from pasdedeux.sampling.diagnostics import FIGURES
from pasdedeux.skeletons import PAIR17
from pasdedeux.spread import evenly_spread, some_of
from storage_schema import Manifest, Store
from tasks.evaluation.lifting_pictures import rows_figure
from tasks.evaluation.topic import Topic, TopicResult
from tasks.rows.annotated_pairs import annotated_pairs, read_all_seen, with_views
from tasks.rows.draw_sets import is_chain, knows_annotations
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import DrawFacts

_REDUCE: dict[str, Callable[[np.ndarray], np.float64]] = {"mean": np.mean, "min": np.min, "max": np.max}
_NUM_SHOWN = 50
_NUM_STATES, _NUM_NEAREST = 4, 3
"""States of a chain, and annotations beside each."""
_MAX_KNOWN = 3000
"""Annotations that draws are compared with, at most."""
_DRAWS_PER_S = 5.0
_STANDING_M = 0.95
"""Height at which the middle of a pair is drawn."""


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan a shard over the summaries of all chains, and two that show draws of a chain of each density."""
    manifests = inputs.of("chain_info")
    shown = _first_chains(list(filter(is_chain, inputs.of("draws"))))
    named = {"summary": manifests, "draws": shown}
    shards = [TOPIC.shard(inputs, name, chains=chains, first=shown) for name, chains in named.items() if chains]
    known = with_views(annotated_pairs(inputs), inputs)
    if shown and known["annotations"]:
        shards.append(TOPIC.shard(inputs, "nearest", chains=shown, **known))
    return shards


class _ShownChains(NamedTuple):
    """Input of a shard's pictures.

    Args:
        states: By density, states of its chain (state, 2, 17, 3), metres, and the reference of each.
        neighbours: By density, states in words, each with the images in its row: itself, then annotations.
    """

    states: Mapping[str, tuple[np.ndarray, Sequence[str]]] = {}
    neighbours: Mapping[str, Sequence[tuple[str, Sequence[tuple[str, np.ndarray]]]]] = {}


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownChains]:
    """Summarise the chains, or show draws."""
    return {"draws": _states, "nearest": _nearest, "summary": _summarised}[shard.name](shard, store)


def _draw(shown: _ShownChains) -> Iterator[Picture]:
    """Show a chain of each density from its seed on, as in Yin et al. 2018, figs. 6 and 7, and beside annotations."""
    for density, (states_m, labels) in shown.states.items():
        panel = people_panel(in_words(density), PAIR17, states_m + np.array([0.0, _STANDING_M, 0.0]))
        caption = (
            f"States of one chain ({in_words(density)}), starting at its seed (Yin et al. 2018, figs. 6, "
            "7). Good: the chain soon leaves its seed and comes back to similar poses; a chain that does "
            "not mix stays near its seed. Bodies may float, as chains have no floor. To continue from a "
            "draw, give its name to `pasdedeux restart`, with the name of the study in place of STUDY."
        )
        player = pack_player([panel], rate_hz=_DRAWS_PER_S, labels=labels)
        yield Picture(f"draws-{density}.player.json", caption, player)
    for density, rows in shown.neighbours.items():
        caption = (
            f"Evenly spaced states of one chain ({in_words(density)}), each seen by the camera of its "
            "nearest annotation, beside its three nearest annotations and their distances (Yin et al. "
            "2018, figs. 6, 7 and 11). Good: draws look like annotations and differ from each other."
        )
        yield Picture(f"draws-nearest-{density}.svg", caption, rows_figure(rows))


def _first_chains(draws: Sequence[Manifest]) -> list[Manifest]:
    """Return the segments of the first chain of the first seed of each density."""
    manifests = []
    facts = [(DrawFacts.of(manifest), manifest) for manifest in draws]
    for density in sorted({fact.density for fact, _ in facts}):
        first = min(fact.seed_index for fact, _ in facts if fact.density == density)
        place = (density, first, 0)
        segments = [pair for pair in facts if (pair[0].density, pair[0].seed_index, pair[0].chain) == place]
        manifests += [manifest for _, manifest in sorted(segments, key=lambda pair: pair[0].segment)]
    return manifests


def _baselines(shard: Shard, store: Store) -> set[str]:
    """Return the names of the chains that no annotation shaped."""
    first = map(store.manifest, shard.refs("first"))
    return {DrawFacts.of(manifest).density for manifest in first if not knows_annotations(manifest)}


def _read_chains(store: Store, shard: Shard) -> Iterator[tuple[str, str, np.ndarray, np.ndarray]]:
    """Yield density, partition, pairs (draw, 2, 17, 3), metres, and log priors (draw,) of each density's chain."""
    chains: dict[str, list[Manifest]] = {}
    for manifest in map(store.manifest, shard.refs("chains")):
        chains.setdefault(DrawFacts.of(manifest).density, []).append(manifest)
    for density, parts in sorted(chains.items()):
        tables = [store.read(manifest.ref, "draws", columns=["pair17_m", "log_prior"]) for manifest in parts]
        pairs, log_prior = (np.concatenate([table[name] for table in tables]) for name in ("pair17_m", "log_prior"))
        yield density, parts[-1].partition, pairs.astype(np.float64), log_prior


def _states(shard: Shard, store: Store) -> TopicResult[_ShownChains]:
    """Show states of the chain of each density; score the prior of its draws."""
    scores, states = [], {}
    for density, partition, pairs, log_prior in _read_chains(store, shard):
        at = evenly_spread(len(pairs), _NUM_SHOWN)
        # The first chain is the first in its partition.
        states[density] = pairs[at], [f"draws:STUDY/{partition}#{index}" for index in at]
        scores += summarise({density: log_prior}, "log_prior", item="first chain")
    return TopicResult(scores, baselines=_baselines(shard, store), shown=_ShownChains(states))


def _nearest(shard: Shard, store: Store) -> TopicResult[_ShownChains]:
    """Show states of a chain of each density beside the annotations most like them (Yin et al. 2018, fig. 11)."""
    seen = [pair for pairs in read_all_seen(store, shard, num_hypotheses=1) for pair in pairs.values()]
    known = some_of([pair for pair in seen if not pair.is_left_out], _MAX_KNOWN)
    if not known:
        return TopicResult()
    images, directions = np.stack([pair.image_m for pair in known]), np.stack([pair.directions[0] for pair in known])
    neighbours: dict[str, list[tuple[str, list[tuple[str, np.ndarray]]]]] = {}
    for density, _, pairs, _ in _read_chains(store, shard):
        neighbours[density] = []
        for at in evenly_spread(len(pairs), _NUM_STATES, has_ends=False):
            nearest, distance = nearest_images(pairs[at], images, directions, count=_NUM_NEAREST)
            row = [("draw", project_pair(pairs[at], directions[nearest[:1]])[0])]
            row += [(f"annotation, {100 * far:.0f} cm", images[n]) for n, far in zip(nearest, distance, strict=True)]
            neighbours[density].append((f"draw {at + 1:,}", row))
    return TopicResult(shown=_ShownChains(neighbours=neighbours))


def _summarised(shard: Shard, store: Store) -> TopicResult[_ShownChains]:
    """Summarise the chains of each density and seed."""
    scores = []
    notable: dict[str, list[str]] = {}
    totals: Counter[str] = Counter()
    for ref in shard.refs("chains"):
        table = store.read(ref, "chain_info")
        density, seed = table["density"][0], int(table["seed_index"][0])
        for name, measured in FIGURES.items():
            if measured.kind == "int" or (name == "sigma_l" and np.isnan(table[name]).all()):
                continue
            kind = name.rpartition("_")[2] if name.endswith(("_min", "_max")) else "mean"
            figure = {f"{measured.metric.removesuffix(f'_{kind}')}_{kind}": _REDUCE[kind](table[name])}
            scores += scores_of(figure, density, measured.unit, item=f"seed {seed}", count=table.num_rows)
        totals[density] += table.num_rows
        for row in np.flatnonzero(table["verdict"] != "pass"):
            reason = f"({table['verdict'][row]}, seed {seed}): {table['reason'][row]}"
            notable.setdefault(density, []).append(reason)
    notes = [
        f"{in_words(density)}: {len(reasons)} of {totals[density]} chains did not pass, for example {reasons[0]}."
        for density, reasons in notable.items()
    ]
    return TopicResult(scores, notes=notes, baselines=_baselines(shard, store))


TOPIC = Topic(
    name="chains",
    heading="Chains",
    introduction="Each chain starts at a seed and samples poses that agree with the annotations. If chains mix, the "
    "effective sample size is close to the number of draws, and chains with different starts agree (R-hat "
    "near 1). They rarely mix: modes of the density differ by about 100 nats, so each chain stays near "
    "its seed. Use sets of pairs instead, preferably repaired pairs.",
    reads=("chain_info", "draws", "annotations", "views"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    cautions=(
        (
            "draws",
            (
                "Draws come from several chains with different seeds. They are not independent samples of one "
                "distribution."
            ),
        ),
        (
            "draws",
            "The density ignores ground contact, and a single view does not show the relative depth of the two people.",
        ),
    ),
)
