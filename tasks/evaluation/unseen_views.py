"""Topic `parallel_views`: held-out takes seen from several directions, by every method (Yiannakides et al. 2019)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.evaluation.motion_players import reconstruction_player
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.pictures import Picture
from pasdedeux.evaluation.score_tables import TextTable, format_value
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.projections.sources import resample_positions
from pasdedeux.reconstruction.errors import (
    foot_slide_m,
    jitter_m,
    root_centred_error_m,
    root_removed_error_m,
)
from pasdedeux.reconstruction.matching import Method, Searcher
from pasdedeux.reconstruction.unseen_views import (
    BEST,
    CONDITIONS,
    STILL,
    Condition,
    UnseenMotion,
    ViewedMotion,
    reconstruct_seen,
    see,
)
from storage_schema import Store
from tasks.evaluation.topic import Topic, TopicResult, refuse_overlap
from tasks.projections import clusters_of, read_clusters, read_database
from tasks.rows.takes import read_motion
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import Facts, TakeFacts, merge_takes
from tasks.stage.streams import stream

_BASELINES = (Method.NEAREST.value, BEST, STILL, "truth")
"""Methods that others are compared with, bounds among them."""
_ALL_VIEWS = "mean of views"
_STATED = {
    _ALL_VIEWS: ("9.4 cm", "-"),
    "75 degrees apart": ("6.8 cm", "15.2 cm"),
    "135 degrees apart": ("12.6 cm", "16.4 cm"),
}
"""Figures of Yiannakides et al. 2019, section 6.2, for their method and VNect, by the ending of an item."""
_SHOWN_S = 4.0
_COMPARED = ("published", "published_clean", "nearest", "window", "viterbi", "fit", "fit_clean", "live", STILL)


class UnseenViewsSettings(Parameters):
    """Views of the motions."""

    unseen_views_deg: tuple[float, ...] = Field(
        (),
        description="Directions from which held-out takes are seen and reconstructed by every method, on the body of "
        "the projection database and by parallel rays, as in the paper",
    )


class UnseenTakeParameters(Parameters):
    """One take in one condition, by number."""

    take_id: str
    unseen_views_deg: tuple[float, ...]
    condition: int = 0


def _plan(inputs: StageInputs, settings: UnseenViewsSettings) -> list[Shard]:
    """Plan one shard per held-out take and condition, with the database parts that have not seen the take."""
    shards = []
    for take in inputs.of("poses") if settings.unseen_views_deg else ():
        take_id = TakeFacts.of(take).take_id
        parts = [part for part in inputs.of("projections") if take_id not in Facts.of(part).takes]
        if not (TakeFacts.of(take).is_held_out and parts):
            continue
        clusters, parts = clusters_of(inputs, parts)
        shards += [
            PARALLEL_VIEWS.shard(
                inputs,
                f"{take_id}-{number}",
                settings.part(UnseenTakeParameters, take_id=take_id, condition=number),
                take=[take],
                parts=parts,
                clusters=clusters,
            )
            for number in range(len(CONDITIONS))
        ]
    return shards


class _ShownUnseenViews(NamedTuple):
    """A motion in words, with its first seconds as seen by a camera and as fitted, (frame, 14, 3) in camera axes."""

    item: str
    condition: str
    rate_hz: float
    seen: ViewedMotion
    found_m: Array


def _compute(shard: Shard, store: Store) -> TopicResult[Sequence[_ShownUnseenViews]]:
    """Score one take in one condition."""
    options = shard.options(UnseenTakeParameters)
    searcher = _database(shard, store)
    condition = CONDITIONS[options.condition]
    scores: list[Score] = []
    parts: list[Items] = []
    shown: list[_ShownUnseenViews] = []
    for person, motion in enumerate(_people(shard, store, searcher.database.rate_hz)):
        labels = ("evaluation", PARALLEL_VIEWS.name, options.take_id, person, options.condition)
        draw = partial(stream, shard.seed, *labels)
        made_m, errors = unseen_view_scores(searcher, motion, condition, draw)
        scores += made_m
        parts.append(replace(errors, takes=[options.take_id] * len(errors.takes)))
        if options.condition == 0:
            start = replace(motion, world_m=motion.world_m[: round(_SHOWN_S * motion.rate_hz)])
            seen = see(start, condition, motion.yaws_deg[0], draw(0))
            fit = reconstruct_seen(searcher, seen, has_clean_up=False)[Method.FIT.value]
            shown.append(_ShownUnseenViews(motion.item, condition.name, motion.rate_hz, seen, fit))
    note = (
        f"{options.take_id} against {searcher.database.num_projections:,} projections; `best_of_50` is a "
        "bound: it knows the ground truth."
    )
    return TopicResult(scores, [note], {"": Items.joined(parts)}, _BASELINES, shown)


def _draw(shown: Sequence[_ShownUnseenViews]) -> Iterator[Picture]:
    """Show the fit beside its image."""
    for motion in shown:
        name = f"{PARALLEL_VIEWS.name}-{motion.item.replace(' ', '-')}.player.json"
        paper = "Yiannakides et al. 2019, fig. 8"
        caption = f"{motion.item}, {motion.condition}: 2D poses and the fit ({paper}), seen by the camera."
        player = reconstruction_player(
            motion.found_m[:, None],
            rate_hz=motion.rate_hz,
            keypoints_px=motion.seen.track.keypoints_px[:, None],
            truth_m=motion.seen.truth_m[:, None],
        )
        yield Picture(name, caption, player)


def unseen_view_scores(
    searcher: Searcher, motion: UnseenMotion, condition: Condition, stream: Callable[[int], np.random.Generator]
) -> tuple[list[Score], Items]:
    """Score every method on a motion seen from several directions, and how far its reconstructions differ.

    The items are the errors of all poses, the root kept.

    The database has not seen the motion and has a level camera; `stream` gives the random stream of a view.
    """
    figures: dict[tuple[str, str], list[float]] = {}
    motions: dict[str, list[Array]] = {}
    parts: list[Items] = []
    for view, yaw in enumerate(motion.yaws_deg):
        seen = see(motion, condition, yaw, stream(view))
        errors: dict[str, Array] = {}
        times_s = np.arange(len(seen.truth_m)) / motion.rate_hz
        for method, positions in reconstruct_seen(searcher, seen, has_clean_up=True).items():
            errors[method] = root_centred_error_m(positions, seen.truth_m)
            motions.setdefault(method, []).append(positions)
            slide_hz = motion.rate_hz if method not in (BEST, STILL) else None
            for metric, value in _figures(positions, seen.truth_m, rate_hz=slide_hz).items():
                figures.setdefault((metric, method), []).append(value)
        parts.append(Items(errors, [motion.item] * len(times_s), times_s))
        for metric in ("jitter", "foot_slide"):
            value = _figures(seen.truth_m, seen.truth_m, rate_hz=motion.rate_hz)[metric]
            figures.setdefault((metric, "truth"), []).append(value)
    item, count = motion.item, len(motion.world_m)
    scores = []
    for (metric, method), values in figures.items():
        named = [(f"{item} at {yaw:g} degrees", value) for yaw, value in zip(motion.yaws_deg, values, strict=True)]
        named += [(f"{item}, {_ALL_VIEWS}", float(np.mean(values)))] if len(values) > 1 else []
        scores += [
            Score(metric, method, value, "m", split=condition.name, item=label, count=count) for label, value in named
        ]
    for method, views_m in motions.items():
        for yaw, other in zip(motion.yaws_deg[1:], views_m[1:], strict=True):
            differs = {"two_views_differ": _mean(root_removed_error_m(views_m[0], other))}
            label = f"{item}, views {abs(yaw - motion.yaws_deg[0]):g} degrees apart"
            scores += scores_of(differs, method, "m", split=condition.name, item=label, count=count)
    return scores, Items.joined(parts)


def paper_table(scores: Sequence[Score]) -> list[TextTable]:
    """Return the figures that the paper states beside ours, and VNect's as the paper has them; none without scores."""
    shown = {(score.item, score.metric, score.method): score.value for score in scores if score.split == "clean"}
    methods = [method for method in _COMPARED if any(method == scored for _, _, scored in shown)]
    rows = [
        (
            item,
            *next(stated for end, stated in _STATED.items() if item.endswith(end)),
            *(format_value(shown.get((item, metric, method), float("nan")), "m") for method in methods),
        )
        for item, metric in dict.fromkeys((item, metric) for item, metric, _ in shown)
        if metric in ("error_root_kept", "two_views_differ") and item.endswith(tuple(_STATED))
    ]
    caption = (
        "Images without noise: mean joint error with the root kept, and the difference between two views "
        "with the root removed, beside the figures of Yiannakides et al. (2019, section 6.2) for other "
        "motions, and those it gives for VNect. Standing still is the same from every view."
    )
    return [TextTable(caption, ("motion", "paper", "VNect", *map(in_words, methods)), tuple(rows))] if rows else []


def _figures(made_m: Array, truth: Array, *, rate_hz: float | None) -> dict[str, float]:
    """Return errors of a motion, and how far its feet slide where a rate is given (its trajectory must be known)."""
    known = made_m[np.isfinite(made_m).all(axis=(1, 2))]
    centred = known - mid_hip(known)[:, None]
    figures = {
        "error_root_kept": _mean(root_centred_error_m(made_m, truth)),
        "error_root_removed": _mean(root_removed_error_m(made_m, truth)),
        "jitter": jitter_m(centred),
    }
    return figures if rate_hz is None else {**figures, "foot_slide": foot_slide_m(made_m, truth, rate_hz=rate_hz)}


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _database(shard: Shard, store: Store) -> Searcher:
    """Return the database of the shard's parts."""
    parts = shard.refs("parts")
    take_id = shard.options(UnseenTakeParameters).take_id
    refuse_overlap("the projection database", merge_takes(*map(store.manifest, parts)), [take_id])
    database, _, _ = read_database(store, parts)
    # To compare with the paper, parallel rays see the database too, whatever the study's camera.
    clusters = (read_clusters(store, ref) for ref in shard.refs("clusters"))
    return Searcher.of(replace(database, camera=DatabaseCamera()), *clusters)


def _people(shard: Shard, store: Store, rate_hz: float) -> list[UnseenMotion]:
    """Return the motion of every person of the shard's take at the database's rate."""
    take, options = shard.ref("take"), shard.options(UnseenTakeParameters)
    people = read_motion(store, take, "op14_m")["op14_m"]
    from_hz = TakeFacts.of(store.manifest(take)).rate_hz
    return [
        UnseenMotion(
            options.take_id if people.shape[1] == 1 else f"{options.take_id} person {person}",
            resample_positions(people[:, person], from_hz=from_hz, to_hz=rate_hz),
            rate_hz,
            options.unseen_views_deg,
        )
        for person in range(people.shape[1])
    ]


PARALLEL_VIEWS = Topic(
    name="parallel_views",
    heading="Unseen motion, parallel rays",
    introduction="Held-out motion on the body of the projection database, seen by parallel rays as in Yiannakides et "
    "al. 2019: errors of every method, and the difference between reconstructions from two views (root "
    "rotation removed). `_clean` is the method followed by the clean-up; `live` gives each frame six "
    "frames after its image.",
    reads=("poses", "projections", "projection_clusters"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    settings=UnseenViewsSettings,
    tabulate=lambda scores: paper_table(scores.get("parallel_views", ())),
    criteria=(Criterion("error_root_kept", "mean joint error", "m", "poses", (Method.FIT.value,)),),
)
