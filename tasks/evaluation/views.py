"""Topic `views`: estimated views against the true cameras of virtual video."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.cameras.frames import true_direction
from pasdedeux.evaluation.figures import view_figure
from pasdedeux.evaluation.scores import Score
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.evaluation.views import VIEW_BASELINES, view_errors, view_scores
from storage_schema import Store, TableData
from tasks.annotated_pairs import PLACE_COLUMNS, place_of
from tasks.evaluation.ground_truth import read_cameras, read_rates, read_take_frames, read_takes, true_pair
from tasks.evaluation.topic import Topic, TopicResult
from tasks.facts import SequenceFacts, ViewFacts
from tasks.stage import Parameters, Shard, StageInputs


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard over all views that were estimated."""
    estimated = inputs.of("views")
    if not estimated:
        return []
    known = {ref for manifest in estimated for ref in manifest.inputs}
    annotations = [manifest for manifest in inputs.of("annotations") if manifest.ref in known]
    return [TOPIC.shard(inputs, "accuracy", views=estimated, annotations=annotations, takes=inputs.of("poses"))]


def _run(shard: Shard, store: Store) -> TopicResult:
    """Score and draw the views."""
    views = [store.read(ref, "views") for ref in shard.refs("views")]
    annotated = shard.refs("annotations")
    takes = read_takes(store, shard.refs("takes"), "pair17_m")
    cameras, frames = read_cameras(store, annotated), read_take_frames(store, annotated)
    held_out = {take for facts in SequenceFacts.read(store, annotated) if facts.is_held_out for take in facts.takes}
    rates = read_rates(store, shard.refs("takes"))
    scores: list[Score] = []
    items = Items()
    for split in ("annotated", "held_out"):
        rows = [
            (table, start, stop, truth[1])
            for table in views
            for start, stop in _annotations(table)
            if (truth := true_pair(place_of(table, start), frames, takes)) is not None
            and (truth[0] in held_out) == (split == "held_out")
        ]
        if rows:
            estimated, weight = _hypotheses(rows)
            true = np.stack([true_direction(pair, cameras[t["sequence_id"][start]]) for t, start, _, pair in rows])
            scores += view_scores(estimated, weight, true, split=split)
            if split == "held_out":
                at = [frames[place.sequence_id, place.frame] for t, start, *_ in rows for place in [place_of(t, start)]]
                times_s = [frame / rates[take] for take, frame in at]
                takes_of = [take for take, _ in at]
                items = Items(view_errors(estimated, weight, true), takes_of, times_s, VIEW_BASELINES)
    psi, phi, weights = (np.concatenate([table[name] for table in views]) for name in ("psi_rad", "phi_rad", "weight"))
    picture = view_figure(psi, phi, weights, title="estimated views (size: weight of the hypothesis)")
    skipped = [note for facts in ViewFacts.read(store, shard.refs("views")) for note in facts.skipped]
    return TopicResult(
        scores=scores,
        pictures={"views.svg": picture},
        captions={
            "views.svg": "From where images may have been seen: psi goes around the pair, phi from straight above (0) "
            "by level with the pair (1.6) to straight below (3.1). Each dot is a guess, larger where it is likelier "
            "(Yin et al. 2018, fig. 4b). Better: a few tight clusters for each camera, not a haze."
        },
        items={"": items} if scores else {},
        notes=[*skipped, *([] if scores else ["No true camera is known here, so views have no error."])],
    )


def _annotations(table: TableData) -> list[tuple[int, int]]:
    """Return the row range of each annotation's hypotheses."""
    if not table.num_rows:
        return []
    is_new = np.any([table[name][1:] != table[name][:-1] for name in PLACE_COLUMNS], axis=0)
    starts = np.concatenate([[0], np.nonzero(is_new)[0] + 1])
    return list(zip(starts.tolist(), [*starts[1:].tolist(), table.num_rows], strict=True))


def _hypotheses(rows: Sequence[tuple[TableData, int, int, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (annotation, hypothesis, 3), NaN where there are fewer, and weights, 0 there."""
    most = max(stop - start for _, start, stop, _ in rows)
    directions, weights = np.full((len(rows), most, 3), np.nan), np.zeros((len(rows), most))
    for index, (table, start, stop, _) in enumerate(rows):
        directions[index, : stop - start] = table["direction"][start:stop]
        weights[index, : stop - start] = table["weight"][start:stop]
    return directions, weights


TOPIC = Topic(
    name="views",
    heading="Views",
    introduction="From which direction each image was taken, guessed from the people in it. Where the camera is known, "
    "as of virtual video, guesses are compared with it; the trivial way says the same direction for every image.",
    reads=("views", "annotations", "cameras", "poses"),
    plan=_plan,
    run=_run,
    criteria=(Criterion("view_error_mean", "error of the view", "degrees", "images", ("heaviest_hypothesis",)),),
)
