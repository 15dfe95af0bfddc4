"""`show` and `export`: look at rows of what was built, or write them into files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from string import ascii_uppercase
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from typer import Argument, Option

from flows.console.context import JsonOption, StoreOption, answer, app, open_store, say
from flows.console.display import counted, format_table
from flows.exports import EXPORT_FORMATS, RestPose, Units, export_reference
from pasdedeux.arrays import Array
from pasdedeux.evaluation.score_tables import mean_table, score_table
from pasdedeux.evaluation.scores import COLUMNS, Score
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
_ROWS, _SCORE_ROWS = 5, 12

ReferenceArgument = Annotated[
    str, Argument(metavar="REF", help="table@key, table:study/partition or table:dataset@version, with #row.")
]

_SHOW = """Print the columns, first rows and lineage of what a reference names.

\b
  pasdedeux show poses:duets                 every part of a table, as the last run of a study made it
  pasdedeux show scores:duets                a table a topic, the better value marked
  pasdedeux show draws@3fa9c0#17             one row: its poses drawn, their joints by name
"""
_EXPORT = """Export what a reference names to files, with licence and credits.

\b
  npz   numpy arrays, one file: every table
  csv   one line per row, arrays as columns: every table
  bvh   motion files: poses and variants (the source's own skeleton, an npz beside), motions (a humanoid), seeds,
        one draw
  json  both people with named joints, for editing: seeds, one draw
\b
  pasdedeux export variants:duets/waltz --format bvh --out waltz_variants
  pasdedeux export poses:duets --format bvh --rest-pose standing --out takes
"""


@app.command(help=_SHOW)
def show(
    reference: ReferenceArgument,
    store: StoreOption = Path("store"),
    rows: Annotated[int | None, Option(min=0, help=f"Rows to show: {_ROWS}, of scores {_SCORE_ROWS} a topic.")] = None,
    has_files: Annotated[bool, Option("--files", help="Only the paths of the Parquet files, one a line.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show what a reference names."""
    opened = open_store(store)
    if has_files:
        say(map(str, table_files(reference, opened)))
        return
    described = _describe(opened, reference, _ROWS if rows is None else rows)
    if described["table"] == SCORES and described["row"] is None:
        lines = _score_lines(opened, reference, _SCORE_ROWS if rows is None else rows)
    else:
        lines = _row_lines(described, opened, reference)
    heading = [
        f"{described['table']}: {described['meaning']}",
        f"{counted(described['num_rows'], 'row')} in {counted(len(described['artifacts']), 'artifact')}",
    ]
    sources = [f"  source {one['name']}: {one['licence']}; {one['credit']}" for one in described["sources"]]
    answer(described, chain(heading, lines, sources), as_json=as_json)


def _row_lines(described: Mapping[str, Any], store: Store, reference: str) -> Iterator[str]:
    """Return columns, rows and where they come from."""
    cells = [(f"  {c['name']}", c["type"], c["unit"], c["meaning"]) for c in described["columns"]]
    yield from format_table(("  column", "type", "unit", "meaning"), cells, text_columns=range(4))
    if described["rows"]:
        yield "first rows:" if described["row"] is None else "the row:"
    for number, row in enumerate(described["rows"], described["row"] or 0):
        yield f"  #{number} " + ", ".join(f"{name}={value}" for name, value in row.items())
    if described["row"] is not None:
        yield from _drawn(store, reference)
    yield "comes from:"
    for step in described["lineage"]:
        place = f"{step['stage']}@{step['key'][:12]} {step['partition']} {step['name']}".rstrip()
        yield f"  {'  ' * step['depth']}{place}"
    for file in described["files"]:
        yield f"  file {file['name']} (sha256 {file['sha256'][:12]}, read by {file['stage']})"


@app.command(help=_EXPORT)
def export(
    reference: ReferenceArgument,
    out: Annotated[Path, Option("--out", metavar="DIR", help="Folder for the files; made when missing.")],
    file_format: Annotated[str, Option("--format", metavar="NAME", help=f"{', '.join(EXPORT_FORMATS)}.")] = "npz",
    rest_pose: Annotated[RestPose, Option(help="Of poses and variants: the source's, or a T-pose.")] = "source",
    units: Annotated[Units, Option(help="Lengths of their BVH files; `source`: as in each source's file.")] = "cm",
    store: StoreOption = Path("store"),
) -> None:
    """Write what a reference names into files."""
    say(map(str, export_reference(open_store(store), reference, file_format, out, rest_pose=rest_pose, units=units)))


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


def _drawn(store: Store, text: str) -> list[str]:
    """Draw the poses of one row, with their numbers by joint."""
    (batch,) = iter_rows(text, store)
    lines = []
    for column in TABLES[parse_reference(text).table].columns:
        values = batch.row(0).get(column.name)
        if column.joints in WORKING_SKELETONS and column.unit in ("m", "px") and column.shape[-1:] in ((2,), (3,)):
            drawn = pose_lines(np.asarray(values), column.joints, unit=column.unit)
            lines += [f"{column.name}: {column.meaning}", *drawn]
    return lines


def _score_lines(store: Store, text: str, num_rows: int) -> Iterator[str]:
    """Return scores as a table a topic: means over items where there are several, the best of a row with a star."""
    topics: dict[str, list[Score]] = {}
    for batch in iter_rows(text, store):
        for index in range(batch.num_rows):
            row = batch.row(index)
            # Scores of an earlier version have no intervals.
            found = {name: row[name] for name in COLUMNS if name in row}
            values = {name: value.item() if hasattr(value, "item") else value for name, value in found.items()}
            topics.setdefault(str(row["topic"]), []).append(Score(**values))
    num_figures = sum(map(len, topics.values()))
    yield "* is the best of a row, where it is known what is better"
    for topic, scores in topics.items():
        means = mean_table(scores, caption="means over items", has_marks=True)
        table = means or score_table(scores, caption="figures", has_marks=True)
        yield from ("", f"{topic}: {table.caption}")
        yield from format_table(table.headings, table.rows[:num_rows], text_columns=range(len(table.headings)))
        if len(table.rows) > num_rows:
            more = f"... {len(table.rows) - num_rows} more rows: --rows {len(table.rows)}"
            yield f"{more}; all figures: --json --rows {num_figures}"


def _first_rows(store: Store, text: str, count: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for batch in iter_rows(text, store):
        for index in range(min(batch.num_rows, count - len(rows))):
            rows.append({name: _short(value) for name, value in batch.row(index).items()})
        if len(rows) >= count:
            break
    return rows


def _short(value: Any) -> Any:
    """Return a value a person can look at: a long array as its shape."""
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


_BRAILLE = 0x2800
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of a cell's dots, four rows of two (Unicode, block Braille Patterns)."""
_WIDTH, _HEIGHT = 26, 17
_VIEWS = {2: {"image": (0, 1, 1.0)}, 3: {"front": (0, 1, -1.0), "side": (2, 1, -1.0)}}
"""Views by the number of axes: what goes right, what goes up or down, and its sign on the screen."""


def pose_lines(values: npt.NDArray[np.floating], joints: str, *, unit: str) -> list[str]:
    """Return the lines of people (*batch, joint, 2 or 3) of the working skeleton of this name.

    People in space are seen along -Z (front) and along +X (side), images as they are.  NaN, joints that are not there,
    are not drawn.
    """
    skeleton = WORKING_SKELETONS[joints]
    people = values.reshape(-1, *values.shape[-2:]).astype(np.float64)
    views = _VIEWS[people.shape[-1]]
    drawn = [
        _draw_people(people[..., [right, down]] * [1.0, sign], skeleton.bones) for right, down, sign in views.values()
    ]
    heading = "  ".join(f"{name:<{_WIDTH}}" for name in views)
    picture = [heading, *("  ".join(row) for row in zip(*drawn, strict=True))]
    header = [f"{letter} {axis}" for letter in ascii_uppercase[: len(people)] for axis in "xyz"[: people.shape[-1]]]
    decimals = 1 if unit == "px" else 3
    rows = [
        (name, *(f"{value:.{decimals}f}" if np.isfinite(value) else "-" for value in people[:, joint].ravel()))
        for joint, name in enumerate(skeleton.joint_names)
    ]
    numbers = format_table((f"joint ({unit})", *header), rows)
    height = max(len(picture), len(numbers))
    left = [*picture, *[" " * len(heading)] * (height - len(picture))]
    right = [*numbers, *[""] * (height - len(numbers))]
    return [f"{one}   {other}".rstrip() for one, other in zip(left, right, strict=True)]


def braille_lines(segments: Array, *, width: int, height: int) -> list[str]:
    """Draw segments (n, 2, 2) in dots, x right and y down, into width x height letters; nothing outside.

    >>> braille_lines(np.array([[[0.0, 0.0], [3.0, 3.0]]]), width=2, height=1)
    ['⠑⢄']
    """
    cells = np.zeros((height, width), dtype=np.int64)
    for start, end in segments[np.isfinite(segments).all(axis=(1, 2))]:
        steps = int(np.abs(end - start).max()) + 1
        dots = np.round(start + (end - start) * np.linspace(0.0, 1.0, steps + 1)[:, None]).astype(np.int64)
        column, row = dots[((dots >= 0) & (dots < (2 * width, 4 * height))).all(axis=1)].T
        np.bitwise_or.at(cells, (row // 4, column // 2), _DOTS[row % 4, column % 2])
    return ["".join(chr(_BRAILLE + cell) if cell else " " for cell in row) for row in cells.tolist()]


def _draw_people(seen: Array, bones: Sequence[tuple[int, int]]) -> list[str]:
    """Draw people (person, joint, 2), y down, as large as fits."""
    finite = seen[np.isfinite(seen).all(axis=-1)]
    low, high = (finite.min(axis=0), finite.max(axis=0)) if len(finite) else (np.zeros(2), np.ones(2))
    room = np.array([2 * _WIDTH - 1, 4 * _HEIGHT - 1])
    scale = float((room / np.maximum(high - low, 1e-9)).min())
    dots = (seen - (low + high) / 2.0) * scale + room / 2.0
    return braille_lines(dots[:, np.array(bones)].reshape(-1, 2, 2), width=_WIDTH, height=_HEIGHT)
