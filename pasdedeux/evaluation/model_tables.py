"""Tables of models in the layout of Li et al. (2024), with our rows, and players of single cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.models import GENERATED
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.players import TRUTH_COLOUR, Figure, pack_player, people_panel, shown_frames
from pasdedeux.evaluation.score_tables import TextTable, format_score
from pasdedeux.evaluation.scores import Score
from pasdedeux.learning import SPLIT_NAMES, TrainingItem

LARGEST_SCALE = 1.25
"""Scale of the published table of largest scales."""

_PUBLISHED = ("E_r", "E_b", "JPD")


def best_model(scores: Sequence[Score], *, split: str, baselines: Sequence[str]) -> str | None:
    """Return the model with the smallest E_r over the test variants of a split; a baseline where nothing else is."""
    found = {s.method: s.value for s in scores if (s.metric, s.split, s.item) == ("E_r", split, "all")}
    return min(found, key=lambda name: (name in baselines, found[name]), default=None)


def extreme_cases(errors: Sequence[float]) -> dict[str, int]:
    """Return the best, the median and the worst of some errors, by index.

    >>> extreme_cases([3.0, 1.0, 2.0])
    {'best': 1, 'median': 2, 'worst': 0}
    """
    order = np.argsort(errors, kind="stable")
    return {"best": int(order[0]), "median": int(order[(len(order) - 1) // 2]), "worst": int(order[-1])}


def case_player(cases: Mapping[str, tuple[TrainingItem, Array]]) -> bytes:
    """Show predictions (T, 2, 22, 3), metres, beside each other, the solver's answer grey behind each.

    A longer take is shown as long as the shortest of them lasts.
    """
    sources = [item.request.source for item, _ in cases.values()]
    frames, rate_hz = shown_frames(min(source.num_frames for source in sources), sources[0].rate_hz)
    panels = []
    for what, (item, predicted) in cases.items():
        skeleton = item.request.source.skeleton
        true, guessed = item.motion_m[frames], predicted[frames]
        middle = true[:, :, skeleton.root].mean(axis=(0, 1)) * [1.0, 0.0, 1.0]
        title = f"{what}: {item.request.take_id} {item.variant_id}"
        behind = tuple(
            Figure(skeleton, true[:, person] - middle, TRUTH_COLOUR, is_thin=True) for person in range(true.shape[1])
        )
        panel = people_panel(title, skeleton, guessed - middle)
        panels.append(replace(panel, figures=(*behind, *panel.figures)))
    return pack_player(panels, rate_hz=rate_hz)


def model_tables(scores: Sequence[Score]) -> list[TextTable]:
    """Return E_r and PWD of every model on every split, and the published tables 2 and 3 with our models."""
    splits = [f"{name} test" for name in SPLIT_NAMES]
    known = {(s.split, s.item, s.method, s.metric): s for s in scores if np.isnan(s.at)}
    methods = sorted({s.method for s in scores if s.metric == "E_r"}, key=lambda name: _rank(scores, name))
    used = [split for split in splits if any(key[0] == split for key in known)]
    items = sorted({key[1] for key in known} - {"all", GENERATED})
    motions = [item for item in items if f" at {LARGEST_SCALE}" not in item]

    def cell(split: str, item: str, method: str, metrics: Sequence[str]) -> str:
        found = [known.get((split, item, method, metric)) for metric in metrics]
        return " / ".join("-" if one is None else f"{one.value:.2f}" for one in found) if any(found) else ""

    whole = [(in_words(method), *(_with_interval(known, split, method) for split in used)) for method in methods]
    rows = [
        (motion, split.removesuffix(" test"), *(cell(split, motion, method, _PUBLISHED) for method in methods))
        for motion in motions
        for split in used
        if any((split, motion, method, "E_r") in known for method in methods)
    ]
    largest = [
        (
            motion,
            split.removesuffix(" test"),
            *(cell(split, f"{motion} at {LARGEST_SCALE}", m, _PUBLISHED) for m in methods),
        )
        for motion in motions
        for split in used
        if any((split, f"{motion} at {LARGEST_SCALE}", m, "E_r") in known for m in methods)
    ]
    drawn = [
        (in_words(method), *(cell(split, GENERATED, method, _PUBLISHED[1:]) for split in used))
        for method in methods
        if any((split, GENERATED, method, "E_b") in known for split in used)
    ]
    headings = ("motion", "split", *map(in_words, methods))
    tables = [
        TextTable(
            "E_r and proximity-weighted distance, cm, on every split, with 95 % intervals over test variants, or over "
            "takes where these are not learned from",
            ("model", *(split.removesuffix(" test") for split in used)),
            tuple(whole),
        ),
        TextTable("As table 2 of the paper (retargeting): E_r, cm / E_b, mm / JPD, cm", headings, tuple(rows)),
        TextTable(
            f"As table 3 of the paper, scale {LARGEST_SCALE} alone: E_r, cm / E_b, mm / JPD, cm",
            headings,
            tuple(largest),
        ),
        TextTable(
            "As table 2 of the paper (generation), scales of B drawn by the model, baselines at these: E_b, mm, from "
            "the bones drawn / JPD, cm, from the source, as there is no true motion",
            ("model", *(split.removesuffix(" test") for split in used)),
            tuple(drawn),
        ),
    ]
    return [table for table in tables if table.rows]


def _rank(scores: Sequence[Score], method: str) -> tuple[bool, float]:
    """Return what sorts methods: baselines first, then from worst to best."""
    found = [s for s in scores if s.method == method and s.metric == "E_r" and s.item == "all"]
    return not found[0].is_baseline, -float(np.mean([s.value for s in found]))


def _with_interval(known: Mapping[tuple[str, str, str, str], Score], split: str, method: str) -> str:
    found = [known.get((split, "all", method, metric)) for metric in ("E_r", "PWD")]
    return " / ".join(format_score(one).replace(" cm", "") for one in found if one is not None)
