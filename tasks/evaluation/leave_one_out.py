"""Topic `leave_one_out`: the distance in 2D of draws to annotations that they were not made from, and a map of these.

This needs no ground truth: where draws reach what people really do, an unused image has a draw that looks like it (the
goal that Yin et al. 2018 state).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.completion.retrieval import nearest_by_image
from pasdedeux.errors import InputError
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
from pasdedeux.evaluation.styles import method_style
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.interaction.nearest import image_distances
from pasdedeux.interaction.pair_map import PairMap
from pasdedeux.spread import some_of
from storage_schema import ArtifactRef, Store
from tasks.evaluation.ground_truth import GroundTruth
from tasks.evaluation.topic import Topic, TopicResult, refuse_learned
from tasks.rows.annotated_pairs import PairPlace, SeenPair, annotated_pairs, read_all_seen, with_views
from tasks.rows.draw_sets import baselines_of, density_of, draw_manifests, read_draw_sets
from tasks.rows.takes import takes_of
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import SequenceFacts
from tasks.stage.streams import stream

NearestCurve = Mapping[int, Array]
"""Least d_I of each annotation (annotation,), metres, to any of the first draws, by their number."""

_NUM_JUDGED = 24
"""Annotations of each part that are judged, at most, evenly spread."""
_NUM_HYPOTHESES = 4
_MIN_APART = 10
"""Least number of frames between an unused annotation and those that draws were made from; closer ones show the same
pose."""
_MAX_DRAWS, _MAX_KNOWN = 20_000, 400
_NUM_VIEWS = 100
"""Views of annotations under which draws are projected too, at most; the nearest annotation keeps its own view."""
_COUNTS = (10, 100, 1_000, 10_000)
_NUM_MAPPED, _NUM_UNUSED_MAPPED = 150, 40
_NUM_DRAWN = 14
"""Annotations that are drawn on the map as people."""
_DRAWN_SHARE = 0.13
"""Height of two people on the map, as a share of its width."""
_WORDS = {"leave_one_out": "left out", "held_out": "held out"}
_METRIC = "leave_one_out_d_I"
_NEAREST, _REAL = "nearest_annotation", "real_frames"


class _ShownLeaveOneOut(NamedTuple):
    """Input of the pictures: curves by part and method, annotations (n, 2, 17, 2), and those nearest to draws.

    `left_out_m` (k, 2, 17, 2) are annotations that draws were not made from.  Curves of `baselines` are dashed.
    """

    curves: Mapping[str, Mapping[str, NearestCurve]]
    images_m: Array
    nearest_m: Mapping[str, Array]
    left_out_m: Array
    baselines: Collection[str]


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard over annotations that draws were not made from: left out, or of held-out takes."""
    held_out = [
        manifest
        for manifest in inputs.of("annotations")
        if (facts := SequenceFacts.of(manifest)).is_held_out and facts.num_persons == 2
    ]
    learned, draws = annotated_pairs(inputs), draw_manifests(inputs)
    if not draws or not with_views(learned, inputs)["annotations"]:
        return []
    takes = takes_of(inputs, 2, or_more=True)
    return [TOPIC.shard(inputs, "images", draws=draws, takes=takes, **with_views([*learned, *held_out], inputs))]


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownLeaveOneOut]:
    """Measure how near draws come to images that they were not made from."""
    annotations, draw_refs = shard.refs("annotations"), shard.refs("draws")
    facts = SequenceFacts.read(store, annotations)
    used: dict[PairPlace, SeenPair] = {}
    unused: dict[str, dict[PairPlace, SeenPair]] = {"leave_one_out": {}, "held_out": {}}
    for fact, pairs in zip(facts, read_all_seen(store, shard, num_hypotheses=_NUM_HYPOTHESES), strict=True):
        for place, seen in pairs.items():
            group = unused["held_out"] if fact.is_held_out else unused["leave_one_out"] if seen.is_left_out else used
            group[place] = seen
    stills = {name for fact in facts for name in fact.why_no_video}
    unused["leave_one_out"] = _apart(unused["leave_one_out"], used, stills)
    truth = GroundTruth.read(store, shard.refs("takes"), annotations)
    if unused["held_out"]:
        refuse_learned(store, draw_refs, truth.held_out)
    generator = stream(shard.seed, "left_out", "draws")  # a label, not a name: another one draws others
    # In random order, so that every seed counts from the start.
    sets = read_draw_sets(store, draw_refs)
    baselines = (*baselines_of(sets), _NEAREST, _REAL)
    draws = {
        name: draw_set.pairs_m[generator.permutation(len(draw_set.pairs_m))[:_MAX_DRAWS]]
        for name, draw_set in sets.items()
    }
    if real := [pair.pair_m for pair in map(truth.pair, used) if pair is not None]:
        draws[_REAL] = np.array(real)[generator.permutation(len(real))].astype(np.float32)
    known = some_of(list(used.values()), _MAX_KNOWN)
    views = [seen.directions[0] for seen in some_of(list(used.values()), _NUM_VIEWS)]
    curves: dict[str, dict[str, NearestCurve]] = {}
    items = Items()
    for split, every in unused.items():
        chosen = some_of(list(every.values()), _NUM_JUDGED)
        if not chosen or not known:
            continue
        # The view of an image is estimated, with an error of 14 degrees: alone, real frames would lose to the
        # annotations.
        images, directions = _images(chosen), [np.concatenate([seen.directions, views]) for seen in chosen]
        curves[split] = {name: nearest_curve(images, directions, pairs) for name, pairs in draws.items()}
        curves[split][_NEAREST] = {len(known): np.nanmin(image_distances(images, _images(known)), axis=1)}
        # The last one counts: held-out takes if there are any, else images that draws were not made from.
        times = _takes_and_times(facts, truth, [seen.place for seen in chosen], stills)
        items = Items({name: list(curve.values())[-1] for name, curve in curves[split].items()}, *times)
    scores = [score for split, of_part in curves.items() for score in nearest_draw_scores(of_part, split=split)]
    mapped = [
        _images(some_of(list(group.values()), count))
        for group, count in ((used, _NUM_MAPPED), (unused["leave_one_out"], _NUM_UNUSED_MAPPED))
    ]
    shown = _ShownLeaveOneOut(curves, mapped[0], _nearest_annotations(store, draw_refs, used), mapped[1], baselines)
    return TopicResult(scores, _notes(unused, curves), {"": items} if curves else {}, baselines, shown)


def _draw(shown: _ShownLeaveOneOut) -> Iterator[Picture]:
    """Draw how near draws come as they grow in number, and a map of annotations unless they are all alike."""
    if shown.curves:
        caption = (
            "Distance from unused images to their nearest draw, seen by the camera of the image or of an "
            "annotation. Good: low. Dashed: the baselines, chains without annotations, and real pairs in "
            "place of draws, which need ground truth. Grey: the nearest image among those used. Left-out "
            "images are of the same sources; held-out images are of takes from which nothing was learned."
        )
        yield Picture("leave-one-out.svg", caption, nearest_draw_figure(shown.curves, shown.baselines))
    caption = (
        "A map of the annotations (Yin et al. 2018, fig. 5b): similar ones are close together; some are "
        "drawn as people. Coloured marks: the nearest annotations of the draws, larger for more draws. "
        "Crosses: left-out annotations. Good: marks lie all over the annotations, and near every cross."
    )
    with suppress(InputError):
        content = annotation_map_figure(shown.images_m, shown.nearest_m, shown.left_out_m)
        yield Picture("annotations-map.svg", caption, content)


def _takes_and_times(
    facts: Sequence[SequenceFacts], truth: GroundTruth, places: Sequence[PairPlace], stills: Collection[str]
) -> tuple[list[str], list[float]]:
    """Return the take of each image and its time there, seconds; each of a user's stills is a moment of its own."""
    rates_hz = {name: fact.rate_hz for fact in facts for name in fact.sequence_ids}
    takes, times_s = [], []
    for sequence_id, frame, *_ in places:
        if (sequence_id, frame) in truth.frames:
            takes.append(truth.frames[sequence_id, frame][0])
            times_s.append(truth.time_s(*truth.frames[sequence_id, frame]))
        else:
            takes.append(sequence_id)
            times_s.append(frame / (1.0 if sequence_id in stills else rates_hz[sequence_id]))
    return takes, times_s


def _notes(unused: Mapping[str, Collection[PairPlace]], curves: Collection[str]) -> list[str]:
    counts = [f"{len(unused[split])} {_WORDS[split]}" for split in curves]
    if not counts:
        return [
            "All annotations were used to make draws, so it is unknown how well draws generalise to other "
            "annotations. To leave some out, set `leave_one_out_every` of a source; the source needs more "
            "moments than half that number."
        ]
    return [f"Unused images: {' and '.join(counts)}; at most {_NUM_JUDGED} of each are judged."]


def _apart(
    left_out: Mapping[PairPlace, SeenPair], used: Collection[PairPlace], stills: Collection[str]
) -> dict[PairPlace, SeenPair]:
    """Return the frames of a video that are far enough from every used frame, and all stills."""
    frames: dict[str, list[int]] = {}
    for place in used:
        if place.sequence_id not in stills:
            frames.setdefault(place.sequence_id, []).append(place.frame)
    return {
        place: seen
        for place, seen in left_out.items()
        if np.abs(np.array(frames.get(place.sequence_id, [])) - place.frame).min(initial=_MIN_APART) >= _MIN_APART
    }


def _images(pairs: Sequence[SeenPair]) -> Array:
    """Return the images (n, 2, 17, 2) of annotations, metres."""
    return np.array([seen.image_m for seen in pairs])


def nearest_curve(
    images_m: Iterable[Array], directions: Sequence[Array], pairs_m: npt.NDArray[np.floating]
) -> NearestCurve:
    """Return the least distance of draws to images as a function of the number of draws.

    Args:
        images_m: Images (person=2, joint=17, 2), metres; NaN where a joint is not seen.
        directions: View hypotheses of each, (view, 3): the best one counts.
        pairs_m: Draws in the order in which they count, (draw, person=2, joint=17, 3), metres, at least one.
    """
    nearest: dict[int, Array] = {}
    least = np.full(len(directions), np.inf)
    for count in [*(count for count in _COUNTS if count < len(pairs_m)), len(pairs_m)]:
        index = DrawIndex(pairs_m[:count])
        near = [nearest_by_image(index, *seen)[1][0] for seen in zip(images_m, directions, strict=True)]
        # The nearest among few draws is one of many, too: computing d_I for some draws only must not lose it.
        nearest[count] = least = np.minimum(least, near)
    return nearest


def nearest_draw_scores(curves: Mapping[str, NearestCurve], *, split: str) -> list[Score]:
    """Return the least distance of each method's draws to the annotations, for all draws and by their number."""
    scores = summarise({name: list(curve.values())[-1] for name, curve in curves.items()}, _METRIC, "m", split=split)
    for method, curve in curves.items():
        points = curve.items() if len(curve) > 1 else ()
        scores += [
            Score(_METRIC, method, float(near.mean()), "m", split=split, at=float(at), count=len(near))
            for at, near in points
        ]
    return scores


def nearest_draw_figure(curves: Mapping[str, Mapping[str, NearestCurve]], baselines: Collection[str] = ()) -> bytes:
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
                baselines,
                {name: float(mean[0]) for name, (at, mean) in means.items() if len(at) == 1},
            )
        )
    return curve_figure(panels, title="unused images", x_label="draws, or real frames", is_log=True)


def _nearest_annotations(
    store: Store, draw_refs: Sequence[ArtifactRef], used: Mapping[PairPlace, SeenPair]
) -> dict[str, Array]:
    """Return the annotation (m, 2, 17, 2) that each draw is nearest to, metres, by density in order."""
    images = {place[:3]: seen.image_m for place, seen in used.items()}
    nearest: dict[str, list[Array]] = {}
    names = ["sequence_id", "sequence_frame", "sequence_person_id"]
    for ref in draw_refs:
        manifest = store.manifest(ref)
        if "draws" in manifest.tables:
            table = store.read(ref, "draws", columns=names)
            places = zip(*(table[name].tolist() for name in names), strict=True)
            nearest.setdefault(density_of(manifest), []).extend(images[place] for place in places if place in images)
    return {
        name: np.stack(images_of_density) for name, images_of_density in sorted(nearest.items()) if images_of_density
    }


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
    for method, images in nearest.items():
        spots, count = np.unique(images, axis=0, return_counts=True)
        label = f"nearest to draws: {in_words(method)}"
        size = 12.0 + 150.0 * count / count.sum()
        colour, marker = method_style(method)
        axis.scatter(
            *(100 * plane.place(spots).T), s=size, alpha=0.6, color=colour, marker=marker, label=label, **CLOUD
        )
    if len(left_out_m):
        axis.plot(*(100 * plane.place(left_out_m).T), "kx", markersize=4, linestyle="none", label="left out")
    scale = _DRAWN_SHARE * 100 * float(np.ptp(plane.places[:, 0])) / 1.7
    for at in _far_apart(plane.places, _NUM_DRAWN):
        draw_pair(axis, scale * images_m[at], 100 * plane.places[at])
    axis.tick_params(labelsize=6)
    fit_map(figure, axis, scale=5.6, limits=(2.4, 7.0))
    axis.set_xlabel("cm of distance between images", fontsize=7)
    legend_beside(axis)
    return figure_svg(
        figure, title=f"annotations, similar ones close together ({plane.share:.0%} of the variance shown)"
    )


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
    introduction="A check that needs no ground truth. Some images take no part in making the draws; good draws include "
    "one that looks like each of these images. Distances are between images (d_I of Yin et al. 2018).",
    reads=("annotations", "views", "draws", "seeds", "poses"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    criteria=(Criterion(f"{_METRIC}_mean", "distance from left-out images to the nearest draw", "m", "images"),),
)
