"""What lies beside a dataset for programs that do not know this one: Croissant metadata, and a page for people.

Both name the Parquet files by their places relative to the dataset's folder, so the folder is read where it lies in its
store: `croissant.json` (MLCommons Croissant 1.0), and a `README.md` whose head the library `datasets` reads.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from storage_schema.columns import Column
from storage_schema.manifest import Identity, Manifest
from storage_schema.tables import TABLES

if TYPE_CHECKING:
    from storage_schema.datasets import Dataset

CROISSANT_FILE, README_FILE = "croissant.json", "README.md"
_CROISSANT_TERMS = (
    "citeAs column extract field fileObject fileProperty fileSet format includes isLiveDataset "
    "jsonPath key md5 parentField path recordSet references regex repeated replace separator source "
    "subField transform"
)
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in _CROISSANT_TERMS.split()},
}
"""The context that the specification prescribes."""
_PARQUET = "application/x-parquet"


def describe_dataset(
    dataset: Dataset, manifests: Sequence[Manifest], held_out: Collection[Identity]
) -> dict[str, bytes]:
    """Return both files by name, for these artifacts of a dataset.

    Artifacts that are held out, or that were computed from some that are, stand in the split `test`, all others in
    `train`.
    """
    refs = [manifest.ref for manifest in manifests]
    place_of = {ref: f"../../{ref.stage}/{ref.key[:2]}/{ref.key}" for ref in refs}
    test = {place_of[ref] for ref in refs if ref.identity in held_out}
    files = {
        table: {f"{place_of[one.ref]}/{table}.parquet": one.tables[table] for one in own}
        for table in sorted({name for one in manifests for name in one.tables})
        if (own := [one for one in manifests if table in one.tables])
    }

    def is_test(place: str) -> bool:
        return place.rpartition("/")[0] in test

    places = {place: f"{table}-{number}" for table, own in files.items() for number, place in enumerate(own)}
    objects = [
        {
            "@type": "cr:FileObject",
            "@id": places[place],
            "name": places[place],
            "contentUrl": place,
            "encodingFormat": _PARQUET,
            "contentSize": f"{file.bytes} B",
            "sha256": file.sha256,
        }
        for own in files.values()
        for place, file in own.items()
    ]
    sets = [
        {
            "@type": "cr:FileSet",
            "@id": table,
            "name": table,
            "containedIn": [{"@id": places[place]} for place in own],
            "encodingFormat": _PARQUET,
            "includes": "*.parquet",
        }
        for table, own in files.items()
    ]
    licences = list(dict.fromkeys(source.licence for source in dataset.sources))
    thanks = list(dict.fromkeys(source.credit for source in dataset.sources))
    described = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": dataset.name,
        "version": dataset.version,
        "description": dataset.note or f"{dataset.label}: {', '.join(files)}, made with pasdedeux.",
        "license": licences,
        "creator": [{"@type": "sc:Organization", "name": source.name} for source in dataset.sources],
        "citeAs": "; ".join(thanks),
        "datePublished": dataset.created_at,
        "distribution": [*objects, *sets],
        "recordSet": [_record_set(table) for table in files],
    }
    head = "".join(
        f"- config_name: {table}\n  data_files:\n{_split('train', [place for place in own if not is_test(place)])}"
        f"{_split('test', [place for place in own if is_test(place)])}"
        for table, own in files.items()
    )
    rows = "".join(
        f"| {table} | {sum(one.rows for one in own.values()):,} | {TABLES[table].meaning} |\n"
        for table, own in files.items()
    )
    text = (
        f"---\nconfigs:\n{head}---\n\n# {dataset.label}\n\n{described['description']}\n\n"
        f"Licence: {', '.join(licences)}. "
        f"Credit: {'; '.join(thanks)}\n\n| table | rows | |\n|---|---|---|\n{rows}"
    )
    return {CROISSANT_FILE: json.dumps(described, indent=1).encode(), README_FILE: text.encode()}


def _split(name: str, places: Sequence[str]) -> str:
    """Return the lines of a split in the head of the page; none where it has no files."""
    files = "".join(f"    - {json.dumps(place)}\n" for place in places)
    return f"  - split: {name}\n    path:\n{files}" if places else ""


def _record_set(table: str) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": f"{table}-rows",
        "name": f"{table}-rows",
        "description": TABLES[table].meaning,
        "field": [_field(table, column) for column in TABLES[table].columns],
    }


def _field(table: str, column: Column) -> dict[str, Any]:
    is_list = pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)
    value = column.type.value_type if is_list else column.type
    kinds = (
        (pa.types.is_floating, "sc:Float"),
        (pa.types.is_integer, "sc:Integer"),
        (pa.types.is_boolean, "sc:Boolean"),
    )
    kind = next((name for is_kind, name in kinds if is_kind(value)), "sc:Text")
    shape = f" ({' x '.join(map(str, column.shape))}: {', '.join(column.axes)})" if column.shape else ""
    unit = f", {column.unit}" if column.unit else ""
    return {
        "@type": "cr:Field",
        "@id": f"{table}-rows/{column.name}",
        "name": f"{table}-rows/{column.name}",
        "description": f"{column.meaning}{unit}{shape}",
        "dataType": kind,
        "source": {"fileSet": {"@id": table}, "extract": {"column": column.name}},
        **({"repeated": True} if is_list else {}),
    }
