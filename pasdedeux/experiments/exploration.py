"""What each way of exploring brought, at a glance: draws of every density and variant in one table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.score_tables import TextTable, format_value
from pasdedeux.evaluation.scores import Score

_SPLITS = ("held_out", "unannotated", "annotated")
_COVERAGE = {
    "num_draws": "draws",
    "coverage_D_C": "coverage D_C",
    "as_good_as_real_frames_D_C": "as good as real",
    "draw_to_nearest_real_D_C_median": "draw to nearest real, median",
}
_CHAINS = {"acceptance_rate_mean": "accepted", "travelled_mean": "travelled", "ess_min": "smallest ESS"}


def exploration_table(coverage: Sequence[Score], chains: Sequence[Score]) -> list[TextTable]:
    """Lay out a row for each method that was scored in both topics or grew, best coverage of the hardest part first.

    Coverage is over held-out frames where there are any, else over unannotated ones; figures of chains are means over
    seeds.  No table where chains were not scored, or nothing was covered.
    """
    single = [score for score in coverage if np.isnan(score.at)]
    split = next((one for one in _SPLITS if any(score.split == one for score in single)), None)
    if split is None or not chains:
        return []
    covered = {(score.method, score.metric): score for score in single if score.split == split}
    went: dict[tuple[str, str], list[Score]] = {}
    for score in chains:
        went.setdefault((score.method, score.metric), []).append(score)
    methods = sorted({method for method, metric in covered if metric == "num_draws"})
    methods.sort(key=lambda method: covered[method, "coverage_D_C"].value)
    rows = []
    for method in methods:
        cells = [
            format_value(covered[method, metric].value, covered[method, metric].unit)
            if (method, metric) in covered
            else ""
            for metric in _COVERAGE
        ]
        for metric in _CHAINS:
            found = went.get((method, metric), [])
            values = [score.value for score in found if np.isfinite(score.value)]
            cells.append(format_value(float(np.mean(values)), found[0].unit) if values else "")
        rows.append((in_words(method), *cells))
    return [
        TextTable(
            caption=f"What each way of exploring brought: {split.replace('_', ' ')} frames",
            headings=("draws of", *_COVERAGE.values(), *_CHAINS.values()),
            rows=tuple(rows),
        )
    ]
