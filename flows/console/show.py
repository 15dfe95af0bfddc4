"""`show`: prints columns, rows and lineage of a reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from typer import Option

from flows.console import options
from flows.console.context import answer, app, open_store, say
from flows.console.display import format_table
from pasdedeux.evaluation.score_tables import mean_table, score_table
from pasdedeux.evaluation.scores import COLUMNS, Score
from pasdedeux.people.names import person_names
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import WORKING_SKELETONS
from storage_schema import (
    TABLES,
    Store,
    iter_rows,
    lineage,
    parse_reference,
    referenced_credits,
    resolve,
    source_files,
    table_files,
)

SCORES = "scores"


_ROWS, _SCORE_ROWS, _ROWS_OF_MANY, _MAX_STEPS = 5, 12, 3, 12
"""Default numbers of rows of a table, of one topic of scores, of each of several topics; of ancestors shown."""


@app.command()
def show(
    reference: options.Reference,
    store: options.Store = Path("store"),
    rows: Annotated[
        int | None,
        Option(min=0, help=f"Rows to show: {_ROWS}; for scores {_SCORE_ROWS}, or {_ROWS_OF_MANY} per topic."),
    ] = None,
    has_files: Annotated[bool, Option("--files", help="Only the paths of the Parquet files, one per line.")] = False,
    as_json: options.Json = False,
) -> None:
    """Print the columns, first rows and lineage of a reference.

    \b
      pasdedeux show poses:duets       a table, as the last run of a study made it
      pasdedeux show scores:duets      a table per topic, the best value marked
      pasdedeux show draws@3fa9c0#17   one row: its poses, joint by joint
    """
    opened = open_store(store)
    if has_files:
        say(map(str, table_files(reference, opened)))
        return
    described = _describe(opened, reference, _ROWS if rows is None else rows)
    if described["table"] == SCORES and described["row"] is None:
        lines = _score_lines(opened, reference, rows)
    else:
        lines = _row_lines(described, opened, reference)
    heading = [
        f"{described['table']}: {described['meaning']}",
        f"{counted(described['num_rows'], 'row')} in {counted(len(described['artifacts']), 'artifact')}",
    ]
    sources = [f"  source {source['name']}: {source['licence']}; {source['credit']}" for source in described["sources"]]
    answer(described, chain(heading, lines, sources), as_json=as_json)


def _row_lines(described: Mapping[str, Any], store: Store, reference: str) -> Iterator[str]:
    """Yield columns, rows and lineage."""
    cells = [(f"  {c['name']}", c["type"], c["unit"], c["meaning"]) for c in described["columns"]]
    yield from format_table(("  column", "type", "unit", "meaning"), cells, text_columns=range(4))
    if described["rows"]:
        yield "first rows:" if described["row"] is None else "the row:"
    for number, row in enumerate(described["rows"], described["row"] or 0):
        yield f"  #{number} " + ", ".join(f"{name}={value}" for name, value in row.items())
    if described["row"] is not None:
        yield from _joint_lines_of(store, reference)
    yield "comes from:"
    for step in described["lineage"][:_MAX_STEPS]:
        place = f"{step['stage']}@{step['key'][:12]} {step['partition']} {step['name']}".rstrip()
        yield f"  {'  ' * step['depth']}{place}"
    if (more := len(described["lineage"]) - _MAX_STEPS) > 0:
        yield f"  ... and {counted(more, 'more artifact')}: --json"
    for file in described["files"][:_MAX_STEPS]:
        yield f"  file {file['name']} (sha256 {file['sha256'][:12]}, read by {file['stage']})"


def _describe(store: Store, text: str, num_rows: int) -> dict[str, Any]:
    reference = parse_reference(text)
    refs = resolve(reference, store)
    table = TABLES[reference.table]
    manifests = [store.manifest(ref) for ref in refs]
    steps = lineage(store, *refs)
    sources = referenced_credits(store, reference, refs)
    return {
        "reference": text,
        "table": table.name,
        "meaning": table.meaning,
        "row": reference.row,
        "num_rows": sum(manifest.tables[table.name].rows for manifest in manifests),
        "artifacts": [{"stage": ref.stage, "key": ref.key, "content_digest": ref.content_digest} for ref in refs],
        "columns": [
            {"name": c.name, "type": _type_words(c), "unit": c.unit, "meaning": c.meaning} for c in table.columns
        ],
        "rows": _first_rows(store, text, num_rows),
        "lineage": [
            {
                "depth": step.depth,
                "stage": step.ref.stage,
                "key": step.ref.key,
                "partition": "" if step.manifest is None else step.manifest.partition,
                "name": "(gone)" if step.manifest is None else step.manifest.name,
            }
            for step in steps
        ],
        "files": [{"name": use.name, "sha256": use.sha256, "stage": use.stage} for use in source_files(steps)],
        "sources": [{"name": s.name, "licence": s.licence, "credit": s.credit} for s in sources],
    }


def _joint_lines_of(store: Store, text: str) -> list[str]:
    """Return the poses of one row, joint by joint."""
    (batch,) = iter_rows(text, store)
    lines = []
    for column in TABLES[parse_reference(text).table].columns:
        values = batch.row(0).get(column.name)
        if column.joints in WORKING_SKELETONS and column.unit in ("m", "px") and column.shape[-1:] in ((2,), (3,)):
            table = joint_lines(np.asarray(values), column.joints, unit=column.unit)
            lines += [f"{column.name}: {column.meaning}", *table]
    return lines


def _score_lines(store: Store, text: str, asked_rows: int | None) -> Iterator[str]:
    """Yield the scores of each topic as a table, of means if there are several items, with a star at the best."""
    topics: dict[str, list[Score]] = {}
    for batch in iter_rows(text, store):
        for index in range(batch.num_rows):
            row = batch.row(index)
            # Scores of an earlier version have no intervals.
            identity = {name: row[name] for name in COLUMNS if name in row}
            values = {name: value.item() if hasattr(value, "item") else value for name, value in identity.items()}
            topics.setdefault(str(row["topic"]), []).append(Score(**values))
    num_figures, default = sum(map(len, topics.values())), _SCORE_ROWS if len(topics) == 1 else _ROWS_OF_MANY
    num_rows, scope = default if asked_rows is None else asked_rows, text.partition("/")[0]
    yield "* is the best of a row, where it is known what is better"
    for topic, scores in topics.items():
        means = mean_table(scores, caption="means over items", has_marks=True)
        table = means or score_table(scores, caption="figures", has_marks=True)
        yield from ("", f"{topic}: {table.caption}")
        yield from format_table(table.headings, table.rows[:num_rows], text_columns=range(len(table.headings)))
        if len(table.rows) > num_rows:
            more = f"--rows {len(table.rows)}" if len(topics) == 1 else f"pasdedeux show {scope}/{topic}"
            yield f"... {counted(len(table.rows) - num_rows, 'more row')}: {more}"
    yield f"all {num_figures:,} figures: --json --rows {num_figures}"


def _first_rows(store: Store, text: str, count: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for batch in iter_rows(text, store):
        for index in range(min(batch.num_rows, count - len(rows))):
            rows.append({name: _short(value) for name, value in batch.row(index).items()})
        if len(rows) >= count:
            break
    return rows


def _short(value: Any) -> Any:
    """Return a value for display: a long array as its shape."""
    if hasattr(value, "shape") and value.shape:
        return f"array{list(value.shape)}" if value.size > 4 else [round(float(x), 4) for x in value.ravel()]
    if hasattr(value, "item"):
        value = value.item()
    return round(value, 6) if isinstance(value, float) else value


def _type_words(column: Any) -> str:
    if column.shape:
        axes = " x ".join(f"{length} {axis}" for axis, length in zip(column.axes, column.shape, strict=True))
        return f"{column.type.value_type}[{axes}]"
    return str(column.type).replace("list<item: ", "list of ").rstrip(">")


def joint_lines(values: npt.NDArray[np.floating], joints: str, *, unit: str) -> list[str]:
    """Return a table of people (*batch, joint, 2 or 3) of the working skeleton of this name; "-" where NaN."""
    people = values.reshape(-1, *values.shape[-2:])
    header = [f"{letter} {axis}" for letter in person_names(len(people)) for axis in "xyz"[: people.shape[-1]]]
    decimals = 1 if unit == "px" else 3
    rows = [
        (name, *(f"{value:.{decimals}f}" if np.isfinite(value) else "-" for value in people[:, joint].ravel()))
        for joint, name in enumerate(WORKING_SKELETONS[joints].joint_names)
    ]
    return format_table((f"joint ({unit})", *header), rows)
