"""Topics of reconstruction from several directions.

`parallel_views` and `pinhole_views`: held-out takes, by every method.  `left_out_clips`: each take of the database
against the rest of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from pydantic import Field

from pasdedeux.evaluation.figures import Curve, curve_figure
from pasdedeux.evaluation.reconstruction import reconstruction_player
from pasdedeux.evaluation.scores import Score
from pasdedeux.evaluation.verdicts import Yardstick
from pasdedeux.experiments.published_search import Codebook
from pasdedeux.experiments.unseen_views import (
    CONDITIONS,
    Condition,
    Setting,
    Tried,
    UnseenMotion,
    level_scores,
    reconstruct_seen,
    see,
    unseen_view_scores,
)
from pasdedeux.projections.camera import OrthographicCamera
from pasdedeux.projections.sources import resample_positions
from pasdedeux.reconstruction.reconstruct import Method, Searcher
from storage_schema import Manifest, Store
from tasks.evaluation.topic import Topic, TopicResult, read_people, refuse_overlap
from tasks.reconstruction import read_database
from tasks.stage import Parameters, Shard, StageInputs, stream

__all__ = ["LEFT_OUT_CLIPS", "PARALLEL_VIEWS", "PINHOLE_VIEWS"]

_LEVELS = {"noise": (0.0, 0.01, 0.03, 0.06, 0.1, 0.2), "missing": (0.0, 0.1, 0.3, 0.5, 0.7)}
_LEVEL_LABELS = {
    "noise": "noise of each coordinate, part of the torso",
    "missing": "share of the joints that are missing",
}
_CURVE_METHODS = (Method.NEAREST, Method.WINDOW, Method.VITERBI, Method.FIT)
_LEFT_OUT_METHODS = (Method.NEAREST, Method.VITERBI, Method.FIT)


class UnseenViewsSettings(Parameters):
    """From where motions are seen, and what is done to their images."""

    unseen_views_deg: tuple[float, ...] = Field(
        (),
        description="Directions from which held-out takes are seen and reconstructed by every method: on the "
        "projection database's body by parallel rays, as in the paper on it, and on their own by a pinhole",
    )
    has_unseen_view_sweeps: bool = Field(
        False, description="Also at growing noise and with more and more joints missing, from the same directions"
    )
    has_left_out_clips: bool = Field(
        False, description="Each take of the projection database against the rest of it, from the same directions"
    )


class TakeParameters(Parameters):
    """One take in one condition (of the setting's, by number), or at growing levels of noise or missing joints."""

    take_id: str
    unseen_views_deg: tuple[float, ...]
    step: str = "condition"
    condition: int = 0


def _plan_setting(setting: Setting, inputs: StageInputs, settings: UnseenViewsSettings) -> list[Shard]:
    """Plan one shard per held-out take and condition, with the database parts that have not seen the take."""
    steps: list[tuple[str, int]] = [("condition", number) for number in range(len(CONDITIONS[setting]))]
    steps += [(kind, 0) for kind in _LEVELS] if settings.has_unseen_view_sweeps else []
    return [
        _SETTINGS[setting].shard(
            inputs,
            f"{take_id}-{kind}" + (f"-{number}" if kind == "condition" else ""),
            settings.part(TakeParameters, take_id=take_id, step=kind, condition=number),
            take=[take],
            parts=parts,
            # A codebook is of use with exactly the parts it numbers.
            codebook=_books(inputs, parts) if kind == "condition" else [],
        )
        for take_id, take, parts in _takes(inputs, settings, is_held_out=True)
        for kind, number in steps
    ]


def _plan_left_out(inputs: StageInputs, settings: UnseenViewsSettings) -> list[Shard]:
    """Plan one shard per take of the database, with the parts that have not seen it."""
    if not settings.has_left_out_clips:
        return []
    return [
        LEFT_OUT_CLIPS.shard(
            inputs,
            take_id,
            settings.part(TakeParameters, take_id=take_id),
            take=[take],
            parts=parts,
        )
        for take_id, take, parts in _takes(inputs, settings, is_held_out=False)
    ]


def _takes(
    inputs: StageInputs, settings: UnseenViewsSettings, *, is_held_out: bool
) -> Iterator[tuple[str, Manifest, list[Manifest]]]:
    """Yield the takes that are asked for and the parts of the database that have not seen each; none without any."""
    for take in inputs.of("poses") if settings.unseen_views_deg else ():
        take_id = str(take.facts["take_id"])
        parts = [part for part in inputs.of("projections") if take_id not in part.facts["takes"]]
        if take.facts["is_held_out"] == is_held_out and parts:
            yield take_id, take, parts


def _run(shard: Shard, store: Store) -> TopicResult:
    """Score one take in one setting: a condition, or a sweep of growing levels."""
    setting, options = Setting(shard.partition), shard.options(TakeParameters)
    searcher, codebook, rate_hz = _database(shard, store, setting)
    scores: list[Score] = []
    pictures: dict[str, bytes] = {}
    captions: dict[str, str] = {}
    for person, motion in enumerate(_people(shard, store, rate_hz)):
        labels = ("evaluation", setting.value, options.take_id, person, options.step, options.condition)
        draw = partial(stream, shard.seed, *labels)
        name = f"{setting.value}-{motion.item.replace(' ', '-')}"
        if options.step != "condition":
            what = _LEVEL_LABELS[options.step]
            points = level_scores(
                searcher,
                motion,
                setting,
                kind=options.step,
                levels=_LEVELS[options.step],
                methods=_CURVE_METHODS,
                stream=draw,
            )
            scores += points
            name = f"{name}-{options.step}.svg"
            pictures[name] = _curves(points, f"{motion.item}, {setting.value}", what)
            captions[name] = f"{motion.item}: mean error over the views, root rotation kept, against {what}."
            continue
        condition = CONDITIONS[setting][options.condition]
        tried = Tried(codebook=codebook, has_clean_up=True, has_live=True)
        scores += unseen_view_scores(searcher, motion, setting, condition, tried, draw)
        if options.condition == 0:
            name = f"{name}.player.json"
            pictures[name] = _clip(searcher, motion, setting, condition, draw(0))
            captions[name] = (
                f"{motion.item}, {condition.name}: the image, and the fit, first as the camera sees it; truth in grey."
            )
    note = (
        f"{options.take_id} against {searcher.database.num_projections:,} projections; best_of_50 is "
        "a mark that knows the truth."
    )
    notes = [note] if options.step == "condition" else []
    return TopicResult(scores=scores, pictures=pictures, captions=captions, notes=notes)


def _run_left_out(shard: Shard, store: Store) -> TopicResult:
    """Score a take of the database against the rest of the database, by parallel rays."""
    take_id = shard.options(TakeParameters).take_id
    searcher, _, rate_hz = _database(shard, store, Setting.PARALLEL)
    scores: list[Score] = []
    for person, motion in enumerate(_people(shard, store, rate_hz)):
        for number, condition in enumerate(CONDITIONS[Setting.PARALLEL][:2]):
            draw = partial(stream, shard.seed, "evaluation", LEFT_OUT_CLIPS.name, take_id, person, number)
            tried = Tried(_LEFT_OUT_METHODS)
            scores += unseen_view_scores(searcher, motion, Setting.PARALLEL, condition, tried, draw)
    return TopicResult(scores=scores)


def _books(inputs: StageInputs, parts: Sequence[Manifest]) -> list[Manifest]:
    keys = {part.ref.key for part in parts}
    return [book for book in inputs.of("codebook") if set(book.facts["part_keys"]) == keys]


def _database(shard: Shard, store: Store, setting: Setting) -> tuple[Searcher, Codebook | None, float]:
    """Return the database of the shard's parts, in the order of the codebook where there is one, and its rate."""
    parts, books = shard.refs("parts"), shard.refs("codebook")
    used = [store.manifest(part).facts for part in parts]
    take_id = shard.options(TakeParameters).take_id
    refuse_overlap("the projection database", [name for one in used for name in one["takes"]], [take_id])
    codebook = None
    if books:
        by_key = {part.key: part for part in parts}
        parts = tuple(by_key[key] for key in store.manifest(books[0]).facts["part_keys"])
        table = store.read(books[0], "codebook")
        codebook = Codebook(np.asarray(table["representative_m"]), tuple(np.asarray(one) for one in table["members"]))
    database, _, _ = read_database(store, parts)
    if setting is Setting.PARALLEL:
        # Parallel views compare with the paper, so parallel rays see the database too, whatever the study's camera.
        database = replace(database, camera=OrthographicCamera())
    return Searcher.of(database), codebook, database.rate_hz


def _people(shard: Shard, store: Store, rate_hz: float) -> list[UnseenMotion]:
    """Return the motion of every person of the shard's take at the database's rate."""
    take, options = shard.ref("take"), shard.options(TakeParameters)
    people = read_people(store, take, "op14_m")
    from_hz = float(store.manifest(take).facts["rate_hz"])
    return [
        UnseenMotion(
            options.take_id if people.shape[1] == 1 else f"{options.take_id} person {person}",
            resample_positions(people[:, person], from_hz=from_hz, to_hz=rate_hz),
            rate_hz,
            options.unseen_views_deg,
        )
        for person in range(people.shape[1])
    ]


def _curves(points: Sequence[Score], title: str, x_label: str) -> bytes:
    curves = []
    for method in dict.fromkeys(point.method for point in points):
        own = [point for point in points if point.method == method]
        at, error_cm = np.array([(point.at, 100.0 * point.value) for point in own]).T
        curves.append(Curve(method, at, error_cm, is_baseline=own[0].is_baseline))
    return curve_figure(curves, title=title, x_label=x_label, y_label="error (cm)")


def _clip(
    searcher: Searcher, motion: UnseenMotion, setting: Setting, condition: Condition, rng: np.random.Generator
) -> bytes:
    start = replace(motion, world_m=motion.world_m[: round(4.0 * motion.rate_hz)])
    seen = see(start, setting, condition, motion.yaws_deg[0], rng)
    made, _ = reconstruct_seen(searcher, seen, Tried((Method.FIT,)))
    return reconstruction_player(
        made[Method.FIT.value][:, None],
        rate_hz=motion.rate_hz,
        keypoints_px=seen.track.keypoints_px[:, None],
        truth_m=seen.truth_m[:, None],
    )


_READS = ("poses", "projections", "codebook")
_METRICS = ("error_*", "jitter", "foot_slide", "recall_at_*", "two_views_differ")
_YARDSTICKS = (Yardstick("error_root_kept", "mean joint error", (Method.NEAREST.value,), (Method.FIT.value,)),)

PARALLEL_VIEWS = Topic(
    name=Setting.PARALLEL.value,
    heading="Unseen motion, parallel rays",
    introduction="Held-out motion on the body of the projection database, seen by parallel rays: errors of every "
    "method, and how far reconstructions from two views differ (root rotation removed), as in the paper on such "
    "databases. `_clean` is the method with the clean-up after it; `live` leaves frame by frame, six frames after its "
    "image.",
    reads=_READS,
    plan=partial(_plan_setting, Setting.PARALLEL),
    run=_run,
    metrics=_METRICS,
    settings=UnseenViewsSettings,
    yardsticks=_YARDSTICKS,
)

PINHOLE_VIEWS = Topic(
    name=Setting.PINHOLE.value,
    heading="Unseen motion, pinhole",
    introduction="The same motion on its own body before a pinhole at 4 m; proportions and scale are estimated from "
    "the track, and the lens is assumed, as it is with video of one's own. Where the height of the camera over the "
    "floor is known, the floor says how large the person is.",
    reads=_READS,
    plan=partial(_plan_setting, Setting.PINHOLE),
    run=_run,
    metrics=_METRICS,
    settings=UnseenViewsSettings,
    yardsticks=_YARDSTICKS,
)

LEFT_OUT_CLIPS = Topic(
    name="left_out_clips",
    heading="Clips left out",
    introduction="Each take of the projection database on the database's body by parallel rays, reconstructed from "
    "the rest.",
    reads=_READS,
    plan=_plan_left_out,
    run=_run_left_out,
    metrics=_METRICS,
    settings=UnseenViewsSettings,
    yardsticks=_YARDSTICKS,
    has_means_first=True,
)

_SETTINGS = {Setting.PARALLEL: PARALLEL_VIEWS, Setting.PINHOLE: PINHOLE_VIEWS}
