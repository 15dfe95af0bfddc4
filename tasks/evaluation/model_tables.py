"""Tables of the topic `models`: every split, and the published tables 2 and 3 with our models."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np

from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.score_tables import TextTable, format_score, pivot_table
from pasdedeux.evaluation.scores import Score
from pasdedeux.learning.meter import GENERATED
from pasdedeux.learning.model import VALIDATION_FALL as FALL
from pasdedeux.learning.splits import SPLIT_NAMES
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import EXPI18

LARGEST_SCALE = 1.25
"""Scale of the published table of largest scales."""
AT_LARGEST = f" at {LARGEST_SCALE}"
_PUBLISHED = ("E_r", "E_b", "JPD")
_STILL_FALLS = 1.0
"""If the validation error falls by more than this in the last segment, percent, training ended too early."""


def _without_seed(score: Score) -> str:
    """Return the name of a score's model without the seed that it was trained with."""
    return re.sub(r"_seed\d+$", "", score.method)


def _of_seeds(seed_scores: Sequence[Score]) -> str:
    """Return mean, least and most of the figures of several seeds."""
    values = [score.value for score in seed_scores]
    return f"{np.mean(values):.2f} ({min(values):.2f} to {max(values):.2f}, {counted(len(values), 'seed')})"


def model_tables(scores: Sequence[Score]) -> list[TextTable]:
    """Return E_r and PWD of every model on every split, and the published tables 2 and 3 with our models."""
    known = [score for score in scores if np.isnan(score.at)]
    of_all = [score for score in known if (score.metric, score.item) == ("E_r", "all")]
    # Baselines first, then from worst to best.
    ranked = {
        name: (not scores_of_model[0].is_baseline, -float(np.mean([score.value for score in scores_of_model])))
        for name in {score.method for score in of_all}
        for scores_of_model in [[score for score in of_all if score.method == name]]
    }
    models = {name: in_words(name) for name in sorted(ranked, key=lambda name: ranked[name])}
    known_splits = {score.split.removesuffix(" test") for score in known}
    splits = {
        f"{name} test": name
        for split in SPLIT_NAMES
        for name in sorted(known_splits)
        if name in (split, f"{split}_{EXPI18.name}")
    }
    is_falling = {(s.method, s.split) for s in known if s.metric == FALL and s.value > _STILL_FALLS}
    order = {name: number for number, name in enumerate((*models, *splits))}
    known = [score for score in known if score.method in models and score.split in splits]
    known.sort(key=lambda score: (score.item, order[score.split], order[score.method], score.metric))

    def by_model(caption: str, item: str, metrics: Sequence[str], cell: Callable[[Sequence[Score]], str]) -> TextTable:
        rows = [score for score in known if score.item == item and score.metric in metrics]
        rows.sort(key=lambda score: order[score.method])
        return pivot_table(rows, caption, ("model",), lambda s: (models[s.method],), splits, lambda s: s.split, cell)

    def by_motion(caption: str, *, is_largest: bool) -> TextTable:
        rows = [score for score in known if score.item not in ("all", GENERATED) and score.metric in _PUBLISHED]
        rows = [score for score in rows if score.item.endswith(AT_LARGEST) == is_largest]
        headings, names = ("motion", "split"), lambda s: (s.item.removesuffix(AT_LARGEST), splits[s.split])
        return pivot_table(rows, caption, headings, names, models, lambda s: s.method, _values(_PUBLISHED))

    def on_splits(cell: Sequence[Score]) -> str:
        mark = " (validation still fell)" if (cell[0].method, cell[0].split) in is_falling else ""
        return " / ".join(format_score(score).replace(" cm", "") for score in cell) + mark

    tables = [
        by_model(
            "E_r and proximity-weighted distance (cm) on every split, with 95 % intervals over takes if "
            "no test take was learned from, else over test variants. Marked: the last segment of training "
            f"reduced the validation error by more than {_STILL_FALLS:g} %, so longer training would "
            "change the figures",
            "all",
            ("E_r", "PWD"),
            on_splits,
        ),
        by_model(
            "Drift of contacts (mm) / JPD (cm): as predicted, and for the best network after two mesh steps",
            "all",
            ("contact_error", "JPD"),
            _values(("contact_error", "JPD")),
        ),
        by_motion("As table 2 of the paper (retargeting): E_r, cm / E_b, mm / JPD, cm", is_largest=False),
        by_motion(
            f"As table 3 of the paper, scale {LARGEST_SCALE} alone: E_r, cm / E_b, mm / JPD, cm", is_largest=True
        ),
        by_model(
            "As table 2 of the paper (generation): E_b (mm) against the drawn bones / JPD (cm) against "
            "the source, as there is no true motion. The model draws the scales of B, and baselines use "
            "the same scales",
            GENERATED,
            _PUBLISHED[1:],
            _values(_PUBLISHED[1:]),
        ),
    ]
    seeded = {(_without_seed(score), score.split) for score in of_all if _without_seed(score) != score.method}
    of_seeds = [score for score in of_all if (_without_seed(score), score.split) in seeded]
    of_seeds.sort(key=lambda score: order[score.method])
    names, caption = lambda s: (in_words(_without_seed(s)),), "E_r (cm) over all seeds: mean (smallest to largest)"
    tables.insert(1, pivot_table(of_seeds, caption, ("model",), names, splits, lambda score: score.split, _of_seeds))
    return [table for table in tables if table.rows]


def _values(metrics: Sequence[str]) -> Callable[[Sequence[Score]], str]:
    """Return a function that writes the scores of a cell in the order of these metrics."""
    return lambda in_cell: " / ".join(
        {score.metric: f"{score.value:.2f}" for score in in_cell}.get(name, "-") for name in metrics
    )
