"""Topics of reconstruction from several directions.

`parallel_views` and `pinhole_views`: held-out takes, by every method.  `left_out_clips`: each take of the database
against the rest of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from pasdedeux.evaluation.figures import Curve, curve_figure
from pasdedeux.evaluation.scores import Score
from pasdedeux.evaluation.unseen_views import (
    CONDITIONS,
    Condition,
    Setting,
    level_scores,
    reconstruct_seen,
    see,
    unseen_view_scores,
)
from pasdedeux.projections.camera import OrthographicCamera
from pasdedeux.projections.database import Database
from pasdedeux.projections.published import Codebook
from pasdedeux.projections.sources import resample_positions
from pasdedeux.reconstruction.reconstruct import Method, Searcher
from storage_schema import Manifest, Store
from tasks.evaluation.topic import TopicResult, make_shard, read_people, refuse_overlap
from tasks.projections import read_views
from tasks.reconstruction import read_database
from tasks.stage import Shard, StageInputs, stream

__all__ = ["LEFT_OUT_TOPIC", "TOPICS", "left_out_shards", "run", "run_left_out", "shards"]

TOPICS = tuple(setting.value for setting in Setting)
LEFT_OUT_TOPIC = "left_out_clips"

_LEVELS = {"noise": (0.0, 0.01, 0.03, 0.06, 0.1, 0.2), "missing": (0.0, 0.1, 0.3, 0.5, 0.7)}
_LEVEL_LABELS = {
    "noise": "noise of each coordinate, part of the torso",
    "missing": "share of the joints that are missing",
}
_CURVE_METHODS = (Method.NEAREST, Method.WINDOW, Method.VITERBI, Method.FIT)
_LEFT_OUT_METHODS = (Method.NEAREST, Method.VITERBI, Method.FIT)
_LEFT_OUT_CONDITIONS = (Condition("clean"), Condition("noise 3 % of the torso", noise=0.03))


def shards(inputs: StageInputs, *, yaws_deg: Sequence[float], has_sweeps: bool) -> list[Shard]:
    """One shard per held-out take, setting and condition, with the database parts that have not seen the take."""
    if not yaws_deg:
        return []
    found = []
    for take in inputs.of("poses"):
        if not take.facts["is_held_out"]:
            continue
        take_id = take.facts["take_id"]
        parts = [part for part in inputs.of("projections") if take_id not in part.facts["takes"]]
        if not parts:
            continue
        for setting in Setting:
            steps = [("condition", number) for number in range(len(CONDITIONS[setting]))]
            steps += [(kind, 0) for kind in _LEVELS] if has_sweeps else []
            for kind, number in steps:
                # A codebook is of use with exactly the parts it numbers.
                books = [] if kind != "condition" else _books(inputs, parts)
                found.append(
                    make_shard(
                        topic=setting.value,
                        name=f"{take_id}-{kind}" + (f"-{number}" if kind == "condition" else ""),
                        inputs=[take, *parts, *books],
                        parameters={
                            "take_id": take_id,
                            "yaws_deg": list(yaws_deg),
                            "num_parts": len(parts),
                            "kind": kind,
                            "condition": number,
                        },
                        seed=inputs.seed,
                    )
                )
    return found


def left_out_shards(inputs: StageInputs, *, yaws_deg: Sequence[float], is_wanted: bool) -> list[Shard]:
    """One shard per take of the database, with the parts that have not seen it."""
    found: list[Shard] = []
    if not (yaws_deg and is_wanted):
        return found
    for take in inputs.of("poses"):
        take_id = take.facts["take_id"]
        parts = [part for part in inputs.of("projections") if take_id not in part.facts["takes"]]
        if take.facts["is_held_out"] or not parts:
            continue
        found.append(
            make_shard(
                topic=LEFT_OUT_TOPIC,
                name=take_id,
                inputs=[take, *parts],
                parameters={"take_id": take_id, "yaws_deg": list(yaws_deg), "num_parts": len(parts)},
                seed=inputs.seed,
            )
        )
    return found


def run(shard: Shard, store: Store) -> TopicResult:
    """Score one take in one setting: a condition, or a sweep of growing levels."""
    setting, kind = Setting(shard.partition), shard.parameters["kind"]
    searcher, codebook, rate_hz = _database(shard, store, setting)
    scores: list[Score] = []
    pictures: dict[str, bytes] = {}
    captions: dict[str, str] = {}
    for item, world, person in _people(shard, store, rate_hz):
        labels = ("evaluation", setting.value, shard.parameters["take_id"], person, kind, shard.parameters["condition"])
        draw = partial(_stream, shard.seed, labels)
        if kind != "condition":
            points = level_scores(
                searcher,
                world,
                setting,
                kind=kind,
                levels=_LEVELS[kind],
                rate_hz=rate_hz,
                item=item,
                yaws_deg=shard.parameters["yaws_deg"],
                stream=draw,
                methods=_CURVE_METHODS,
            )
            scores += points
            name = f"{setting.value}-{item.replace(' ', '-')}-{kind}.png"
            pictures[name] = _curves(points, f"{item}, {setting.value}", _LEVEL_LABELS[kind])
            captions[name] = f"{item}: mean error over the views, root rotation kept, against {_LEVEL_LABELS[kind]}."
            continue
        condition = CONDITIONS[setting][shard.parameters["condition"]]
        scores += unseen_view_scores(
            searcher,
            world,
            setting,
            condition,
            rate_hz=rate_hz,
            item=item,
            yaws_deg=shard.parameters["yaws_deg"],
            stream=draw,
            codebook=codebook,
            has_live=True,
        )
        if shard.parameters["condition"] == 0:
            name = f"{setting.value}-{item.replace(' ', '-')}.webp"
            pictures[name] = _clip(searcher, world, setting, condition, shard.parameters["yaws_deg"][0], rate_hz, draw)
            captions[name] = (
                f"{item}, {condition.name}: the image (left), the fit as the camera sees it (middle) and from its side "
                "(right); truth in grey."
            )
    note = (
        f"{shard.parameters['take_id']} against {searcher.database.num_projections:,} projections; best_of_50 is "
        "a mark that knows the truth."
    )
    return TopicResult(scores=scores, pictures=pictures, captions=captions, notes=[note] if kind == "condition" else [])


def run_left_out(shard: Shard, store: Store) -> TopicResult:
    """Score a take of the database against the rest of the database, by parallel rays."""
    searcher, _, rate_hz = _database(shard, store, Setting.PARALLEL)
    scores: list[Score] = []
    for item, world, person in _people(shard, store, rate_hz):
        for number, condition in enumerate(_LEFT_OUT_CONDITIONS):
            labels = ("evaluation", LEFT_OUT_TOPIC, shard.parameters["take_id"], person, number)
            scores += unseen_view_scores(
                searcher,
                world,
                Setting.PARALLEL,
                condition,
                rate_hz=rate_hz,
                item=item,
                yaws_deg=shard.parameters["yaws_deg"],
                stream=partial(_stream, shard.seed, labels),
                methods=_LEFT_OUT_METHODS,
                has_clean_up=False,
                topic=LEFT_OUT_TOPIC,
            )
    return TopicResult(scores=scores)


def _books(inputs: StageInputs, parts: Sequence[Manifest]) -> list[Manifest]:
    keys = {part.ref.key for part in parts}
    return [book for book in inputs.of("codebook") if set(book.facts["part_keys"]) == keys]


def _stream(seed: int, labels: Sequence[str | int], *more: int) -> np.random.Generator:
    return stream(seed, *labels, *more)


def _database(shard: Shard, store: Store, setting: Setting) -> tuple[Searcher, Codebook | None, float]:
    """Return the database of the shard's parts, in the order of the codebook where there is one, and its rate."""
    _, *others = shard.inputs
    parts, books = others[: shard.parameters["num_parts"]], others[shard.parameters["num_parts"] :]
    used = [store.manifest(part).facts for part in parts]
    refuse_overlap(
        "the projection database", [name for one in used for name in one["takes"]], [shard.parameters["take_id"]]
    )
    codebook = None
    if books:
        by_key = {part.key: part for part in parts}
        parts = [by_key[key] for key in store.manifest(books[0]).facts["part_keys"]]
        table = store.read(books[0], "codebook")
        codebook = Codebook(np.asarray(table["representative_m"]), tuple(np.asarray(one) for one in table["members"]))
    views = read_views([store.manifest(part) for part in parts])
    rate_hz = float(used[0]["rate_hz"])
    poses, starts, _, _ = read_database(store, parts)
    # Parallel views compare with the paper, so parallel rays see the database too, whatever the study's camera.
    camera = OrthographicCamera() if setting is Setting.PARALLEL else views.level_camera
    database = Database(poses, starts, num_yaws=views.num_yaws, rate_hz=rate_hz, camera=camera)
    return Searcher.of(database), codebook, rate_hz


def _people(shard: Shard, store: Store, rate_hz: float) -> list[tuple[str, np.ndarray, int]]:
    """Return name, motion (frame, 14, 3) at the database's rate and number of every person of the shard's take."""
    take, take_id = shard.inputs[0], shard.parameters["take_id"]
    people = read_people(store, take, "op14_m")
    from_hz = float(store.manifest(take).facts["rate_hz"])
    return [
        (
            take_id if people.shape[1] == 1 else f"{take_id} person {person}",
            resample_positions(people[:, person], from_hz=from_hz, to_hz=rate_hz),
            person,
        )
        for person in range(people.shape[1])
    ]


def _curves(points: Sequence[Score], title: str, x_label: str) -> bytes:
    curves = []
    for method in dict.fromkeys(point.method for point in points):
        own = [point for point in points if point.method == method]
        curves.append(
            Curve(
                method,
                np.array([point.at for point in own]),
                np.array([100.0 * point.value for point in own]),
                is_baseline=own[0].is_baseline,
            )
        )
    return curve_figure(curves, title=title, x_label=x_label, y_label="error (cm)")


def _clip(
    searcher: Searcher,
    world: np.ndarray,
    setting: Setting,
    condition: Condition,
    yaw_deg: float,
    rate_hz: float,
    draw: Callable[..., Any],
) -> bytes:
    from pasdedeux.evaluation.side_by_side import side_by_side_clip  # here: planning does not need OpenCV

    count = min(len(world), round(4.0 * rate_hz))
    seen = see(world[:count], setting, condition, yaw_deg=yaw_deg, rate_hz=rate_hz, rng=draw(0))
    made, _ = reconstruct_seen(searcher, seen, methods=(Method.FIT,), has_clean_up=False)
    step = 2
    return side_by_side_clip(
        seen.track.keypoints_px[::step, None],
        made[Method.FIT.value][::step, None],
        rate_hz=rate_hz / step,
        truth_m=seen.truth_m[::step, None],
    )
