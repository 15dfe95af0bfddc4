"""Topic `left_out`: images that draws were not made from, and how near draws come to them; needs no truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.evaluation.left_out import (
    LeftOutCurve,
    annotation_map_figure,
    left_out_curve,
    left_out_figure,
    left_out_scores,
)
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.interaction.nearest import image_distances
from pasdedeux.sampling.densities.density import PRIOR_ONLY
from pasdedeux.spread import evenly_spread
from storage_schema import ArtifactRef, Store
from tasks.annotated_pairs import Place, SeenPair, annotated_pairs, read_seen_pairs, views_of
from tasks.draw_sets import draw_manifests, read_draw_sets
from tasks.evaluation.ground_truth import read_rates, read_take_frames, read_takes, true_pair
from tasks.evaluation.topic import Topic, TopicResult, held_out_takes, refuse_learned
from tasks.facts import DrawFacts, SequenceFacts, TakeFacts
from tasks.stage import Parameters, Shard, StageInputs, stream

_NUM_JUDGED = 24
"""Annotations of each part that are judged, at most, evenly spread."""
_NUM_HYPOTHESES = 4
_MIN_APART = 10
"""Frames of a video from what is left out to what draws were made from, at least: nearer ones are the same image."""
_MAX_DRAWS, _MAX_KNOWN = 20_000, 400
_NUM_MAPPED, _NUM_LEFT_OUT_MAPPED = 150, 40
_NEAREST, _REAL = "nearest_annotation", "real_frames"
_BASELINES = (PRIOR_ONLY, _NEAREST, _REAL)


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard over what was left out of the annotations that draws are made from, and of held-out takes."""
    learned = annotated_pairs(inputs)
    held_out = [
        one for one in inputs.of("annotations") if SequenceFacts.of(one).is_held_out and views_of([one], inputs)
    ]
    held_out = [one for one in held_out if SequenceFacts.of(one).num_persons == 2]
    draws = draw_manifests(inputs)
    learned = [one for one in learned if views_of([one], inputs)]
    if not draws or not learned:
        return []
    takes = [manifest for manifest in inputs.of("poses") if TakeFacts.of(manifest).num_persons >= 2]
    every = [*learned, *held_out]
    views = [views_of([one], inputs)[0] for one in every]
    return [TOPIC.shard(inputs, "images", annotations=every, views=views, draws=draws, takes=takes)]


def _run(shard: Shard, store: Store) -> TopicResult:
    """Measure how near draws come to images that they were not made from, and draw a map of annotations."""
    annotations, views, draw_refs = shard.refs("annotations"), shard.refs("views"), shard.refs("draws")
    facts = SequenceFacts.read(store, annotations)
    used: dict[Place, SeenPair] = {}
    left_out: dict[Place, SeenPair] = {}
    held_out: dict[Place, SeenPair] = {}
    for fact, *refs in zip(facts, annotations, views, strict=True):
        for place, one in read_seen_pairs(store, *refs, num_hypotheses=_NUM_HYPOTHESES)[0].items():
            group = held_out if fact.is_held_out else left_out if one.is_left_out else used
            group[place] = one
    stills = {name for fact in facts for name in fact.why_no_video}
    judged = {"left_out": _apart(left_out, used, stills), "held_out": held_out}
    if held_out:
        refuse_learned(store, draw_refs, held_out_takes(store, shard.refs("takes")))
    generator = stream(shard.seed, TOPIC.name, "draws")
    draws = {name: found.pairs_m for name, found in read_draw_sets(store, draw_refs).items()}
    # In random order, so that every seed counts from the start.
    draws = {name: pairs[generator.permutation(len(pairs))[:_MAX_DRAWS]] for name, pairs in draws.items()}
    real = _real_pairs(store, shard, used)
    if len(real):
        draws[_REAL] = real[generator.permutation(len(real))].astype(np.float32)
    known = _spread(used, _MAX_KNOWN)
    curves: dict[str, dict[str, LeftOutCurve]] = {}
    items = Items()
    for split, every in judged.items():
        chosen = _spread(every, _NUM_JUDGED)
        if not chosen or not known:
            continue
        images, directions = [one.image_m for one in chosen], [one.directions for one in chosen]
        curves[split] = {name: left_out_curve(images, directions, pairs) for name, pairs in draws.items()}
        nearest = np.nanmin(image_distances(np.stack(images), np.stack([one.image_m for one in known])), axis=1)
        curves[split][_NEAREST] = LeftOutCurve(np.array([len(known)]), nearest[None])
        # The last counts: held-out takes where there are any, else images that were left out of what draws are made of.
        values = {name: curve.nearest_m[-1] for name, curve in curves[split].items()}
        items = Items(values, *_takes_and_times(store, shard, [one.place for one in chosen], stills), _BASELINES)
    scores = [score for split, own in curves.items() for score in left_out_scores(own, _BASELINES, split=split)]
    pictures, captions = {}, {}
    if curves:
        pictures["left-out.svg"] = left_out_figure(curves, _BASELINES)
        captions["left-out.svg"] = (
            "How far images that draws were not made from are from their nearest draw, seen from where the image was "
            "taken: lower is better. Dashed are trivial ways: chains without annotations, and real pairs in place of "
            "draws, which a study of 2D alone has not got. The grey line: the nearest image among those used. Left out "
            "are images of the same sources, held out those of takes that nothing was learned from."
        )
    shown = _map(store, draw_refs, used, judged["left_out"])
    if shown is not None:
        pictures["annotations-map.svg"] = shown
        captions["annotations-map.svg"] = (
            "A map of the annotations: who is near is alike (Yin et al. 2018, fig. 5b), some drawn as people. Circles: "
            "annotations that draws are nearest to, larger where more draws are. Crosses were left out. Better: "
            "circles lie all over the annotations, and near every cross."
        )
    return TopicResult(scores, pictures, captions, _notes(judged, curves), {"": items} if curves else {})


def _takes_and_times(
    store: Store, shard: Shard, places: Sequence[Place], stills: set[str]
) -> tuple[list[str], list[float]]:
    """Return the take of each image and its time there, seconds; each still of one's own is a moment of its own."""
    frames, rates = read_take_frames(store, shard.refs("annotations")), read_rates(store, shard.refs("takes"))
    shown = SequenceFacts.read(store, shard.refs("annotations"))
    own = {name: fact.rate_hz for fact in shown for name in fact.sequence_ids}
    takes, times_s = [], []
    for place in places:
        is_virtual = (place.sequence_id, place.frame) in frames
        take, frame = frames[place.sequence_id, place.frame] if is_virtual else (place.sequence_id, place.frame)
        takes.append(take)
        times_s.append(frame / (rates[take] if is_virtual else 1.0 if take in stills else own[take]))
    return takes, times_s


def _notes(judged: Mapping[str, Mapping[Place, SeenPair]], curves: Mapping[str, object]) -> list[str]:
    counts = [f"{len(judged[split])} {split.replace('_', ' ')}" for split in curves]
    if not counts:
        return [
            "No annotation was left out of what draws are made from, so nobody knows how near draws come to others: "
            "`left_out_every` of a source asks for that, and needs as many moments as half of it, and one more."
        ]
    return [f"Images that draws were not made from: {' and '.join(counts)}; at most {_NUM_JUDGED} of each are judged."]


def _apart(
    left_out: Mapping[Place, SeenPair], used: Mapping[Place, SeenPair], stills: set[str]
) -> dict[Place, SeenPair]:
    """Return those of a video that are far enough from every frame that is used, and all stills."""
    frames: dict[str, list[int]] = {}
    for place in used:
        if place.sequence_id not in stills:
            frames.setdefault(place.sequence_id, []).append(place.frame)
    return {
        place: one
        for place, one in left_out.items()
        if np.abs(np.array(frames.get(place.sequence_id, [])) - place.frame).min(initial=_MIN_APART) >= _MIN_APART
    }


def _spread(every: Mapping[Place, SeenPair], count: int) -> list[SeenPair]:
    found = list(every.values())
    return [found[at] for at in evenly_spread(len(found), count)]


def _real_pairs(store: Store, shard: Shard, used: Mapping[Place, SeenPair]) -> np.ndarray:
    """Return the true pairs behind the annotations that draws were made from, (n, 2, 17, 3); none of real video."""
    virtual = [ref for ref in shard.refs("annotations") if SequenceFacts.of(store.manifest(ref)).is_virtual]
    frames, takes = read_take_frames(store, virtual), read_takes(store, shard.refs("takes"), "pair17_m")
    found = [true_pair(place, frames, takes) for place in used]
    return np.array([one[1] for one in found if one is not None]).reshape(-1, 2, 17, 3)


def _map(
    store: Store,
    draw_refs: Sequence[ArtifactRef],
    used: Mapping[Place, SeenPair],
    left_out: Mapping[Place, SeenPair],
) -> bytes | None:
    """Draw annotations among each other, and which of them draws are nearest to; None where they are all alike."""
    by_name = {place[:3]: one for place, one in used.items()}
    nearest: dict[str, list[np.ndarray]] = {}
    for ref in draw_refs:
        if "draws" not in store.manifest(ref).tables:
            continue
        names = ["sequence_id", "sequence_frame", "sequence_person_id"]
        table = store.read(ref, "draws", columns=names)
        rows = [row for row in range(table.num_rows) if table["sequence_id"][row] is not None]
        places = [(str(table[names[0]][row]), *(int(table[name][row]) for name in names[1:])) for row in rows]
        found = [by_name[place].image_m for place in places if place in by_name]
        nearest.setdefault(DrawFacts.of(store.manifest(ref)).density, []).extend(found)
    try:
        return annotation_map_figure(
            np.array([one.image_m for one in _spread(used, _NUM_MAPPED)]),
            {name: np.stack(images) for name, images in sorted(nearest.items()) if images},
            np.array([one.image_m for one in _spread(left_out, _NUM_LEFT_OUT_MAPPED)]),
        )
    except InputError:
        return None


TOPIC = Topic(
    name="left_out",
    heading="Images left out",
    introduction="Evidence that needs no truth: some images are kept from everything that draws are made from, and a "
    "good set of draws has one that looks like each of them all the same. Distances are those of images, d_I.",
    reads=("annotations", "views", "draws", "seeds", "poses"),
    plan=_plan,
    run=_run,
    criteria=(Criterion("left_out_d_I_mean", "distance of left-out images to the nearest draw", "m", "images"),),
)
