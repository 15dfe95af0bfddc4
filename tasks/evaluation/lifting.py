"""Topic `lifting`: lifted pairs, completed joints and in-betweens against the ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress, groupby
from typing import NamedTuple, TypeVar

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.completion.errors import completion_errors, in_between_errors, lifted_errors
from pasdedeux.completion.retrieval import nearest_by_image, nearest_images
from pasdedeux.evaluation.pictures import Picture
from pasdedeux.evaluation.scores import Score, scores_of, summarise
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.sampling.bandwidth import SAME_MOMENT
from pasdedeux.skeletons import PAIR17
from pasdedeux.spread import evenly_spread, some_of
from storage_schema import ArtifactRef, Store, TableData
from tasks.evaluation.ground_truth import GroundTruth, TruePair
from tasks.evaluation.lifting_pictures import expected_figure, lifted_player, rows_figure
from tasks.evaluation.topic import Topic, TopicResult, refuse_learned, refuse_overlap
from tasks.rows.annotated_pairs import (
    PLACE_COLUMNS,
    PairPlace,
    SeenPair,
    annotated_pairs,
    place_of,
    read_all_seen,
    with_views,
)
from tasks.rows.draw_sets import GROWN, draw_manifests, knows_annotations, read_all_draws, read_draw_sets
from tasks.rows.lifted_rows import EXPECTED
from tasks.rows.products import BASELINES
from tasks.rows.takes import takes_of
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import LiftedFacts, SequenceFacts
from tasks.stage.streams import stream

_BASELINES = (*BASELINES["lifted_pairs"], *BASELINES["in_betweens"], "nearest_draw")
_COMPLETED, _BETWEEN, _BETWEEN_LIFTED = "completed joints", "frames between", "frames between lifted pairs"
"""Results judged besides the lifted pairs."""
_GAPS = (10, 20, 30)
"""Frames between the ends of spans that are filled in."""
_SHOWN = ("lifting", "lifting_ik", "naive_sampling", "nearest_draw", "fitted", "over_time")
_NUM_EXAMPLES = 6
_NUM_NEAREST, _NUM_NEAREST_SHOWN = 3, 5
"""Annotations and draws most like a lifted pair, and how many pairs are shown with them."""
_NUM_HYPOTHESES = 4
_MAX_KNOWN = 600
_MAX_DRAWS = 20_000
"""Draws of chains that joints are completed from, at most; grown pairs are all used."""

K = TypeVar("K", str, tuple[str, str])


class LiftedPairsSettings(Parameters):
    """Settings of the completion of joints and frames that is scored."""

    num_completed_pairs: int = Field(
        12, ge=0, description="Real pairs of each part in which joints are hidden and completed from draws; 0: none"
    )


class _ShownLifting(NamedTuple):
    """Input of a shard's pictures.

    Args:
        expected_m: By part, expected errors with their interval (n, 3) and true errors (n,), metres.
        examples: By part, some annotations' pairs (2, 17, 3) by method, the truth first.
        neighbours: Lifted pairs in words, each with the images, draws and annotations in its row.
    """

    expected_m: Mapping[str, tuple[Array, Array]] = {}
    examples: Mapping[str, Sequence[Mapping[str, Array]]] = {}
    neighbours: Sequence[tuple[str, Sequence[tuple[str, Array]]]] = ()


def _plan(inputs: StageInputs, settings: LiftedPairsSettings) -> list[Shard]:
    """Plan a shard over all lifted pairs, one that shows some, two over real pairs with joints or frames hidden."""
    lifted = list(inputs.of("lifted_pairs"))
    takes = takes_of(inputs, 2, or_more=True)
    known = {ref for manifest in lifted for ref in manifest.inputs}
    annotations = [manifest for manifest in inputs.of("annotations") if manifest.ref in known]
    draws = [manifest for manifest in draw_manifests(inputs) if knows_annotations(manifest)]
    shown = with_views(annotations, inputs)["annotations"]
    learned = with_views(annotated_pairs(inputs), inputs)["annotations"]
    virtual = [manifest for manifest in annotations if SequenceFacts.of(manifest).is_virtual]
    shards = []
    if shown and draws and learned:
        every = with_views([*shown, *(manifest for manifest in learned if manifest not in shown)], inputs)
        shards.append(TOPIC.shard(inputs, "nearest", lifted=lifted, known=learned, draws=draws, **every))
    if lifted and takes and virtual:
        shards.append(TOPIC.shard(inputs, "lifted", takes=takes, annotations=virtual, lifted=lifted))
    if settings.num_completed_pairs and draws and (couples := takes_of(inputs, 2)):
        options = settings.part(LiftedPairsSettings)
        shards += [TOPIC.shard(inputs, name, options, takes=couples, draws=draws) for name in ("completed", "between")]
    return shards


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownLifting]:
    """Compute one of the four kinds of shards."""
    kinds = {"lifted": _lifted, "nearest": _nearest, "completed": _completed, "between": _between}
    return kinds[shard.name](shard, store)


def _draw(shown: _ShownLifting) -> Iterator[Picture]:
    """Draw expected errors over true ones, examples of each part, and lifted pairs beside the most similar ones."""
    if shown.expected_m:
        caption = (
            "Expected error of each lifted pair, estimated without ground truth, against its true error. "
            "Good: dots follow the line, and four of five lie in the grey band."
        )
        yield Picture("expected-error.svg", caption, expected_figure(shown.expected_m))
    for split, examples in shown.examples.items():
        caption = (
            f"{split.replace('_', '-').capitalize()} frames: ground truth and lifted pairs, seen by the "
            "camera. Turn them to see the depth. Good: they agree from the side too."
        )
        yield Picture(f"lifted-{split}.player.json", caption, lifted_player(examples))
    if shown.neighbours:
        caption = (
            "Lifted pairs with their expected joint error and its 80 % interval (Yin et al. 2018, fig. "
            "11). Beside each pair are its nearest annotations and draws with their distances: "
            "annotations are compared with the pair seen by their cameras, draws with the image of the "
            "pair. Annotations of the same moment are excluded; the nearest draw may have been lifted "
            "from the same image. Good: all look alike. Distant neighbours mean that nothing similar is "
            "known."
        )
        yield Picture("nearest.svg", caption, rows_figure(shown.neighbours))


def _lifted(shard: Shard, store: Store) -> TopicResult[_ShownLifting]:
    """Score lifted pairs, frames between them and their expected errors; show some of each part."""
    truth = GroundTruth.read(store, shard.refs("takes"), shard.refs("annotations"))
    rows = [row for ref in shard.refs("lifted") for row in _read_lifted(store, ref, truth)]
    tables = {table for ref in shard.refs("lifted") for table in store.manifest(ref).tables}
    scores: list[Score] = []
    items: dict[str, Items] = {}
    for table, name in (("lifted_pairs", ""), ("in_betweens", _BETWEEN_LIFTED)):
        of_table = [row for row in rows if row.table == table]
        if table in tables:
            items[name] = Items.joined([_items(same) for same in _by_place(of_table, "held_out").values()])
        for (split, method), same in _grouped(of_table, lambda row: (row.split, row.method)).items():
            errors = lifted_errors(np.stack([row.pair_m for row in same]), np.stack([row.true_m for row in same]))
            if table == "lifted_pairs":
                for metric, values in errors.items():
                    scores += summarise({method: values}, metric, "m", split=split)
            else:
                mean = {"in_between_lifted_error_mean": float(np.mean(errors["lifted_pair_error"]))}
                scores += scores_of(mean, method, "m", split=split, count=len(same))
    lifted = [row for row in rows if row.table == "lifted_pairs"]
    expected_m, examples = {}, {}
    for split, same in _grouped([row for row in lifted if row.expected_m], lambda row: row.split).items():
        expected_m[split] = np.array([row.expected_m for row in same]), np.array([row.error_m for row in same])
        scores += calibration_scores(*expected_m[split], split=split)
    for split in sorted({row.split for row in lifted}):
        places = [same for _, same in sorted(_by_place(lifted, split).items())]
        examples[split] = [
            {"truth": same[0].true_m, **{name: pair_by_method[name] for name in _SHOWN if name in pair_by_method}}
            for same in some_of(places, _NUM_EXAMPLES, has_ends=False)
            for pair_by_method in [{row.method: row.pair_m for row in same}]
        ]
    return TopicResult(scores, items=items, baselines=_BASELINES, shown=_ShownLifting(expected_m, examples))


@dataclass(frozen=True)
class _LiftedRow:
    """A row of `lifted_pairs` or `in_betweens` with its ground truth, pairs (2, 17, 3) in camera axes, metres."""

    table: str
    place: PairPlace
    split: str
    method: str
    pair_m: Array
    true_m: Array
    expected_m: list[float] | None
    truth: TruePair

    @property
    def error_m(self) -> float:
        """Its error, distance and depth of the two people included."""
        return float(lifted_errors(self.pair_m[None], self.true_m[None])["lifted_pair_error"][0])


def _read_lifted(store: Store, ref: ArtifactRef, truth: GroundTruth) -> list[_LiftedRow]:
    """Return the rows whose ground truth is known."""
    manifest, lifted_rows = store.manifest(ref), []
    facts = LiftedFacts.of(manifest)
    if facts.is_held_out:
        refuse_overlap(f"artifact {manifest.partition}", facts.learned_takes, truth.held_out)
    for name in ("lifted_pairs", "in_betweens"):
        if name not in manifest.tables:
            continue
        also = EXPECTED if name == "lifted_pairs" else ()
        table = store.read(ref, name, columns=[*PLACE_COLUMNS, "method", "pair17_m", *also])
        for row in range(table.num_rows):
            place = place_of(table, row)
            true = truth.pair(place)
            if true is None or place.sequence_id not in truth.cameras:
                continue
            learned = "annotated" if facts.purpose == "random_views" else "unannotated"
            lifted_rows.append(
                _LiftedRow(
                    table=name,
                    place=place,
                    split="held_out" if true.take_id in truth.held_out else learned,
                    method="nearest_draw" if table["method"][row] == "nearest" else str(table["method"][row]),
                    pair_m=np.asarray(table["pair17_m"][row], dtype=np.float64),
                    true_m=true.pair_m @ truth.cameras[place.sequence_id].camera_from_world_rotmat.T,
                    expected_m=_expected(table, row) if also else None,
                    truth=true,
                )
            )
    return lifted_rows


def _grouped(rows: Iterable[_LiftedRow], key: Callable[[_LiftedRow], K]) -> dict[K, list[_LiftedRow]]:
    """Return rows by key, sorted."""
    return {name: list(same) for name, same in groupby(sorted(rows, key=key), key)}


def _by_place(rows: Sequence[_LiftedRow], split: str) -> dict[PairPlace, list[_LiftedRow]]:
    """Return the rows of a part by annotation."""
    by_place: dict[PairPlace, list[_LiftedRow]] = {}
    for row in rows:
        if row.split == split:
            by_place.setdefault(row.place, []).append(row)
    return by_place


def _items(rows: Sequence[_LiftedRow]) -> Items:
    """Return the errors of one annotation by method."""
    return Items({row.method: np.array([row.error_m]) for row in rows}, [rows[0].truth.take_id], [rows[0].truth.time_s])


def calibration_scores(expected_m: Array, errors_m: Array, *, split: str) -> list[Score]:
    """Score expected errors (n, 3) with the ends of their intervals, metres, against true ones (n,), metres."""
    value, low, high = expected_m.T
    figures = {"expected_interval_share": float(((low <= errors_m) & (errors_m <= high)).mean())}
    if len(value) > 2 and np.ptp(value) > 0.0 and np.ptp(errors_m) > 0.0:
        figures["expected_correlation"] = float(np.corrcoef(value, errors_m)[0, 1])
    return scores_of(figures, "fitted", split=split, count=len(value))


def _nearest(shard: Shard, store: Store) -> TopicResult[_ShownLifting]:
    """Show some lifted pairs, each with the annotations and draws most like it (Yin et al. 2018, fig. 11)."""
    index = DrawIndex(read_all_draws(store, shard.refs("draws")).pairs_m)
    every = read_all_seen(store, shard, num_hypotheses=_NUM_HYPOTHESES)
    seen = {place: pair for pairs in every for place, pair in pairs.items()}
    is_known = [ref in shard.refs("known") for ref in shard.refs("annotations")]
    learned = [pair for pairs in compress(every, is_known) for pair in pairs.values() if not pair.is_left_out]
    known = some_of(learned, _MAX_KNOWN)
    pairs: dict[PairPlace, tuple[Array, list[float]]] = {}
    scores: list[Score] = []
    for ref in shard.refs("lifted"):
        table = store.read(ref, "lifted_pairs", columns=[*PLACE_COLUMNS, "pair17_m", *EXPECTED])
        errors: list[float] = []
        for row in range(table.num_rows):
            if (expected := _expected(table, row)) is not None:
                errors.append(expected[0])
                if (place := place_of(table, row)) in seen:
                    pairs[place] = np.asarray(table["pair17_m"][row], dtype=np.float64), expected
        item = f"{store.manifest(ref).partition} {store.manifest(ref).name}".replace("_", " ")
        scores += summarise({"fitted": np.array(errors)}, "expected_error", "m", item=item)
    neighbours = [
        (_label(place, expected), _row(seen[place], pair_m, known, index))
        for place, (pair_m, expected) in some_of(list(pairs.items()), _NUM_NEAREST_SHOWN, has_ends=False)
    ]
    return TopicResult(scores, shown=_ShownLifting(neighbours=neighbours))


def _expected(table: TableData, row: int) -> list[float] | None:
    """Return the expected error and the ends of its interval, metres; None of a method that has none."""
    expected = [float(table[name][row]) for name in EXPECTED]
    return None if math.isnan(expected[0]) else expected


def _label(place: PairPlace, expected_m: Sequence[float]) -> str:
    value, low, high = (100.0 * value for value in expected_m)
    return f"{place.sequence_id}, frame {place.frame}: expected error {value:.0f} cm, {low:.0f} to {high:.0f}"


def _row(seen: SeenPair, pair_m: Array, known: Sequence[SeenPair], index: DrawIndex) -> list[tuple[str, Array]]:
    """Return a lifted pair's image, itself, its nearest annotations and draws (2, 17, 2), each with its words."""
    # Seen from its left, so that the camera is on the right.
    row = [("image", seen.image_m), ("lifted", pair_m[..., :2]), ("from the side", pair_m[..., [2, 1]])]
    others = [
        other
        for other in known
        if other.place.sequence_id != seen.place.sequence_id or abs(other.place.frame - seen.place.frame) >= SAME_MOMENT
    ]
    if others:
        images, views = np.stack([other.image_m for other in others]), np.stack([o.directions[0] for o in others])
        nearest, distance = nearest_images(pair_m, images, views, count=_NUM_NEAREST)
        row += [(f"annotation, {100 * far:.0f} cm", images[at]) for at, far in zip(nearest, distance, strict=True)]
    draws, distance = nearest_by_image(index, seen.image_m, seen.directions, count=_NUM_NEAREST)
    return row + [(f"draw, {100 * far:.0f} cm", pair[..., :2]) for pair, far in zip(draws, distance, strict=True)]


def _completed(shard: Shard, store: Store) -> TopicResult[_ShownLifting]:
    """Hide joints of real pairs, and score their completion."""
    truth, pool, generator = _truth_and_pool(shard, store)
    scores: list[Score] = []
    judged: list[Items] = []
    for split, takes in _learned_and_held_out(truth):
        places = _spread_places(takes, shard.options(LiftedPairsSettings).num_completed_pairs, 0)
        if not places:
            continue
        completed = completion_errors(generator, np.stack([takes[take][frame] for take, frame in places]), pool)
        for part, errors in completed.items():
            scores += summarise(errors, "occluded_joint_error", "m", split=split, item=part)
            judged += _held_out(split, Items(errors, *truth.where(places)))
    notes = [f"Hidden joints were completed from {len(pool):,} draws and grown pairs."]
    return TopicResult(scores, notes, {_COMPLETED: Items.joined(judged)}, _BASELINES)


def _between(shard: Shard, store: Store) -> TopicResult[_ShownLifting]:
    """Hide frames of takes, and score their completion."""
    truth, pool, _ = _truth_and_pool(shard, store)
    learned = [take for name, take in truth.takes.items() if name not in truth.held_out]
    real = np.concatenate([pool[:0], *learned]).astype(np.float32)
    real = real[evenly_spread(len(real), len(pool))]
    scores: list[Score] = []
    judged: list[Items] = []
    for split, takes in _learned_and_held_out(truth):
        count = max(shard.options(LiftedPairsSettings).num_completed_pairs, len(_GAPS))
        every = _spread_places(takes, count, max(_GAPS))
        for number, gap in enumerate(_GAPS):
            starts = every[number :: len(_GAPS)]
            if not starts:
                continue
            spans = [takes[take][frame : frame + gap + 1] for take, frame in starts]
            filled = in_between_errors(spans, pool)
            if split == "held_out" and len(real):
                filled["real_frames"] = in_between_errors(spans, real)["draws"]
            means = {method: np.array([span.mean() for span in errors_of]) for method, errors_of in filled.items()}
            scores += summarise(means, "in_between_error", "m", split=split, item=f"{gap} frames")
            between = truth.where([(take, frame + more) for take, frame in starts for more in range(1, gap)])
            errors = {method: np.concatenate(errors_of) for method, errors_of in filled.items()}
            judged += _held_out(split, Items(errors, *between))
    return TopicResult(scores, items={_BETWEEN: Items.joined(judged)}, baselines=_BASELINES)


def _truth_and_pool(shard: Shard, store: Store) -> tuple[GroundTruth, np.ndarray, np.random.Generator]:
    """Return real pairs, the draws used for completion, and the generator that chose them."""
    truth = GroundTruth.read(store, shard.refs("takes"), ())
    refuse_learned(store, shard.refs("draws"), truth.held_out)
    sets = read_draw_sets(store, shard.refs("draws"))
    # Neighbouring draws of a chain are alike, so some suffice; all grown pairs are taken.
    generator = stream(shard.seed, TOPIC.name, "completed")
    nothing = np.zeros((0, 2, PAIR17.num_joints, 3), dtype=np.float32)
    grown = sets[GROWN].pairs_m if GROWN in sets else nothing
    others = np.concatenate([nothing, *(draws.pairs_m for name, draws in sets.items() if name != GROWN)])
    pool = np.concatenate([grown, others[generator.permutation(len(others))[:_MAX_DRAWS]]])
    return truth, pool, generator


def _learned_and_held_out(truth: GroundTruth) -> Iterator[tuple[str, dict[str, Array]]]:
    """Yield the takes of each part."""
    for split in ("learned", "held_out"):
        is_held_out = split == "held_out"
        yield split, {name: take for name, take in truth.takes.items() if (name in truth.held_out) == is_held_out}


def _held_out(split: str, items: Items) -> list[Items]:
    """Return the items if they are held out; otherwise none."""
    return [items] if split == "held_out" else []


def _spread_places(takes: Mapping[str, Array], count: int, gap: int) -> list[tuple[str, int]]:
    """Return takes and frames, evenly spread over all takes that have enough frames after them."""
    every = [(name, frame) for name, pairs in takes.items() for frame in range(len(pairs) - gap)]
    return some_of(every, count, has_ends=False)


TOPIC = Topic(
    name="lifting",
    heading="Lifting",
    introduction="3D pairs lifted from images with similar draws (Yin et al. 2018, figs. 2 and 10), hidden joints of "
    "real pairs completed from draws (fig. 12), and frames filled in between. Errors of pairs include the "
    "distance and depth between the people. Errors of people are measured with the hips aligned.",
    reads=("lifted_pairs", "in_betweens", "poses", "annotations", "views", "cameras", "draws", "seeds"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    settings=LiftedPairsSettings,
    criteria=(
        Criterion("lifted_pair_error_mean", "error of lifted pairs", "m", "images", ("over_time", "fitted")),
        Criterion("occluded_joint_error_mean", "error of completed joints", "m", "limbs", ("fitted",), _COMPLETED),
        Criterion("in_between_error_mean", "error of frames between", "m", "frames", ("draws",), _BETWEEN),
        Criterion(
            "in_between_lifted_error_mean", "error between lifted pairs", "m", "frames", ("draws",), _BETWEEN_LIFTED
        ),
    ),
)
