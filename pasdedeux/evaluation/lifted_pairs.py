"""Lifted pairs, completed joints and in-betweens against the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.completion.in_betweens import fill_between, straight_between
from pasdedeux.completion.neighbours import nearest_rigid
from pasdedeux.completion.occlusion import blend_onto, complete_pair
from pasdedeux.evaluation.figures import draw_pair, figure_svg, new_figure
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.players import pack_player, people_panel
from pasdedeux.evaluation.scores import Score, scores_of, summarise
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity
from pasdedeux.kinematics import align_rigid
from pasdedeux.skeletons import PAIR17

BASELINES = frozenset({"mean_pair", "lifting", "lifting_ik", "naive_sampling", "straight", "nearest_draw"})
"""Methods that others are compared with."""

HIDDEN = {
    "arm": PAIR17.arms,
    "leg": tuple(leg[1:] for leg in PAIR17.legs),
    "limbs": ([joint for side in zip(PAIR17.arms, PAIR17.legs, strict=True) for limb in side for joint in limb[1:]],),
}
"""What is hidden of one person: an arm, a leg, or everything beyond shoulders and hips."""

_ROOT = PAIR17.root
_CELL_M = np.array([1.75, 2.7])
"""Width and height that a pair has in a picture of many, metres."""


def lifted_errors(lifted_m: Array, truth_m: Array) -> dict[str, Array]:
    """Return errors (n,), metres, of lifted pairs (n, person=2, joint=17, 3) against the truth in the same camera axes.

    - `lifted_pair_error`: mean joint distance, the middle of the pair in one place: distance and depth count;
    - `lifted_person_error`: mean joint distance, each person about the own root;
    - `lifted_D_C`: after the best rigid motion of the whole pair;
    - `person_distance_error`, `relative_depth_error`: of the distance between the two roots, and of its depth.
    """
    flat, true = (pairs.reshape(len(pairs), -1, 3) for pairs in (lifted_m, truth_m))
    centred, centred_truth = flat - flat.mean(axis=1, keepdims=True), true - true.mean(axis=1, keepdims=True)
    own, own_truth = (pairs - pairs[:, :, _ROOT : _ROOT + 1] for pairs in (lifted_m, truth_m))
    between, between_truth = (pairs[:, 1, _ROOT] - pairs[:, 0, _ROOT] for pairs in (lifted_m, truth_m))
    return {
        "lifted_pair_error": np.linalg.norm(centred - centred_truth, axis=-1).mean(axis=-1),
        "lifted_person_error": np.linalg.norm(own - own_truth, axis=-1).mean(axis=(-1, -2)),
        "lifted_D_C": cartesian_dissimilarity(flat, true),
        "person_distance_error": np.abs(np.linalg.norm(between, axis=-1) - np.linalg.norm(between_truth, axis=-1)),
        "relative_depth_error": np.abs(between[:, 2] - between_truth[:, 2]),
    }


def lifted_scores(lifted_m: Mapping[str, Array], truth_m: Mapping[str, Array], *, split: str) -> list[Score]:
    """Score lifted pairs of each method (n, 2, 17, 3) against the truth of each (n, 2, 17, 3), metres."""
    return [
        score
        for method, pairs in lifted_m.items()
        for metric, values in lifted_errors(pairs, truth_m[method]).items()
        for score in _summary(values, metric, method, split)
    ]


def completion_errors(
    generator: np.random.Generator, truth_m: Array, draws_m: npt.NDArray[np.floating]
) -> dict[str, dict[str, Array]]:
    """Hide limbs of one person of real pairs (n, 2, 17, 3), metres; return errors (n,) by what is hidden and method.

    Hidden is an arm, a leg, or everything beyond shoulders and hips.

    `median` and `blended` are the published steps over the 100 draws nearest in D_I, `fitted` adds exact bones,
    `blended_10` takes 10 draws; the mean of all draws and the nearest draw, moved onto the visible joints, are the
    baselines.
    """
    mean = np.asarray(draws_m.mean(axis=0), dtype=np.float64)
    found: dict[str, dict[str, Array]] = {}
    for part, choices in HIDDEN.items():
        errors: dict[str, list[float]] = {}
        for truth in truth_m:
            joints = list(choices[generator.integers(len(choices))])
            person = int(generator.integers(2))
            seen = truth.copy()
            seen[person, joints] = np.nan
            count = min(100, len(draws_m))
            done = complete_pair(seen, draws_m, num_nearest=count, num_ranked=count + 20)
            near = done.neighbours.pairs_m[:10]
            is_seen = np.isfinite(seen).all(axis=-1).ravel()
            flat = mean.reshape(-1, 3)
            moved = align_rigid(flat[is_seen], truth.reshape(-1, 3)[is_seen]).apply(flat).reshape(truth.shape)
            for method, pair in (
                ("median", done.median_m),
                ("blended", done.pair_m),
                ("fitted", done.fitted_m),
                ("blended_10", blend_onto(np.median(near, axis=0), seen)),
                ("nearest_draw", nearest_rigid(draws_m, seen, count=1).pairs_m[0]),
                ("mean_pair", moved),
            ):
                error = np.linalg.norm(pair[person, joints] - truth[person, joints], axis=-1).mean()
                errors.setdefault(method, []).append(float(error))
        found[part] = {method: np.array(values) for method, values in errors.items()}
    return found


def completion_scores(errors: Mapping[str, Mapping[str, Array]], *, split: str) -> list[Score]:
    """Score errors of completed joints, metres, by what was hidden and by method."""
    return [
        score
        for part, methods in errors.items()
        for method, values in methods.items()
        for score in _summary(values, "occluded_joint_error", method, split, item=part)
    ]


def in_between_errors(spans_m: Sequence[Array], draws_m: npt.NDArray[np.floating]) -> dict[str, list[Array]]:
    """Return errors (frame,), metres, between the ends of real spans (frame, 2, 17, 3), by method and span."""
    errors: dict[str, list[Array]] = {"draws": [], "straight": []}
    for span in spans_m:
        for method, between in (
            ("draws", fill_between(span[0], span[-1], len(span) - 2, draws_m)),
            ("straight", straight_between(span[0], span[-1], len(span) - 2)),
        ):
            errors[method].append(np.linalg.norm(between - span[1:-1], axis=-1).mean(axis=(1, 2)))
    return errors


def in_between_scores(errors: Mapping[str, Sequence[Array]], *, split: str, item: str) -> list[Score]:
    """Score what was put between the ends of spans, each span by the mean of its frames."""
    return [
        score
        for method, spans in errors.items()
        for score in _summary(np.array([span.mean() for span in spans]), "in_between_error", method, split, item=item)
    ]


def lifted_player(examples: Sequence[Mapping[str, Array]]) -> bytes:
    """Show examples one after another, a panel for each method that any of them has.

    Args:
        examples: For each example the pairs (2, 17, 3) by method, camera axes, metres; each is shown about its middle.
    """
    panels = []
    for method in dict.fromkeys(name for example in examples for name in example):
        pairs = [example.get(method, np.full((2, PAIR17.num_joints, 3), np.nan)) for example in examples]
        people = np.stack([pair - pair.reshape(-1, 3).mean(axis=0) for pair in pairs])
        panels.append(people_panel(in_words(method), PAIR17, people))
    labels = [f"example {number + 1} of {len(examples)}" for number in range(len(examples))]
    return pack_player(panels, rate_hz=0.5, labels=labels, has_floor=False)


def calibration_scores(expected_m: Array, errors_m: Array, *, split: str) -> list[Score]:
    """Score expected errors (n, 3) with the ends of their intervals, metres, against true ones (n,), metres."""
    value, low, high = expected_m.T
    figures = {"expected_interval_share": float(((low <= errors_m) & (errors_m <= high)).mean())}
    if len(value) > 2 and np.ptp(value) > 0.0 and np.ptp(errors_m) > 0.0:
        figures["expected_correlation"] = float(np.corrcoef(value, errors_m)[0, 1])
    return scores_of(figures, "fitted", split=split, count=len(value))


def expected_figure(parts: Mapping[str, tuple[Array, Array]]) -> bytes:
    """Draw true errors (n,) over expected ones (n, 3), metres, of each part, and what holds 80 %; give SVG bytes."""
    figure, ((axis,),) = new_figure(4.6, 3.6)
    for marker, (name, (expected, errors)) in zip("os^D", parts.items(), strict=False):
        more = {"linewidths": 0, "rasterized": True, "alpha": 0.7}
        axis.scatter(100 * expected[:, 0], 100 * errors, s=14, marker=marker, label=name.replace("_", " "), **more)
    every = 100 * np.concatenate([expected for expected, _ in parts.values()])
    every = every[np.argsort(every[:, 0])]
    axis.plot(every[:, 0], every[:, 0], color="#444444", linewidth=0.8)
    axis.fill_between(every[:, 0], every[:, 1], every[:, 2], color="#444444", alpha=0.12, linewidth=0)
    axis.set_xlabel("expected error (cm)", fontsize=8)
    axis.set_ylabel("true error (cm)", fontsize=8)
    axis.tick_params(labelsize=7)
    axis.legend(fontsize=7)
    return figure_svg(figure)


@dataclass(frozen=True)
class LiftedExample:
    """A lifted pair and what is most like it, nearest first.

    Args:
        label: What it is.
        image_m: Its image (person=2, joint=17, 2), metres, NaN where not seen.
        pair_m: What it was lifted to (2, 17, 3), metres, camera axes.
        annotations: Other annotations (2, 17, 2), metres, each with its d_I to the pair seen from there, metres.
        draws: Draws (2, 17, 3) as the image's camera saw them, each with its d_I to the image, metres.
    """

    label: str
    image_m: Array
    pair_m: Array
    annotations: Sequence[tuple[Array, float]]
    draws: Sequence[tuple[Array, float]]


def nearest_figure(examples: Sequence[LiftedExample]) -> bytes:
    """Draw a row for each lifted pair: its image, it, its nearest annotations and draws; give SVG bytes."""
    columns = 3 + max((len(one.annotations) + len(one.draws) for one in examples), default=0)
    width, height = columns * _CELL_M[0], len(examples) * _CELL_M[1]
    figure, ((axis,),) = new_figure(9.0, 9.0 * height / width)
    axis.set_xlim(0.0, width)
    axis.set_ylim(-height, 0.0)
    axis.set_aspect("equal")
    axis.set_axis_off()
    for row, one in enumerate(examples):
        # From its left: what was towards the camera is on the right.
        seen = [(one.image_m, "image"), (one.pair_m[..., :2], "lifted"), (one.pair_m[..., [2, 1]], "from the side")]
        seen += [(image, f"annotation, {100 * far:.0f} cm") for image, far in one.annotations]
        seen += [(pair[..., :2], f"draw, {100 * far:.0f} cm") for pair, far in one.draws]
        for column, (points, words) in enumerate(seen):
            middle, top = _CELL_M[0] * (column + 0.5), -_CELL_M[1] * row
            draw_pair(axis, points, np.array([middle, top - 0.56 * _CELL_M[1]]))
            axis.text(middle, top - 0.16 * _CELL_M[1], words, fontsize=7, ha="center")
        axis.text(0.0, -_CELL_M[1] * (row + 0.05), one.label, fontsize=7, fontweight="bold")
    return figure_svg(figure)


def _summary(values: Array, metric: str, method: str, split: str, *, item: str = "all") -> list[Score]:
    more = {"is_baseline": method in BASELINES, "split": split, "item": item}
    return summarise(values, metric=metric, method=method, unit="m", **more)
