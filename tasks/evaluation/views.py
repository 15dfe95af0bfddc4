"""Topic `views`: estimated views against the true cameras of virtual video."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.cameras.frames import angle_between_directions, true_direction
from pasdedeux.evaluation.pictures import CLOUD, Picture, figure_svg, label_axis, new_figure
from pasdedeux.evaluation.scores import summarise
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.kinematics.rotations import normalise
from storage_schema import Store, TableData
from tasks.evaluation.ground_truth import GroundTruth, TruePair
from tasks.evaluation.topic import Topic, TopicResult
from tasks.rows.annotated_pairs import PLACE_COLUMNS, place_of
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import ViewFacts


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard over all views that were estimated."""
    estimated = inputs.of("views")
    if not estimated:
        return []
    known = {ref for manifest in estimated for ref in manifest.inputs}
    annotations = [manifest for manifest in inputs.of("annotations") if manifest.ref in known]
    return [TOPIC.shard(inputs, "accuracy", views=estimated, annotations=annotations, takes=inputs.of("poses"))]


class _ShownViews(NamedTuple):
    """Hypotheses of all views (hypothesis,): angles and weights."""

    psi_rad: Array
    phi_rad: Array
    weight: Array


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownViews]:
    """Score the views."""
    truth = GroundTruth.read(store, shard.refs("takes"), shard.refs("annotations"))
    tables = [store.read(ref, "views") for ref in shard.refs("views")]
    known: dict[str, list[tuple[TruePair, Array, tuple[Array, Array]]]] = {}
    for table in tables:
        for rows in _annotations(table):
            place = place_of(table, rows.start)
            if (pair := truth.pair(place)) is not None:
                split = "held_out" if pair.take_id in truth.held_out else "annotated"
                direction = true_direction(pair.pair_m, truth.cameras[place.sequence_id])
                hypotheses = table["direction"][rows].astype(np.float64), table["weight"][rows]
                known.setdefault(split, []).append((pair, direction, hypotheses))
    scores, items = [], Items()
    for split, annotated in known.items():
        pairs, directions, hypotheses = zip(*annotated, strict=True)
        errors = view_errors(hypotheses, np.stack(directions))
        scores += summarise(errors, "view_error", "degrees", split=split)
        if split == "held_out":
            items = Items(errors, [pair.take_id for pair in pairs], [pair.time_s for pair in pairs])
    skipped = [note for facts in ViewFacts.read(store, shard.refs("views")) for note in facts.skipped]
    notes = [*skipped, *([] if scores else ["No true camera is known, so the error of views cannot be measured."])]
    shown = _ShownViews(*(np.concatenate([table[name] for table in tables]) for name in _ShownViews._fields))
    return TopicResult(scores, notes, {"": items} if scores else {}, ("mean_view",), shown)


def _draw(shown: _ShownViews) -> Iterator[Picture]:
    """Draw all hypotheses."""
    caption = (
        "Estimated view directions (Yin et al. 2018, fig. 4b): horizontally around the pair, vertically "
        "from above (0 degrees) to below (180). Each dot is a hypothesis; larger dots have more weight. "
        "Good: a few tight clusters for each camera."
    )
    yield Picture("views.svg", caption, view_figure(*shown))


def view_errors(hypotheses: Sequence[tuple[Array, Array]], truth: Array) -> dict[str, Array]:
    """Return the angle to the true view (annotation,), degrees, by method.

    Args:
        hypotheses: Of each annotation, view directions (hypothesis, 3) in the pair's frame and their weights.
        truth: True view directions (annotation, 3).
    """
    heaviest = np.stack([views[np.argmax(weights)] for views, weights in hypotheses])
    mean_view = np.broadcast_to(normalise(heaviest.mean(axis=0)), truth.shape)
    best = [
        angle_between_directions(views, np.broadcast_to(true, views.shape)).min()
        for (views, _), true in zip(hypotheses, truth, strict=True)
    ]
    angles = {
        "heaviest_hypothesis": angle_between_directions(heaviest, truth),
        "best_hypothesis": np.array(best),
        "mean_view": angle_between_directions(mean_view, truth),
    }
    return {method: np.rad2deg(radians) for method, radians in angles.items()}


def view_figure(psi_rad: Array, phi_rad: Array, weight: Array) -> bytes:
    """Draw view hypotheses (n,) over psi and phi, size by weight, as in Yin et al. 2018, fig. 4b; give SVG bytes."""
    figure, ((axis,),) = new_figure(5.6, 3.2)
    axis.scatter(
        np.rad2deg(psi_rad),
        np.rad2deg(phi_rad),
        s=1.0 + 12.0 * np.asarray(weight),
        alpha=0.35,
        color="#1f5fa8",
        **CLOUD,
    )
    axis.set_xlim(-180, 180)
    axis.set_ylim(180, 0)
    label_axis(axis, "direction around the pair (degrees)", "angle from above (degrees)")
    return figure_svg(figure, title="estimated views (size: weight of the hypothesis)")


def _annotations(table: TableData) -> list[slice]:
    """Return the rows of each annotation's hypotheses."""
    if not table.num_rows:
        return []
    is_new = np.any([table[name][1:] != table[name][:-1] for name in PLACE_COLUMNS], axis=0)
    ends = [0, *(np.flatnonzero(is_new) + 1).tolist(), table.num_rows]
    return [slice(*ends[at : at + 2]) for at in range(len(ends) - 1)]


TOPIC = Topic(
    name="views",
    heading="Views",
    introduction="The camera direction of each image, estimated from the people in it and compared with the true "
    "camera of virtual video. The baseline is one direction for all images.",
    reads=("views", "annotations", "cameras", "poses"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    criteria=(Criterion("view_error_mean", "error of the view", "degrees", "images", ("heaviest_hypothesis",)),),
)
