"""Croissant metadata of a dataset's folder (MLCommons Croissant 1.1 with RAI), with a record set for each table."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import pyarrow as pa

from flows.dataset_folder.layout import FolderFile
from storage_schema import TABLES, Dataset
from storage_schema.arrow import ColumnKind, column_kind, value_type
from storage_schema.columns import Column

_TEMPLATES = files("flows.templates")
_CONTEXT = json.loads((_TEMPLATES / "croissant_context.json").read_text("utf-8"))
_PARQUET = "application/x-parquet"
_TYPES = {
    pa.float32(): "cr:Float32",
    pa.float64(): "cr:Float64",
    pa.int32(): "cr:Int32",
    pa.int64(): "cr:Int64",
    pa.bool_(): "sc:Boolean",
    pa.string(): "sc:Text",
}
ABOUT: Mapping[str, Any] = tomllib.loads((_TEMPLATES / "about_datasets.toml").read_text("utf-8"))
"""Properties of responsible AI that hold for every dataset."""


def croissant(dataset: Dataset, description: str, data: Mapping[str, FolderFile]) -> dict[str, Any]:
    """Return the metadata of a folder with these data files."""
    tables = sorted({name.split("/")[1] for name in data})
    licences = list(dict.fromkeys(source.licence for source in dataset.sources))
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": ["http://mlcommons.org/croissant/1.1", "http://mlcommons.org/croissant/RAI/1.0"],
        "name": dataset.name,
        "version": dataset.version if dataset.version.count(".") == 2 else f"{dataset.version}.0.0",
        "description": description,
        "license": licences,
        "url": f"https://mlcommons.org/croissant/#{dataset.name}",
        "creator": [{"@type": "sc:Organization", "name": source.name} for source in dataset.sources],
        "citeAs": "; ".join(dict.fromkeys(source.credit for source in dataset.sources)),
        "datePublished": dataset.created_at,
        **{f"rai:{name}": said for name, said in ABOUT.items()},
        "distribution": [_file_object(name, file) for name, file in data.items()]
        + [_file_set(name) for name in tables],
        "recordSet": [_record_set(table) for table in tables],
    }


def _file_object(name: str, file: FolderFile) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "encodingFormat": _PARQUET,
        "contentSize": f"{file.bytes} B",
        "sha256": file.sha256,
    }


def _file_set(table: str) -> dict[str, Any]:
    """Return the set of files of a table; without `containedIn` they are in the folder itself."""
    includes = f"data/{table}/*.parquet"
    return {"@type": "cr:FileSet", "@id": table, "name": table, "encodingFormat": _PARQUET, "includes": includes}


def _record_set(table: str) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": f"{table}-rows",
        "name": f"{table}-rows",
        "description": TABLES[table].meaning,
        "field": [_field(table, column) for column in TABLES[table].columns],
    }


def _field(table: str, column: Column) -> dict[str, Any]:
    kind = column_kind(column)
    shape: Sequence[int] = column.shape if kind is ColumnKind.FIXED else (-1,)
    axes = f" ({' x '.join(map(str, column.shape))}: {', '.join(column.axes)})" if column.shape else ""
    is_array = kind in (ColumnKind.FIXED, ColumnKind.VARYING, ColumnKind.TEXT_LIST)
    return {
        "@type": "cr:Field",
        "@id": f"{table}-rows/{column.name}",
        "name": f"{table}-rows/{column.name}",
        "description": f"{column.meaning}{f', {column.unit}' if column.unit else ''}{axes}",
        "dataType": _TYPES[value_type(column)],
        "source": {"fileSet": {"@id": table}, "extract": {"column": column.name}},
        **({"isArray": True, "arrayShape": ",".join(map(str, shape))} if is_array else {}),
    }
