"""`diff`: two runs, or two versions of datasets, side by side."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import typer

from flows.console.context import JsonOption, StoreOption, open_store, print_json
from flows.console.display import counted, print_table
from flows.reasons import changed_leaves, shorten
from flows.recorded import Recorded, environment_changes, read_recorded
from storage_schema import Store

__all__ = ["app"]

app = typer.Typer(rich_markup_mode=None)

_DIFF = """Put two finished runs, or two versions of datasets, side by side: only what differs, the scores last.

\b
  pasdedeux diff 20260301T020000-salsa-3fa9c0 20260302T020000-salsa-77b2d1
  pasdedeux diff salsa@1 salsa@2 --store /data/store
  pasdedeux diff salsa@1 salsa@2 --json

Parameters are those of the resolved studies; the environment is what each ran on; files from outside go by their
digests; artifacts are counted by stage; the scores that differ come by how much they do.
"""
_SCORE = ("topic", "metric", "method", "split", "item", "at")
_NameArgument = Annotated[str, typer.Argument(metavar="RUN|NAME@V", help="Id of a run, or a version of a dataset.")]


@app.command(help=_DIFF)
def diff(
    a: _NameArgument,
    b: _NameArgument,
    store: StoreOption = Path("store"),
    rows: Annotated[int, typer.Option(min=0, help="Scores to show.")] = 20,
    as_json: JsonOption = False,
) -> None:
    """Put two runs or versions side by side."""
    opened = open_store(store)
    one, other = read_recorded(opened, a), read_recorded(opened, b)
    pairs = {
        "parameters": changed_leaves(one.sections, other.sections),
        "environment": environment_changes(one.environment, other.environment),
        "files": changed_leaves(one.sources, other.sources),
    }
    artifacts = _artifacts(one, other)
    scores, num_scores = _scores(opened, one, other)
    if as_json:
        print_json(
            {
                "a": one.label,
                "b": other.label,
                **{name: {key: {"a": x, "b": y} for key, (x, y) in found.items()} for name, found in pairs.items()},
                "artifacts": artifacts,
                "num_scores": num_scores,
                "scores": scores,
            }
        )
        return
    typer.echo(f"a: {one.label}\nb: {other.label}")
    for name, found in pairs.items():
        typer.echo(f"{name}: {len(found) or 'nothing'} differ{'s' if len(found) < 2 else ''}")
        if found:
            cells = [(f"  {key}", shorten(x) or "-", shorten(y) or "-") for key, (x, y) in found.items()]
            print_table(("", "a", "b"), cells, text_columns=range(3))
    header = ("artifacts", "same", "other", "only a", "only b")
    print_table(header, [(f"  {stage}", *map(str, counts.values())) for stage, counts in artifacts.items()])
    typer.echo(f"scores: {len(scores)} of {num_scores} differ")
    if scores[:rows]:
        lines = [
            (_name(score), *(_figure(score[side]) for side in "ab"), str(score["unit"])) for score in scores[:rows]
        ]
        print_table(("", "a", "b", ""), lines, text_columns=(0, 3))
    if len(scores) > rows:
        typer.echo(f"  and {counted(len(scores) - rows, 'more')}; --rows shows them")


def _artifacts(one: Recorded, other: Recorded) -> dict[str, dict[str, int]]:
    """Return for each stage how many artifacts hold the same, hold other bytes, and are only in one."""
    counts: Counter[tuple[str, str]] = Counter()
    for place in {**one.artifacts, **other.artifacts}:
        mine, theirs = one.artifacts.get(place), other.artifacts.get(place)
        if mine is None or theirs is None:
            counts[place[0], "only_b" if mine is None else "only_a"] += 1
        else:
            is_same = mine.ref.content_digest == theirs.ref.content_digest
            counts[place[0], "same" if is_same else "other"] += 1
    stages = dict.fromkeys(stage for stage, _, _ in {**one.artifacts, **other.artifacts})
    return {stage: {what: counts[stage, what] for what in ("same", "other", "only_a", "only_b")} for stage in stages}


def _scores(store: Store, one: Recorded, other: Recorded) -> tuple[list[dict[str, Any]], int]:
    """Return the scores that differ, the greatest change for its size first, and the number of all."""
    mine, theirs = _scores_of(store, one), _scores_of(store, other)
    found = [
        {**dict(zip(_SCORE, name, strict=True)), "unit": unit, "a": x, "b": y}
        for name in {**mine, **theirs}
        for unit in [(mine.get(name) or theirs[name])[1]]
        for x, y in [(mine.get(name, (None, ""))[0], theirs.get(name, (None, ""))[0])]
        if x != y
    ]
    return sorted(found, key=lambda score: -_change(score["a"], score["b"])), len({**mine, **theirs})


def _scores_of(store: Store, recorded: Recorded) -> dict[tuple[Any, ...], tuple[float | None, str]]:
    """Return value and unit of every score by what it is of; NaN, of which JSON knows nothing, is None."""
    found: dict[tuple[Any, ...], tuple[float | None, str]] = {}
    for manifest in recorded.artifacts.values():
        if "scores" in manifest.tables:
            table = store.read(manifest.ref, "scores", columns=[*_SCORE, "value", "unit"])
            columns = [[_plain(value) for value in table[name]] for name in _SCORE]
            for *name, value, unit in zip(*columns, table["value"], table["unit"], strict=True):
                found[tuple(name)] = (_plain(value), unit)
    return found


def _plain(value: Any) -> Any:
    return value if isinstance(value, str) else float(value) if math.isfinite(value) else None


def _change(a: float | None, b: float | None) -> float:
    return math.inf if a is None or b is None else abs(a - b) / max(abs(a), abs(b))


def _name(score: dict[str, Any]) -> str:
    place = "" if score["at"] is None else f" at {score['at']:g}"
    return "  " + " ".join(str(score[name]) for name in _SCORE[:-1] if score[name] not in ("", "all")) + place


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.5g}"
