"""Topic `leave_one_out`: how near draws come in 2D to annotations that they were not made from, and a map of these.

This needs no ground truth: where draws reach what people really do, an unused image has a draw that looks like it (the
goal that Yin et al. 2018 state).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.completion.retrieval import nearest_by_image
from pasdedeux.errors import InputError
from pasdedeux.evaluation.embedding import PairMap
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.pictures import (
    CLOUD,
    CurvePanel,
    Picture,
    curve_figure,
    draw_pair,
    figure_svg,
    fit_map,
    legend_beside,
    new_figure,
)
from pasdedeux.evaluation.scores import Score, summarise
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.interaction.nearest import image_distances
from pasdedeux.sampling.densities.density import PRIOR_ONLY
from pasdedeux.spread import evenly_spread
from storage_schema import ArtifactRef, Store
from tasks.annotated_pairs import Place, SeenPair, annotated_pairs, read_seen_pairs, views_of
from tasks.draw_sets import draw_manifests, read_draw_sets
from tasks.evaluation.ground_truth import GroundTruth
from tasks.evaluation.topic import Topic, TopicResult, refuse_learned
from tasks.facts import DrawFacts, SequenceFacts, TakeFacts
from tasks.stage import Parameters, Shard, StageInputs, stream

Nearest = Mapping[int, Array]
"""Least d_I of each annotation (annotation,), metres, to any of the first draws, by their number."""

_NUM_JUDGED = 24
"""Annotations of each part that are judged, at most, evenly spread."""
_NUM_HYPOTHESES = 4
_MIN_APART = 10
"""Frames of a video between an unused annotation and those that draws were made from, at least: else it is the same
image."""
_MAX_DRAWS, _MAX_KNOWN = 20_000, 400
_COUNTS = (10, 100, 1_000, 10_000)
_NUM_MAPPED, _NUM_UNUSED_MAPPED = 150, 40
_NUM_DRAWN = 14
"""Annotations that are drawn on the map as people."""
_DRAWN_SHARE = 0.13
"""Height of two people on the map, as a share of its width."""
_WORDS = {"leave_one_out": "left out", "held_out": "held out"}
_METRIC = "leave_one_out_d_I"
_NEAREST, _REAL = "nearest_annotation", "real_frames"
_BASELINES = (PRIOR_ONLY, _NEAREST, _REAL)


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard over annotations that draws were not made from: left out, or of held-out takes."""
    learned = annotated_pairs(inputs)
    held_out = [
        one
        for one in inputs.of("annotations")
        if (facts := SequenceFacts.of(one)).is_held_out and facts.num_persons == 2 and views_of([one], inputs)
    ]
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
    annotations, draw_refs = shard.refs("annotations"), shard.refs("draws")
    facts = SequenceFacts.read(store, annotations)
    used: dict[Place, SeenPair] = {}
    unused: dict[str, dict[Place, SeenPair]] = {"leave_one_out": {}, "held_out": {}}
    for fact, *refs in zip(facts, annotations, shard.refs("views"), strict=True):
        for place, one in read_seen_pairs(store, *refs, num_hypotheses=_NUM_HYPOTHESES)[0].items():
            group = unused["held_out"] if fact.is_held_out else unused["leave_one_out"] if one.is_left_out else used
            group[place] = one
    stills = {name for fact in facts for name in fact.why_no_video}
    unused["leave_one_out"] = _apart(unused["leave_one_out"], used, stills)
    truth = GroundTruth.read(store, shard.refs("takes"), annotations)
    if unused["held_out"]:
        refuse_learned(store, draw_refs, truth.held_out)
    generator = stream(shard.seed, "left_out", "draws")  # a label, not a name: another one draws others
    draws = {name: found.pairs_m for name, found in read_draw_sets(store, draw_refs).items()}
    # In random order, so that every seed counts from the start.
    draws = {name: pairs[generator.permutation(len(pairs))[:_MAX_DRAWS]] for name, pairs in draws.items()}
    real = [found.pair_m for found in map(truth.pair, used) if found is not None]
    if real:
        draws[_REAL] = np.array(real)[generator.permutation(len(real))].astype(np.float32)
    known = _spread(used, _MAX_KNOWN)
    curves: dict[str, dict[str, Nearest]] = {}
    items = Items()
    for split, every in unused.items():
        chosen = _spread(every, _NUM_JUDGED)
        if not chosen or not known:
            continue
        images, directions = [one.image_m for one in chosen], [one.directions for one in chosen]
        curves[split] = {name: nearest_curve(images, directions, pairs) for name, pairs in draws.items()}
        nearest = np.nanmin(image_distances(np.stack(images), np.stack([one.image_m for one in known])), axis=1)
        curves[split][_NEAREST] = {len(known): nearest}
        # The last counts: held-out takes where there are any, else images left out of what draws are made from.
        times = _takes_and_times(facts, truth, [one.place for one in chosen], stills)
        items = Items({name: list(curve.values())[-1] for name, curve in curves[split].items()}, *times)
    pictures = []
    if curves:
        caption = (
            "Distance of images that draws were not made from to their nearest draw, seen from where the image was "
            "taken; lower is better. Baselines are dashed: chains without annotations, and real pairs in place of "
            "draws, which need ground truth. The grey line is the nearest image among those used. Left out are "
            "images of the same sources; held out: images of takes that nothing was learned from."
        )
        pictures.append(Picture("leave-one-out.svg", caption, nearest_draw_figure(curves)))
    shown = _map(store, draw_refs, used, unused["leave_one_out"])
    if shown is not None:
        caption = (
            "A map of the annotations: what is near is alike (Yin et al. 2018, fig. 5b); some are drawn as people. "
            "Circles: annotations that draws are nearest to, larger where more draws are. Crosses: annotations left "
            "out. Better: circles lie all over the annotations, and near every cross."
        )
        pictures.append(Picture("annotations-map.svg", caption, shown))
    scores = [score for split, own in curves.items() for score in nearest_draw_scores(own, split=split)]
    return TopicResult(scores, pictures, _notes(unused, curves), {"": items} if curves else {}, _BASELINES)


def _takes_and_times(
    facts: Sequence[SequenceFacts], truth: GroundTruth, places: Sequence[Place], stills: Collection[str]
) -> tuple[list[str], list[float]]:
    """Return the take of each image and its time there, seconds; each still of one's own is a moment of its own."""
    own = {name: fact.rate_hz for fact in facts for name in fact.sequence_ids}
    takes, times_s = [], []
    for sequence_id, frame, *_ in places:
        if (sequence_id, frame) in truth.frames:
            takes.append(truth.frames[sequence_id, frame][0])
            times_s.append(truth.time_s(*truth.frames[sequence_id, frame]))
        else:
            takes.append(sequence_id)
            times_s.append(frame / (1.0 if sequence_id in stills else own[sequence_id]))
    return takes, times_s


def _notes(unused: Mapping[str, Collection[Place]], curves: Collection[str]) -> list[str]:
    counts = [f"{len(unused[split])} {_WORDS[split]}" for split in curves]
    if not counts:
        return [
            "No annotation was left out of what draws are made from, so generalisation of draws to other annotations "
            "is not known: `leave_one_out_every` of a source requests that; it needs as many moments as half of it, "
            "and one more."
        ]
    return [f"Images that draws were not made from: {' and '.join(counts)}; at most {_NUM_JUDGED} of each are judged."]


def _apart(
    left_out: Mapping[Place, SeenPair], used: Collection[Place], stills: Collection[str]
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


def nearest_curve(images_m: Sequence[Array], directions: Sequence[Array], pairs_m: npt.NDArray[np.floating]) -> Nearest:
    """Return how near draws come to images, as draws grow in number.

    Args:
        images_m: Images (person=2, joint=17, 2), metres; NaN where a joint is not seen.
        directions: View hypotheses of each, (view, 3): the best one counts.
        pairs_m: Draws in the order in which they count, (draw, person=2, joint=17, 3), metres, at least one.
    """
    found: dict[int, Array] = {}
    least = np.full(len(images_m), np.inf)
    for count in [*(count for count in _COUNTS if count < len(pairs_m)), len(pairs_m)]:
        index = DrawIndex(pairs_m[:count])
        near = [nearest_by_image(index, *one)[1][0] for one in zip(images_m, directions, strict=True)]
        # The nearest of few is among many too; that d_I is computed of some only must not hide it.
        found[count] = least = np.minimum(least, near)
    return found


def nearest_draw_scores(curves: Mapping[str, Nearest], *, split: str) -> list[Score]:
    """Return how near draws of each method come to the annotations, of all draws and as they grow in number."""
    scores = summarise({name: list(curve.values())[-1] for name, curve in curves.items()}, _METRIC, "m", split=split)
    for method, curve in curves.items():
        points = curve.items() if len(curve) > 1 else ()
        scores += [
            Score(_METRIC, method, float(near.mean()), "m", split=split, at=float(at), count=len(near))
            for at, near in points
        ]
    return scores


def nearest_draw_figure(curves: Mapping[str, Mapping[str, Nearest]]) -> bytes:
    """Draw how near draws come as they grow in number, a panel for each part; a method with one point is a level."""
    panels = []
    for split, methods in curves.items():
        means = {
            name: (np.array(list(curve)), np.array([100.0 * near.mean() for near in curve.values()]))
            for name, curve in methods.items()
        }
        panels.append(
            CurvePanel(
                f"distance to the nearest (cm), {_WORDS[split]}",
                {name: both for name, both in means.items() if len(both[0]) > 1},
                _BASELINES,
                {name: float(mean[0]) for name, (at, mean) in means.items() if len(at) == 1},
            )
        )
    return curve_figure(
        panels, title="images that draws were not made from", x_label="draws, or real frames", is_log=True
    )


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
            np.array([one.image_m for one in _spread(left_out, _NUM_UNUSED_MAPPED)]),
        )
    except InputError:
        return None


def annotation_map_figure(images_m: Array, nearest: Mapping[str, Array], left_out_m: Array) -> bytes:
    """Draw a map of annotations (Yin et al. 2018, Fig. 5b) and where draws are on it; give SVG bytes.

    Args:
        images_m: Annotations (n, person=2, joint=17, 2), metres, at least three that differ.
        nearest: Of draws of each density, which annotations are nearest to them: images (m, 2, 17, 2), one for each
            draw.
        left_out_m: Annotations that draws were not made from, (k, 2, 17, 2).
    """
    plane = PairMap.of(images_m)
    figure, ((axis,),) = new_figure(6.4, 5.0)
    axis.scatter(*(100 * plane.places.T), s=7, color="#9aa3b0", label="annotation", **CLOUD)
    for number, (method, images) in enumerate(nearest.items()):
        own, count = np.unique(images, axis=0, return_counts=True)
        label = f"nearest to draws: {in_words(method)}"
        size = 12.0 + 150.0 * count / count.sum()
        axis.scatter(*(100 * plane.place(own).T), s=size, alpha=0.6, color=f"C{number + 6}", label=label, **CLOUD)
    if len(left_out_m):
        axis.plot(*(100 * plane.place(left_out_m).T), "kx", markersize=4, linestyle="none", label="left out")
    scale = _DRAWN_SHARE * 100 * float(np.ptp(plane.places[:, 0])) / 1.7
    for at in _far_apart(plane.places, _NUM_DRAWN):
        draw_pair(axis, scale * images_m[at], 100 * plane.places[at])
    axis.tick_params(labelsize=6)
    fit_map(figure, axis, scale=5.6, limits=(2.4, 7.0))
    axis.set_xlabel("cm of distance between images", fontsize=7)
    legend_beside(axis)
    return figure_svg(figure, title=f"annotations by how alike they are ({plane.share:.0%} of the spread shown)")


def _far_apart(places: Array, count: int) -> list[int]:
    """Return some places that are far from each other, the farthest from the middle first."""
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    gap = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return chosen


TOPIC = Topic(
    name="leave_one_out",
    heading="Leave-one-out images",
    introduction="Evidence that needs no ground truth: some images are kept from everything that draws are made from; "
    "good draws include one that looks like each of them. Distances are those of images (d_I of Yin et al. 2018).",
    reads=("annotations", "views", "draws", "seeds", "poses"),
    plan=_plan,
    run=_run,
    criteria=(Criterion(f"{_METRIC}_mean", "distance of left-out images to the nearest draw", "m", "images"),),
)
