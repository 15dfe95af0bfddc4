"""`diff`: two runs, or two versions of datasets, side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.console.context import JsonOption, StoreOption, open_store, print_json
from flows.console.display import counted, print_table
from flows.differences import differences
from flows.reasons import shorten
from flows.recorded import read_recorded

app = typer.Typer(rich_markup_mode=None)

_DIFF = """Put two finished runs, or two versions of datasets, side by side: only what differs, the scores last.

\b
  pasdedeux diff 20260301T020000-salsa-3fa9c0 20260302T020000-salsa-77b2d1
  pasdedeux diff salsa@1 salsa@2 --store /data/store
  pasdedeux diff salsa@1 salsa@2 --json

Parameters are those of the resolved studies; the environment is what each ran on; files from outside go by their
digests; artifacts are counted by stage; the scores that differ come by how much they do.
"""
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
    found = differences(opened, one, other)
    if as_json:
        print_json(
            {
                "a": one.label,
                "b": other.label,
                **{
                    name: {key: {"a": x, "b": y} for key, (x, y) in pairs.items()}
                    for name, pairs in found.pairs.items()
                },
                "artifacts": found.by_stage,
                "num_scores": found.num_scores,
                "scores": [{**s.figure._asdict(), "unit": s.unit, "a": s.a, "b": s.b} for s in found.scores],
            }
        )
        return
    typer.echo(f"a: {one.label}\nb: {other.label}")
    for name, pairs in found.pairs.items():
        typer.echo(f"{name}: {len(pairs) or 'nothing'} differ{'s' if len(pairs) < 2 else ''}")
        if pairs:
            cells = [(f"  {key}", shorten(x) or "-", shorten(y) or "-") for key, (x, y) in pairs.items()]
            print_table(("", "a", "b"), cells, text_columns=range(3))
    header = ("artifacts", "same", "other", "only a", "only b")
    print_table(header, [(f"  {stage}", *map(str, counts.values())) for stage, counts in found.by_stage.items()])
    typer.echo(f"scores: {len(found.scores)} of {found.num_scores} differ")
    if found.scores[:rows]:
        lines = [(f"  {score.name}", *score.cells) for score in found.scores[:rows]]
        print_table(("", "a", "b", ""), lines, text_columns=(0, 3))
    if len(found.scores) > rows:
        typer.echo(f"  and {counted(len(found.scores) - rows, 'more')}; --rows shows them")
