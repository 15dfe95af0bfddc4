"""Exports rows of the store to files of other formats, with licence and credits.

A new format is one module whose `FORMAT` is an `ExportFormat`, and one line in `EXPORT_FORMATS`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from flows.exports.contact_rows import CONTACTS, contact_rows, touching
from flows.exports.credits import write_credits
from flows.exports.export_format import POSED_OPTIONS, Export, ExportFormat, Rate, RestPose, Units
from pasdedeux.errors import InputError
from storage_schema import TABLES, Store, TableData, UnknownReference, parse_reference, referenced_credits, resolve
from storage_schema.encoding import encode
from tasks.files.curation import IDENTITY, choices_for, content_of, rejections
from tasks.rows.selection import READS, select_pairs

EXPORT_FORMATS = {
    "npz": "flows.exports.npz_table",
    "csv": "flows.exports.csv_table",
    "bvh": "flows.exports.bvh_motions",
    "glb": "flows.exports.glb_figures",
    "c3d": "flows.exports.c3d_markers",
    "trc": "flows.exports.trc_markers",
    "smpl": "flows.exports.smpl_parameters",
    "coco": "flows.exports.coco_keypoints",
    "mp4": "flows.exports.overlay_video",
    "json": "flows.exports.json_pairs",
    "safetensors": "flows.exports.model_weights",
}
"""Module of each format by its name; imported on use, so that help is quick."""

_OWN_SKELETON_TABLES = ("poses", "variants")
"""Tables that are exported on the source's own skeleton."""
_BY_BLENDER = {"fbx", "usd", "usda", "usdc", "usdz"}
"""Formats that Blender writes from a GLB."""
_ALL_REJECTED = "'{}': all of it is rejected, so that there is nothing to export; see `pasdedeux curate`"


def export_format(name: str) -> ExportFormat:
    """Return the format of this name, or an InputError that lists the known ones."""
    if name not in EXPORT_FORMATS:
        how = "; docs/formats-and-units.md has the lines by which Blender makes it from a GLB" * (name in _BY_BLENDER)
        raise InputError(f"export format '{name}' is not known; known formats: {', '.join(EXPORT_FORMATS)}{how}")
    file_format = import_module(EXPORT_FORMATS[name]).FORMAT
    assert isinstance(file_format, ExportFormat)
    return file_format


def export_reference(
    store: Store,
    text: str,
    file_format: str,
    out: Path,
    *,
    rest_pose: RestPose = "source",
    units: Units = "cm",
    rate: Rate = "study",
    curation: Path | None = None,
    **options: Any,
) -> list[Path]:
    """Write the rows of a reference into a folder, and return the files, the credits last.

    Rejected items are left out, by this file of choices, else by that of the study or dataset. `options` are those of
    some formats only, by their names in `Export`: verdict, all_methods, footage, body_model.

    Raises:
        InputError: The format is unknown, cannot hold the rows, or has no choice of rest pose, unit or rate.
        UnknownReference: The reference names nothing.
    """
    reference = parse_reference(text)
    kind = _format_for(file_format, options)
    choices = choices_for(store, reference, curation)
    if reference.table == CONTACTS:
        refs, options = touching(store, reference), options | {"make_rows": contact_rows}
    else:
        refs = tuple(resolve(reference, store))
    export = Export(store, text, reference, refs, rest_pose, units, rate=rate, choices=choices, **options)
    if not kind.can_write(reference):
        raise InputError(f"'{text}' cannot be written as {file_format.upper()}; allowed are {kind.writes}")
    is_own = kind.has_rest_pose and reference.table in _OWN_SKELETON_TABLES
    if (rest_pose != "source" and not is_own) or (units != "cm" and not (is_own and file_format == "bvh")):
        tables = " and ".join(_OWN_SKELETON_TABLES)
        raise InputError(
            f"rest pose and units can be chosen for BVH files of {tables}, the rest pose for GLB files, too, not for "
            f"'{text}' as {file_format.upper()}"
        )
    if rate != "study" and not (kind.options >= POSED_OPTIONS and reference.table in _OWN_SKELETON_TABLES):
        raise InputError(
            f"the rate can be chosen for files of motion of {' and '.join(_OWN_SKELETON_TABLES)}, not for "
            f"'{text}' as {file_format.upper()}"
        )
    return _written(export, kind, out)


def export_selection(
    store: Store, text: str, file_format: str, out: Path, *, count: int, **options: Any
) -> tuple[list[Path], str]:
    """Write a selection of pairs that represents all of a study; return the files and a sentence on the selection.

    Raises:
        InputError: The format is unknown or cannot hold tables, no whole study is named, or nothing is plausible.
        UnknownReference: The reference names nothing.
    """
    reference = parse_reference(text)
    if (
        reference.table != "draws"
        or reference.key_prefix
        or reference.partition is not None
        or reference.row is not None
    ):
        raise InputError(
            f"'{text}': pairs are selected among all of a study, draws:study, or of a dataset, draws:name@1"
        )
    kind = _format_for(file_format, options)
    if not kind.can_write(reference):
        raise InputError(f"'{text}' cannot be written as {file_format.upper()}; allowed are {kind.writes}")
    refs = resolve(reference, store)
    for table in READS[1:]:
        with suppress(UnknownReference):  # without own joint limits, the published ones apply
            refs += resolve(replace(reference, table=table), store)
    selected = select_pairs(store, tuple(dict.fromkeys(refs)), count)
    if not selected.columns:
        raise InputError(f"'{text}': no draw and no grown pair of it is plausible")
    pair_table = TABLES["selected_pairs"]
    rows = TableData(pair_table, encode(pair_table, selected.columns))
    choices = choices_for(store, reference)
    kept = [at for at in range(rows.num_rows) if not _is_rejected(rows.row(at), choices)]
    if not kept:
        raise InputError(_ALL_REJECTED.format(text))
    chosen = TableData(pair_table, rows.rows.take(kept))
    export = Export(store, text, replace(reference, table=pair_table.name), selected.refs, selected=chosen, **options)
    rejected = f"; {rows.num_rows - len(kept)} of them left out, as rejected" if len(kept) < rows.num_rows else ""
    return _written(export, kind, out), selected.in_words() + rejected


def _is_rejected(row: Mapping[str, Any], choices: Mapping[str, str]) -> bool:
    """Return whether a selected pair is rejected as a draw or as a seed."""
    table = "draws" if row["origin"] in ("draw", "repaired") else "seeds"
    name = "/".join(str(row[column]) for column in IDENTITY[table])
    return rejections(choices, table).get(name) == content_of(row["pair17_m"])


def _format_for(name: str, options: Iterable[str]) -> ExportFormat:
    """Return a format that has these options."""
    kind = export_format(name)
    for option in options:
        if option not in kind.options:
            known = ", ".join(
                format_name for format_name in EXPORT_FORMATS if option in export_format(format_name).options
            )
            raise InputError(f"--{option.replace('_', '-')} is for {known}, not for {name}")
    return kind


def _written(export: Export, kind: ExportFormat, out: Path) -> list[Path]:
    is_made = export.make_rows is not None  # a motion without contacts has no rows
    is_chosen = export.choices and (is_made or export.left_out)
    if is_chosen and not any(is_made or batch.num_rows for batch in export.batches()):
        raise InputError(_ALL_REJECTED.format(export.text))
    sources = referenced_credits(export.store, export.reference, export.refs)
    out.mkdir(parents=True, exist_ok=True)
    credits_path = write_credits(sources, export.refs, export.text, out)  # first, so that no file lacks them
    return [*kind.write(replace(export, sources=tuple(sources)), out), credits_path]
