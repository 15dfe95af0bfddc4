"""Topic `coverage`: how well draws cover real pairs (Yin et al. 2018, eq. 13), beside real frames."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.evaluation.names import in_words, part_in_words
from pasdedeux.evaluation.pictures import (
    CLOUD,
    CurvePanel,
    Picture,
    curve_figure,
    figure_svg,
    fit_map,
    legend_beside,
    new_figure,
)
from pasdedeux.evaluation.score_tables import TextTable, format_value, pivot_table
from pasdedeux.evaluation.scores import Score, summarise
from pasdedeux.evaluation.styles import method_style
from pasdedeux.interaction.coverage import CoverageCurve, DrawPart, coverage_curve, curve_of_parts, draw_parts
from pasdedeux.interaction.nearest import PairTable, cartesian_distances, pair_table
from pasdedeux.interaction.pair_map import PairMap
from pasdedeux.spread import evenly_spread
from storage_schema import ArtifactRef, Manifest, Store
from tasks.evaluation.ground_truth import GroundTruth
from tasks.evaluation.topic import Topic, TopicResult, refuse_learned
from tasks.rows.draw_sets import GROWN, DrawSet, baselines_of, draw_manifests, is_chain, read_draw_sets
from tasks.rows.takes import takes_of
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import DrawFacts, SeedFacts, SequenceFacts, TakeFacts
from tasks.stage.kept import kept
from tasks.stage.streams import stream

SPLITS = ("annotated", "unannotated", "held_out")
_MEASURES = {
    "D_I": ("interaction_m", "m", "by interaction"),
    "D_C": ("cartesian_m", "m", "joint by joint"),
    "D_S": ("shape", "", "by shape"),
}
"""Measures of coverage: their field in a curve, their unit, and their words."""
_REAL = "real_frames"
_REAL_COUNTS = (1, 3, 10, 30, 100, 300, 1000)
"""Sizes of the sets of real frames (the counts of the published scale)."""
_MAX_DRAWS, _MAX_REAL = 200, 1500
"""Draws and real pairs whose distances are compared for realism, at most."""
_NUM_MAPPED = 150
"""Real pairs on the map."""
_MAPPED_SHARES = (0.01, 0.1, 1.0)
"""Shares of the draws on its panels: of 100,000 these are the published 1,000, 10,000 and 100,000."""
_MAX_DOTS = 400
_MANY_SEEDS = 5
_FIRST_SEED = "_first_seed"
_MAX_KEPT = 5000
"""Draws that a worker keeps ready from shard to shard, at most: 60 MB."""
_EXPLORATION = {
    "num_draws": "draws",
    "coverage_D_C": "coverage",
    "as_good_as_real_frames_D_C": "equivalent real frames",
    "draw_to_nearest_real_D_C_median": "draw to nearest real, median",
    "acceptance_rate_mean": "accepted",
    "travelled_mean": "travelled",
    "ess_min": "smallest ESS",
}
"""Scores of coverage and of chains that compare methods of exploration at a glance."""
NUM_CURVE_POINTS = 12
"""Points of the coverage curve."""


class CoverageSettings(Parameters):
    """How finely coverage is measured."""

    num_truth_pairs: int = Field(300, ge=1, description="Most real pairs of each part on which coverage is measured")


class CoverageParameters(CoverageSettings):
    """One part of the real frames."""

    split: str


def _plan(inputs: StageInputs, settings: CoverageSettings) -> list[Shard]:
    """Plan one shard per part of the real frames, over the draws of every density and the grown pairs."""
    draws = draw_manifests(inputs)
    takes = takes_of(inputs, 2)
    annotations = [
        manifest for manifest in inputs.of("annotations") if SequenceFacts.of(manifest).purpose == "random_views"
    ]
    if not draws or not takes:
        return []
    seeds = [seed for seed in inputs.of("seeds") if SeedFacts.of(seed).kind != GROWN]
    named: dict[str, Sequence[Manifest]] = {"takes": takes, "annotations": annotations, "draws": draws}
    named["first_seed"] = seeds[:1]
    has_held_out = any(TakeFacts.of(take).is_held_out for take in takes)
    return [
        TOPIC.shard(inputs, split, settings.part(CoverageParameters, split=split), **named)
        for split in SPLITS
        if split != "held_out" or has_held_out
    ]


class _Dots(NamedTuple):
    """Draws of a set on the map: the prepared draws of all panels, and the rows of each panel."""

    table: PairTable
    of_panel: dict[int, npt.NDArray[np.intp]]


class _ShownCoverage(NamedTuple):
    """Input of the pictures of a part of the real frames, in `words`: curves, real pairs, draws, and the first seed."""

    split: str
    words: str
    curves: Mapping[str, CoverageCurve]
    levels: CoverageCurve
    truth_m: Array
    dots: Mapping[str, _Dots]
    seed_m: Array | None
    baselines: Collection[str]


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownCoverage]:
    """Measure coverage on one part of the real frames."""
    options = shard.options(CoverageParameters)
    split, draw_refs = options.split, shard.refs("draws")
    known = GroundTruth.read(store, shard.refs("takes"), ())
    refuse_learned(store, draw_refs, known.held_out)
    learned = sorted(take.take_id for take in TakeFacts.read(store, shard.refs("takes")) if take.is_prior)
    notes = (
        [f"Coverage is not measured on {', '.join(learned)}, because the priors were learned from these takes."]
        if learned
        else []
    )
    takes = {name: pairs for name, pairs in known.takes.items() if name not in learned}
    truth, others = _split(takes, _annotated_frames(store, shard), known.held_out, split)
    words = split.replace("_", "-")
    if not len(truth) or not len(others):
        return TopicResult(notes=[*notes, f"Coverage of {words} frames is not measured: there are no such frames."])
    generator = stream(shard.seed, TOPIC.name, split)
    truth = truth[generator.permutation(len(truth))[: options.num_truth_pairs]]
    draws, parts, dots, baselines = _ready_draws(store, draw_refs)
    compared = {name: pairs[generator.permutation(len(pairs))[:_MAX_DRAWS]] for name, pairs in draws.items()}
    curves = {name: curve_of_parts(truth, parts.get(name) or _parts(pairs)) for name, pairs in draws.items()}
    levels = real_frame_levels(truth, others, generator)
    scores = coverage_scores(curves, levels, split=split)
    scores += realism_scores(compared, np.concatenate([truth, others]), generator, split=split)
    shown = _ShownCoverage(
        split, words, curves, levels, truth, dots, _first_seed(store, shard.refs("first_seed")), baselines
    )
    return TopicResult(scores, notes, baselines=(*baselines, _REAL), shown=shown)


def _draw(shown: _ShownCoverage) -> Iterator[Picture]:
    """Draw coverage against the number of draws, and a map of real pairs and draws unless the pairs are all alike."""
    caption = (
        f"Distance from {shown.words} real pairs to their nearest draw, by number of draws (Yin et al. "
        "2018, fig. 9). Good: low. Dashed: baselines. Grey: the same number of real pairs in place of "
        "draws. By interaction: measured by distances between the joints of both people."
    )
    yield Picture(
        f"coverage-{shown.split}.svg",
        caption,
        coverage_figure(shown.curves, shown.levels, shown.words, shown.baselines),
    )
    try:
        plane = PairMap.of(shown.truth_m[:_NUM_MAPPED])
    except InputError:
        return
    panels: dict[str, dict[str, Array]] = {}
    for name, dots in shown.dots.items():
        places = plane.place(dots.table)
        for count, rows in dots.of_panel.items():
            panels.setdefault(f"{count:,} draws of each", {})[name] = places[rows]
    seed = None if shown.seed_m is None else plane.place(shown.seed_m)[0]
    title = f"{shown.words} frames and draws ({plane.share:.0%} of the spread shown)"
    caption = (
        f"A map of {shown.words} real pairs and draws, at most 400 dots of each; the number of draws grows "
        "from left to right (Yin et al. 2018, fig. 8). Similar pairs are close together; axes are in "
        "centimetres; the cross is the first seed. Good: draws lie where real pairs lie, and nowhere "
        "else."
    )
    yield Picture(f"coverage-map-{shown.split}.svg", caption, map_figure(plane.places, panels, seed=seed, title=title))


@kept()
def _ready_draws(
    store: Store, refs: tuple[ArtifactRef, ...]
) -> tuple[dict[str, np.ndarray], dict[str, tuple[DrawPart, ...]], dict[str, _Dots], list[str]]:
    """Return all sets of draws, prepared for all shards of a worker if they are few enough, dots, and baselines."""
    drawn, first = read_draw_sets(store, refs), draws_from_first_seeds(store, refs)
    in_order = {name: pairs.in_order for name, pairs in drawn.items()}
    most = max(map(len, in_order.values()), default=0)
    counts = sorted({max(1, round(share * most)) for share in _MAPPED_SHARES})
    draws = in_order | {name: pairs.in_order for name, pairs in first.items()}
    is_kept = sum(map(len, draws.values())) <= _MAX_KEPT
    parts = {name: tuple(_parts(pairs)) for name, pairs in draws.items() if is_kept}
    return draws, parts, {name: _dots(pairs, counts) for name, pairs in in_order.items()}, baselines_of(drawn | first)


def _dots(pairs_m: np.ndarray, counts: Sequence[int]) -> _Dots:
    rows = {count: evenly_spread(min(len(pairs_m), count), _MAX_DOTS) for count in counts}
    every = np.unique(np.concatenate(list(rows.values())))
    table = pair_table(pairs_m[every].astype(np.float64))
    return _Dots(table, {count: np.searchsorted(every, chosen) for count, chosen in rows.items()})


def _parts(pairs_m: np.ndarray) -> Iterator[DrawPart]:
    return draw_parts(pairs_m, curve_points(len(pairs_m), NUM_CURVE_POINTS))


def _annotated_frames(store: Store, shard: Shard) -> set[tuple[str, int]]:
    """Return take and frame of every annotation."""
    annotated: set[tuple[str, int]] = set()
    for ref in shard.refs("annotations"):
        table = store.read(ref, "annotations", columns=["is_key", "take_id", "take_frame"])
        is_key = np.asarray(table["is_key"], dtype=bool)
        frames = table["take_frame"][is_key].astype(int).tolist()
        annotated.update(zip(table["take_id"][is_key].tolist(), frames, strict=True))
    return annotated


def _split(
    takes: Mapping[str, Array], annotated: set[tuple[str, int]], held_out: frozenset[str], split: str
) -> tuple[Array, Array]:
    """Return the real pairs of the part, and the other real pairs of takes that are not held out."""
    wanted, others = [np.zeros((0, 2, 17, 3))], [np.zeros((0, 2, 17, 3))]
    for take_id, pairs in takes.items():
        is_annotated = np.array([(take_id, frame) in annotated for frame in range(len(pairs))], dtype=bool)
        is_held_out = np.full(len(pairs), take_id in held_out)
        part = {"annotated": is_annotated & ~is_held_out, "unannotated": ~is_annotated & ~is_held_out}
        is_chosen = part.get(split, is_held_out)
        wanted.append(pairs[is_chosen])
        others.append(pairs[~is_chosen & ~is_held_out])
    return np.concatenate(wanted), np.concatenate(others)


def draws_from_first_seeds(store: Store, refs: Sequence[ArtifactRef]) -> dict[str, DrawSet]:
    """Return the draws from the first seed alone of each density that has many others: how far chains walk."""
    facts = {ref: DrawFacts.of(manifest) for ref in refs if is_chain(manifest := store.manifest(ref))}
    seeds: dict[str, set[int]] = {}
    for fact in facts.values():
        seeds.setdefault(fact.density, set()).add(fact.seed_index)
    first = {name: min(indices) for name, indices in seeds.items() if len(indices) >= _MANY_SEEDS}
    first_refs = tuple(ref for ref, fact in facts.items() if first.get(fact.density) == fact.seed_index)
    return {f"{name}{_FIRST_SEED}": drawn for name, drawn in read_draw_sets(store, first_refs).items()}


def curve_points(num_draws: int, num_points: int) -> list[int]:
    """Return the numbers of draws at which coverage is measured: even on a log scale from 1 to all."""
    return sorted({round(float(n)) for n in np.geomspace(1, max(num_draws, 1), num_points)})


def real_frame_levels(truth_m: Array, real_m: Array, generator: np.random.Generator) -> CoverageCurve:
    """Return the coverage of real pairs (truth, 2, joint, 3) by growing random sets of others (frame, 2, joint, 3)."""
    order = generator.permutation(len(real_m))[: _REAL_COUNTS[-1]]
    return coverage_curve(truth_m, real_m[order], [count for count in _REAL_COUNTS if count <= len(order)])


def as_good_as_real_frames(coverage: float, levels: Array, counts: npt.NDArray[np.int64]) -> float:
    """Return N so that N real frames cover as well, by log-linear interpolation.

    Args:
        coverage: C(G, S) of the draws.
        levels: C(G, S) of `counts` real frames, (n,), in the same measure.
        counts: Numbers of real frames, rising, (n,).

    0 when even one real frame covers better, and the greatest count when none does.
    """
    if coverage > levels[0]:
        return 0.0
    return float(np.exp(np.interp(-coverage, -np.minimum.accumulate(levels), np.log(counts.astype(np.float64)))))


def coverage_scores(curves: Mapping[str, CoverageCurve], levels: CoverageCurve, *, split: str) -> list[Score]:
    """Return the curves and their ends as scores, and those of real frames."""
    scores = []
    for method, curve in {**curves, _REAL: levels}.items():
        for measure, (name, unit, _) in _MEASURES.items():
            values = getattr(curve, name).tolist()
            points = zip([*curve.num_draws.tolist(), math.nan], [*values, values[-1]], strict=True)
            count = len(levels.min_cartesian_m)
            scores += [
                Score(f"coverage_{measure}", method, value, unit, split=split, at=at, count=count)
                for at, value in points
            ]
            if method != _REAL:
                worth = as_good_as_real_frames(values[-1], getattr(levels, name), levels.num_draws)
                scores.append(Score(f"as_good_as_real_frames_{measure}", method, worth, "frames", split=split))
        if method != _REAL:
            scores.append(Score("num_draws", method, float(curve.num_draws[-1]), split=split))
    return scores


def realism_scores(
    draws: Mapping[str, npt.NDArray[np.floating]], real_m: Array, generator: np.random.Generator, *, split: str
) -> list[Score]:
    """Return how far draws (draw, 2, 17, 3) are from their nearest real pair, in D_C: the other direction of coverage.

    Compared are the first draws of each method and some real pairs (n, 2, 17, 3), metres, which the generator chooses.
    """
    real = real_m[generator.permutation(len(real_m))[:_MAX_REAL]]
    some = [np.asarray(pairs[:_MAX_DRAWS], dtype=np.float64) for pairs in draws.values()]
    distances = {name: cartesian_distances(pairs, real).min(axis=1) for name, pairs in zip(draws, some, strict=True)}
    return summarise(distances, "draw_to_nearest_real_D_C", "m", split=split)


def coverage_figure(
    curves: Mapping[str, CoverageCurve], levels: CoverageCurve, words: str, baselines: Collection[str] = ()
) -> bytes:
    """Draw coverage in D_I, D_C and D_S against the number of draws (Yin et al. 2018, fig. 9), beside real frames."""
    panels, at = [], {method: curve.num_draws.astype(np.float64) for method, curve in curves.items()}
    for name, unit, words_of_measure in _MEASURES.values():
        factor, end = (100.0, " (cm)") if unit == "m" else (1.0, "")
        real = zip(levels.num_draws.tolist(), factor * getattr(levels, name), strict=True)
        lines = {method: (at[method], factor * getattr(curve, name)) for method, curve in curves.items()}
        levels_of = {f"{count} real": float(value) for count, value in real}
        panels.append(CurvePanel(f"to the nearest draw, {words_of_measure}{end}", lines, baselines, levels_of))
    return curve_figure(panels, title=f"coverage of {words} frames", x_label="draws", is_log=True)


def _first_seed(store: Store, refs: Sequence[ArtifactRef]) -> Array | None:
    """Return the first seed (1, 2, 17, 3)."""
    pairs = [np.asarray(store.read(ref, "seeds", columns=["pair17_m"])["pair17_m"], dtype=np.float64) for ref in refs]
    return pairs[0][:1] if pairs else None


def map_figure(real: Array, panels: Mapping[str, Mapping[str, Array]], *, seed: Array | None, title: str) -> bytes:
    """Draw sets of draws over the real pairs, a panel for each; give SVG bytes.

    Args:
        real: Places of the real pairs (n, 2).
        panels: For each panel, by its title, the places of sets of draws by their name.
        seed: Place of the seed (2,), drawn as a cross; none where it is not known.
        title: Title of the picture.
    """
    columns = max(len(panels), 1)
    figure, ((*axes,),) = new_figure(2.9 * columns + 1.4, 2.9, columns=columns, has_common_axes=True)
    for axis, (name, sets) in zip(axes, panels.items(), strict=False):
        axis.scatter(*(100 * real.T), s=5, color="#9aa3b0", label="real", zorder=3, **CLOUD)
        for method, places in sets.items():
            colour, marker = method_style(method)
            axis.scatter(*(100 * places.T), s=7, color=colour, marker=marker, label=in_words(method), **CLOUD)
        if seed is not None:
            axis.plot(*(100 * seed), "kx", markersize=7, zorder=4)
        axis.set_title(name, fontsize=8)
        axis.tick_params(labelsize=6)
        fit_map(figure, axis, scale=2.4, limits=(1.8, 4.5))
    legend_beside(axes[-1])
    return figure_svg(figure, title=title)


def exploration_table(coverage: Sequence[Score], chains: Sequence[Score]) -> list[TextTable]:
    """Lay out a row for each method that was scored in both topics or grew, best coverage of the hardest part first.

    Coverage is over held-out frames where there are any, else over unannotated ones; figures of chains are means over
    seeds.  No table where chains were not scored, or nothing was covered.
    """
    single = [score for score in coverage if np.isnan(score.at)]
    split = next((part for part in SPLITS[::-1] if any(score.split == part for score in single)), None)
    if split is None or not chains:
        return []
    part = [score for score in single if score.split == split]
    drawn = {score.method for score in part if score.metric == "num_draws"}
    covered = {score.method: score.value for score in part if score.metric == "coverage_D_C" and score.method in drawn}
    known = [score for score in (*part, *chains) if score.method in covered and np.isfinite(score.value)]
    known.sort(key=lambda score: covered[score.method])
    return [
        pivot_table(
            known,
            f"Methods of exploration: {part_in_words(split)}",
            ("draws of",),
            lambda score: (in_words(score.method),),
            _EXPLORATION,
            lambda score: score.metric,
            lambda in_cell: format_value(float(np.mean([score.value for score in in_cell])), in_cell[0].unit),
        )
    ]


TOPIC = Topic(
    name="coverage",
    heading="Coverage",
    introduction="Do draws reach captured poses? Measured is the distance from real pairs to their nearest draw. The "
    "baseline is chains of the prior alone; the bound is real pairs in place of draws.",
    reads=("poses", "annotations", "draws", "seeds"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    tabulate=lambda scores: exploration_table(scores.get("coverage", ()), scores.get("chains", ())),
    settings=CoverageSettings,
)
