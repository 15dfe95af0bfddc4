"""Topic `lifting`: lifted pairs, completed joints and in-betweens against the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import Field

from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.completion.retrieval import nearest_by_image, nearest_images
from pasdedeux.evaluation.lifted_pairs import (
    BASELINES,
    LiftedExample,
    calibration_scores,
    completion_errors,
    completion_scores,
    expected_figure,
    in_between_errors,
    in_between_scores,
    lifted_errors,
    lifted_player,
    lifted_scores,
    nearest_figure,
)
from pasdedeux.evaluation.scores import Score, scores_of, summarise
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.sampling.bandwidth import SAME_MOMENT
from pasdedeux.sampling.densities.density import PRIOR_ONLY
from pasdedeux.skeletons import PAIR17
from pasdedeux.spread import evenly_spread
from storage_schema import Store, TableData
from tasks.annotated_pairs import PLACE_COLUMNS, Place, SeenPair, annotated_pairs, place_of, read_seen_pairs, views_of
from tasks.draw_sets import GROWN, density_of, draw_manifests, read_all_draws, read_draw_sets
from tasks.evaluation.ground_truth import read_cameras, read_rates, read_take_frames, read_takes, true_pair
from tasks.evaluation.topic import Topic, TopicResult, held_out_takes, refuse_learned, refuse_overlap
from tasks.facts import LiftedFacts, SequenceFacts, TakeFacts
from tasks.stage import Parameters, Shard, StageInputs, stream

_COMPLETED, _BETWEEN, _BETWEEN_LIFTED = "completed joints", "frames between", "frames between lifted pairs"
"""What is judged beside the lifted pairs."""
_GAPS = (10, 20, 30)
"""Frames between the ends of spans that are filled in."""
_SHEET_METHODS = ("lifting", "lifting_ik", "naive_sampling", "nearest_draw", "fitted")
_NUM_EXAMPLES = 6
_NUM_NEAREST, _NUM_NEAREST_SHOWN = 3, 5
"""Annotations and draws most like a lifted pair, and how many pairs are shown with them."""
_NUM_HYPOTHESES = 4
_EXPECTED = ("expected_error_m", "expected_low_m", "expected_high_m")
_MAX_KNOWN = 600
_MAX_DRAWS = 20_000
"""Draws of chains that joints are completed from, at most; grown seeds are all used."""


class LiftedPairsSettings(Parameters):
    """What is completed to be scored."""

    num_completed_pairs: int = Field(
        12, ge=0, description="Real pairs of each part whose joints are hidden and completed from draws; 0: none"
    )


def _plan(inputs: StageInputs, settings: LiftedPairsSettings) -> list[Shard]:
    """Plan a shard over all lifted pairs, one that shows some, one over real pairs with joints and frames hidden."""
    lifted = list(inputs.of("lifted_pairs"))
    takes = [manifest for manifest in inputs.of("poses") if TakeFacts.of(manifest).num_persons >= 2]
    couples = [manifest for manifest in takes if TakeFacts.of(manifest).num_persons == 2]
    known = {ref for manifest in lifted for ref in manifest.inputs}
    shown = [manifest for manifest in inputs.of("annotations") if manifest.ref in known]
    annotations = [manifest for manifest in shown if SequenceFacts.of(manifest).is_virtual]
    found = []
    draws = [one for one in draw_manifests(inputs) if density_of(one) != PRIOR_ONLY]
    shown = [one for one in shown if views_of([one], inputs)]
    learned = [one for one in annotated_pairs(inputs) if views_of([one], inputs)]
    if shown and draws and learned:
        every = [*shown, *(one for one in learned if one not in shown)]
        views = [views_of([one], inputs)[0] for one in every]
        found.append(
            TOPIC.shard(inputs, "nearest", lifted=lifted, annotations=every, views=views, known=learned, draws=draws)
        )
    if lifted and takes and annotations:
        found.append(TOPIC.shard(inputs, "lifted", takes=takes, annotations=annotations, lifted=lifted))
    if settings.num_completed_pairs and draws and couples:
        found.append(TOPIC.shard(inputs, "completed", settings.part(LiftedPairsSettings), takes=couples, draws=draws))
    return found


def _run(shard: Shard, store: Store) -> TopicResult:
    """Score or show one of the three."""
    return {"lifted": _lifted, "nearest": _nearest, "completed": _completed}[shard.name](shard, store)


def _lifted(shard: Shard, store: Store) -> TopicResult:
    take_refs, annotation_refs = shard.refs("takes"), shard.refs("annotations")
    takes = read_takes(store, take_refs, "pair17_m")
    held_out = held_out_takes(store, take_refs)
    frames, cameras = read_take_frames(store, annotation_refs), read_cameras(store, annotation_refs)
    rates = read_rates(store, take_refs)
    found: dict[str, dict[str, list[tuple[np.ndarray, np.ndarray]]]] = {}
    between: dict[str, dict[str, list[tuple[np.ndarray, np.ndarray]]]] = {}
    items: dict[str, list[Items]] = {}
    expected: dict[str, list[tuple[list[float], np.ndarray, np.ndarray]]] = {}
    examples: dict[str, dict[Place, dict[str, np.ndarray]]] = {}
    for ref in shard.refs("lifted"):
        facts = LiftedFacts.of(store.manifest(ref))
        if facts.is_held_out:
            refuse_overlap(f"artifact {store.manifest(ref).partition}", facts.learned_takes, held_out)
        for table_name, sink in (("lifted_pairs", found), ("in_betweens", between)):
            if table_name not in store.manifest(ref).tables:
                continue
            also = _EXPECTED if table_name == "lifted_pairs" else ()
            table = store.read(ref, table_name, columns=[*PLACE_COLUMNS, "method", "pair17_m", *also])
            made: dict[tuple[Place, str], dict[str, tuple[np.ndarray, np.ndarray]]] = {}
            for row in range(table.num_rows):
                place = place_of(table, row)
                found_pair = true_pair(place, frames, takes)
                if found_pair is None or place.sequence_id not in cameras:
                    continue
                take_id, pair_m = found_pair
                truth = pair_m @ cameras[place.sequence_id].camera_from_world_rotmat.T
                split = _split(facts, take_id in held_out)
                method = "nearest_draw" if table["method"][row] == "nearest" else str(table["method"][row])
                pair = np.asarray(table["pair17_m"][row], dtype=np.float64)
                sink.setdefault(split, {}).setdefault(method, []).append((pair, truth))
                made.setdefault((place, take_id), {})[method] = (pair, truth)
                if table_name == "lifted_pairs":
                    examples.setdefault(split, {}).setdefault(place, {"truth": truth})[method] = pair
                    if (told := _told(table, row)) is not None:
                        expected.setdefault(split, []).append((told, pair, truth))
            name = "" if table_name == "lifted_pairs" else _BETWEEN_LIFTED
            items.setdefault(name, [])
            for (place, take_id), by_method in made.items():
                if take_id in held_out:
                    at_s = frames[place.sequence_id, place.frame][1] / rates[take_id]
                    own = {method: _pair_error(*both) for method, both in by_method.items()}
                    items[name].append(Items(own, [take_id], [at_s], BASELINES))
    scores: list[Score] = []
    for split, methods in sorted(found.items()):
        lifted, truths = (
            {method: np.stack([row[at] for row in rows]) for method, rows in sorted(methods.items())} for at in (0, 1)
        )
        scores += lifted_scores(lifted, truths, split=split)
    for split, methods in sorted(between.items()):
        for method, rows in sorted(methods.items()):
            errors = lifted_errors(*(np.stack(column) for column in zip(*rows, strict=True)))["lifted_pair_error"]
            figure = {"in_between_lifted_error_mean": float(np.mean(errors))}
            more = {"is_baseline": method == "straight", "split": split, "count": len(errors)}
            scores += scores_of(figure, method, "m", **more)
    pictures, captions = {}, {}
    judged: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for split, lifts in sorted(expected.items()):
        found_m, *both = (np.array(column) for column in zip(*lifts, strict=True))
        judged[split] = found_m, lifted_errors(*both)["lifted_pair_error"]
        scores += calibration_scores(*judged[split], split=split)
    if judged:
        pictures["expected-error.svg"] = expected_figure(judged)
        captions["expected-error.svg"] = (
            "What was expected of each lifted pair without the truth, and its true error. Better: dots follow the "
            "line, and four of five lie in the grey."
        )
    for split, places in sorted(examples.items()):
        chosen = [places[place] for place in sorted(places)]
        spread = evenly_spread(len(chosen), _NUM_EXAMPLES, has_ends=False)
        rows_shown = [
            {name: chosen[at][name] for name in ("truth", *_SHEET_METHODS) if name in chosen[at]} for at in spread
        ]
        if rows_shown:
            name = f"lifted-{split}.player.json"
            pictures[name] = lifted_player(rows_shown)
            captions[name] = (
                f"{split.replace('_', ' ').capitalize()} frames: the truth, and what was made of its image, first seen "
                "from the camera. Turn them: better is what has the truth's depth from the side too."
            )
    joined = {name: Items.joined(own) for name, own in items.items()}
    return TopicResult(scores=scores, pictures=pictures, captions=captions, items=joined)


def _pair_error(lifted_m: np.ndarray, truth_m: np.ndarray) -> np.ndarray:
    """Return the error (1,) of one lifted pair, metres."""
    return lifted_errors(lifted_m[None], truth_m[None])["lifted_pair_error"]


def _nearest(shard: Shard, store: Store) -> TopicResult:
    """Show some lifted pairs, each with the annotations and draws most like it (Yin et al. 2018, fig. 11)."""
    draws = read_all_draws(store, shard.refs("draws"))
    index = DrawIndex(draws.pairs_m)
    seen: dict[Place, SeenPair] = {}
    known: list[SeenPair] = []
    for ref, views in zip(shard.refs("annotations"), shard.refs("views"), strict=True):
        own = read_seen_pairs(store, ref, views, num_hypotheses=_NUM_HYPOTHESES)[0]
        seen |= own
        known += [one for one in own.values() if not one.is_left_out] if ref in shard.refs("known") else []
    known = [known[at] for at in evenly_spread(len(known), _MAX_KNOWN)]
    pairs: dict[Place, tuple[np.ndarray, list[float]]] = {}
    scores: list[Score] = []
    for ref in shard.refs("lifted"):
        table = store.read(ref, "lifted_pairs", columns=[*PLACE_COLUMNS, "pair17_m", *_EXPECTED])
        every: list[float] = []
        for row in range(table.num_rows):
            if (told := _told(table, row)) is not None:
                every.append(told[0])
                if place_of(table, row) in seen:
                    pairs[place_of(table, row)] = (np.asarray(table["pair17_m"][row], dtype=np.float64), told)
        manifest = store.manifest(ref)
        more = {"item": f"{manifest.partition} {manifest.name}".replace("_", " ")}
        scores += summarise(np.array(every), metric="expected_error", method="fitted", unit="m", **more)
    chosen = [list(pairs)[at] for at in evenly_spread(len(pairs), _NUM_NEAREST_SHOWN, has_ends=False)]
    examples = [_example(seen[place], *pairs[place], known, index) for place in chosen]
    if not examples:
        return TopicResult(scores)
    caption = (
        "Some lifted pairs with the error of a joint to expect, and where four of five such errors are; each beside "
        "the other annotations and the draws most like it, nearest first, and their distance d_I: of an annotation to "
        "the pair seen from where that was taken, of a draw to the pair's image (Yin et al. 2018, fig. 11). Not "
        "annotations of the same moment; but the nearest draw may have been lifted from that very image. Better: all "
        "look alike; far neighbours say that nothing like it is known."
    )
    return TopicResult(scores, {"nearest.svg": nearest_figure(examples)}, {"nearest.svg": caption})


def _told(table: TableData, row: int) -> list[float] | None:
    """Return the expected error and the ends of its interval, metres; None of a method that has none."""
    told = [float(table[name][row]) for name in _EXPECTED]
    return None if math.isnan(told[0]) else told


def _example(
    one: SeenPair, pair_m: np.ndarray, told_m: list[float], known: Sequence[SeenPair], index: DrawIndex
) -> LiftedExample:
    place, (value, low, high) = one.place, (100.0 * value for value in told_m)
    others = [
        other
        for other in known
        if other.place.sequence_id != place.sequence_id or abs(other.place.frame - place.frame) >= SAME_MOMENT
    ]
    near: list[tuple[np.ndarray, float]] = []
    if others:
        images, views = np.stack([other.image_m for other in others]), np.stack([o.directions[0] for o in others])
        found, far = nearest_images(pair_m, images, views, count=_NUM_NEAREST)
        near = list(zip(images[found], far.tolist(), strict=True))
    placed, distance = nearest_by_image(index, one.image_m, one.directions, count=_NUM_NEAREST)
    return LiftedExample(
        label=f"{place.sequence_id}, frame {place.frame}: expected error {value:.0f} cm, {low:.0f} to {high:.0f}",
        image_m=one.image_m,
        pair_m=pair_m,
        annotations=near,
        draws=list(zip(placed, distance.tolist(), strict=True)),
    )


def _completed(shard: Shard, store: Store) -> TopicResult:
    count = shard.options(LiftedPairsSettings).num_completed_pairs
    take_refs, draw_refs = shard.refs("takes"), shard.refs("draws")
    takes, held_out = read_takes(store, take_refs, "pair17_m"), held_out_takes(store, take_refs)
    refuse_learned(store, draw_refs, held_out)
    sets = read_draw_sets(store, draw_refs)
    nothing = np.zeros((0, 2, PAIR17.num_joints, 3), dtype=np.float32)
    # Neighbouring draws of a chain are alike: a spread of them is enough, grown seeds are all taken.
    generator = stream(shard.seed, TOPIC.name, "completed")
    grown = sets[GROWN].pairs_m if GROWN in sets else nothing
    sampled = [found.pairs_m for name, found in sets.items() if name != GROWN]
    others = np.concatenate(sampled) if sampled else nothing
    pool = np.concatenate([grown, others[generator.permutation(len(others))[:_MAX_DRAWS]]])
    scores: list[Score] = []
    judged: dict[str, list[Items]] = {_COMPLETED: [], _BETWEEN: []}
    rates = read_rates(store, take_refs)
    for split in ("learned", "held_out"):
        own = {name: pairs for name, pairs in takes.items() if (name in held_out) == (split == "held_out")}
        places = _spread_places(own, count, 0)
        if not places:
            continue
        completed = completion_errors(generator, np.stack([own[take][frame] for take, frame in places]), pool)
        scores += completion_scores(completed, split=split)
        if split == "held_out":
            at = [take for take, _ in places], [frame / rates[take] for take, frame in places]
            judged[_COMPLETED] += [Items(errors, *at, BASELINES) for errors in completed.values()]
        every = _spread_places(own, max(count, len(_GAPS)), max(_GAPS))
        for number, gap in enumerate(_GAPS):
            starts = every[number :: len(_GAPS)]
            if not starts:
                continue
            filled = in_between_errors([own[take][frame : frame + gap + 1] for take, frame in starts], pool)
            scores += in_between_scores(filled, split=split, item=f"{gap} frames")
            if split == "held_out":
                named = [take for take, _ in starts for _ in range(gap - 1)]
                times_s = [(frame + more) / rates[take] for take, frame in starts for more in range(1, gap)]
                errors = {method: np.concatenate(spans) for method, spans in filled.items()}
                judged[_BETWEEN].append(Items(errors, named, times_s, BASELINES))
    return TopicResult(
        scores=scores,
        notes=[f"Joints were completed from {len(pool):,} draws and grown seeds."],
        items={name: Items.joined(found) for name, found in judged.items()},
    )


def _spread_places(takes: Mapping[str, np.ndarray], count: int, gap: int) -> list[tuple[str, int]]:
    """Return takes and frames, evenly spread over all takes that are long enough, with so many frames after each."""
    every = [(name, frame) for name, pairs in takes.items() for frame in range(len(pairs) - gap)]
    return [every[at] for at in evenly_spread(len(every), count, has_ends=False)]


def _split(facts: LiftedFacts, is_held_out: bool) -> str:
    if is_held_out:
        return "held_out"
    return "annotated" if facts.purpose == "random_views" else "unannotated"


TOPIC = Topic(
    name="lifting",
    heading="Lifting",
    introduction="3D pairs made of images by the draws that look like them; joints of real pairs hidden and completed "
    "from draws; frames filled in between. Errors of pairs count distance and depth between the people too, errors of "
    "people are each about their own hips.",
    reads=("lifted_pairs", "in_betweens", "poses", "annotations", "views", "cameras", "draws", "seeds"),
    plan=_plan,
    run=_run,
    settings=LiftedPairsSettings,
    criteria=(
        Criterion("lifted_pair_error_mean", "error of lifted pairs", "m", "images", ("fitted",)),
        Criterion("occluded_joint_error_mean", "error of completed joints", "m", "limbs", ("fitted",), _COMPLETED),
        Criterion("in_between_error_mean", "error of frames between", "m", "frames", ("draws",), _BETWEEN),
        Criterion(
            "in_between_lifted_error_mean", "error between lifted pairs", "m", "frames", ("draws",), _BETWEEN_LIFTED
        ),
    ),
)
