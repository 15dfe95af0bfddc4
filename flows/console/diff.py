"""`diff`: compares two runs or two versions of datasets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from flows.console import options
from flows.console.context import answer, app, open_store
from flows.console.display import format_table
from flows.differences import Changes, differences
from flows.finished_builds import read_recorded
from flows.staleness import shorten_text

_NameArgument = Annotated[str, Argument(metavar="RUN|NAME@V", help="Id of a run, or a version of a dataset.")]


@app.command()
def diff(
    a: _NameArgument,
    b: _NameArgument,
    store: options.Store = Path("store"),
    rows: Annotated[int, Option(min=0, help="Scores to show.")] = 20,
    as_json: options.Json = False,
) -> None:
    """Compare two finished runs or two versions of datasets; only differences are shown, scores last.

    \b
      pasdedeux diff 20260301T020000-salsa-3fa9c0 20260302T020000-salsa-77b2d1
      pasdedeux diff salsa@1 salsa@2 --store /data/store
      pasdedeux diff salsa@1 salsa@2 --json

    It compares the parameters of the resolved studies, the environments, input files by digest, artifacts by stage, and
    scores, largest difference first.
    """
    opened = open_store(store)
    first, other = read_recorded(opened, a), read_recorded(opened, b)
    comparison = differences(opened, first, other)
    changed = {
        name: {key: {"a": x, "b": y} for key, (x, y) in pairs.items()} for name, pairs in comparison.pairs.items()
    }
    described = {
        "a": first.label,
        "b": other.label,
        **changed,
        "artifacts": comparison.artifacts,
        "num_scores": comparison.num_scores,
        "scores": [{**s.figure._asdict(), "unit": s.unit, "a": s.a, "b": s.b} for s in comparison.scores],
    }
    lines = [f"a: {first.label}", f"b: {other.label}", *_change_lines(comparison, rows)]
    answer(described, lines, as_json=as_json)


def _change_lines(changes: Changes, num_rows: int) -> Iterator[str]:
    for name, pairs in changes.pairs.items():
        yield f"{name}: {len(pairs) or 'nothing'} differ{'s' if len(pairs) < 2 else ''}"
        cells = [(f"  {key}", shorten_text(x) or "-", shorten_text(y) or "-") for key, (x, y) in pairs.items()]
        yield from format_table(("", "a", "b"), cells, text_columns=range(3)) if cells else ()
    rows = [(f"  {stage}", *counts.values()) for stage, counts in changes.artifacts.items()]
    yield from format_table(("artifacts", "same", "other", "only a", "only b"), rows)
    yield f"scores: {len(changes.scores)} of {changes.num_scores} differ"
    scores = [(f"  {score.name}", *score.cells) for score in changes.scores[:num_rows]]
    yield from format_table(("", "a", "b", ""), scores, text_columns=(0, 3)) if scores else ()
    if len(changes.scores) > num_rows:
        yield f"  and {len(changes.scores) - num_rows} more; --rows shows them"
