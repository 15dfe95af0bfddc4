"""References: how a person names rows of a table, and the documented way to read them from Python.

- `poses@3fa9`: the part of the table in the artifact whose key starts with these digits (4 at least)
- `poses:duets/waltz`: every shard of a partition, as the last run of the study made it; `poses:duets` all partitions
- `poses:released@2`: every part of the table in version 2 of the dataset `released`
- `draws@3fa9#17`: row 17 of any of these, counted from 0
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from storage_schema.credits import SourceCredit
from storage_schema.datasets import open_dataset
from storage_schema.errors import CorruptArtifact, MissingArtifact, OlderSchema, UnknownReference
from storage_schema.licences import source_credits
from storage_schema.manifest import ArtifactRef
from storage_schema.runs import latest_studies, read_latest
from storage_schema.store import Store
from storage_schema.table_data import TableData, concatenate
from storage_schema.tables import TABLES

_BY_KEY = re.compile(r"(?P<table>\w+)@(?P<key>[0-9a-fA-F]{4,64})(#(?P<row>\d+))?")
_BY_NAME = re.compile(r"(?P<table>\w+):(?P<scope>[^#]+)(#(?P<row>\d+))?")
_HOW = "a reference is table@key, table:study/partition or table:dataset@version, with #row for one row"


@dataclass(frozen=True)
class Reference:
    """A parsed reference: text, table, and one of key prefix, study (perhaps with a partition), or dataset.

    A prefix of no key is taken for that of a content digest, by which tables refer to artifacts.
    """

    table: str
    key_prefix: str = ""
    study: str = ""
    partition: str | None = None
    dataset: str = ""
    row: int | None = None
    text: str = field(default="", compare=False)


def parse_reference(text: str) -> Reference:
    """Read the text of a reference.

    Raises:
        UnknownReference: It has another form, or names a table that does not exist.
    """
    match = _BY_KEY.fullmatch(text) or _BY_NAME.fullmatch(text)
    if match is None:
        raise UnknownReference(f"'{text}' is not a reference: {_HOW}")
    parts = match.groupdict()
    if parts["table"] not in TABLES:
        raise UnknownReference(f"'{text}': there is no table '{parts['table']}'; tables: {', '.join(TABLES)}")
    row = None if parts["row"] is None else int(parts["row"])
    if "key" in parts:
        return Reference(parts["table"], text=text, key_prefix=parts["key"].lower(), row=row)
    scope = parts["scope"]
    if "@" in scope and "/" not in scope:
        return Reference(parts["table"], text=text, dataset=scope, row=row)
    study, slash, partition = scope.partition("/")
    return Reference(parts["table"], text=text, study=study, partition=partition if slash else None, row=row)


def resolve(reference: Reference | str, store: Store) -> list[ArtifactRef]:
    """Return the artifacts that a reference names, in order.

    Raises:
        UnknownReference: It names nothing, or a key prefix names several artifacts; lists the known names.
        MissingArtifact: A recorded artifact of the stage that writes the table is no longer complete in the store.
    """
    if isinstance(reference, str):
        reference = parse_reference(reference)
    if reference.key_prefix:
        return [_by_key(reference, store)]
    if reference.dataset:
        refs = list(open_dataset(store, reference.dataset).refs)
        name = f"dataset {reference.dataset}"
    else:
        refs = _of_study(reference, store)
        name = f"study '{reference.study}'" + (f", partition '{reference.partition}'" if reference.partition else "")
    manifests = [store.manifest(ref) for ref in refs]
    with_table = [manifest.ref for manifest in manifests if reference.table in manifest.tables]
    if not with_table:
        there = sorted({table for manifest in manifests for table in manifest.tables})
        raise UnknownReference(f"{name} holds no table '{reference.table}'; it holds: {', '.join(there) or 'none'}")
    return with_table


def referenced_credits(store: Store, reference: Reference, refs: Sequence[ArtifactRef]) -> tuple[SourceCredit, ...]:
    """Return licence and credit of every source of a reference; a dataset keeps those that it was made with.

    Raises:
        MissingArtifact: An ancestor of the artifacts is no longer in the store.
    """
    if reference.dataset:
        return open_dataset(store, reference.dataset).sources
    return source_credits(store, *refs)


def open_table(
    reference: Reference | str, store: Store | str | Path | None = None, *, columns: Sequence[str] | None = None
) -> TableData:
    """Read the rows that a reference names, such as `poses:duets/waltz` or `draws@3fa9#17`: the documented Python way.

    Args:
        reference: The reference.
        store: Store or its folder; None is `$PASDEDEUX_STORE`, else the folder `store` here.
        columns: Columns to read, all when None.

    Returns:
        The rows, those of several shards one after another; `data["pair17_m"]` is a numpy array (rows, *axes).

    Raises:
        UnknownReference: The reference names nothing or several things.
        MissingArtifact: An artifact is not in the store.
        SchemaError: A column is not in the table.
    """
    opened, parsed = _opened(reference, store)
    parts = [opened.read(ref, parsed.table, columns=columns, rows=rows) for ref, rows in find_rows(parsed, opened)]
    return concatenate(TABLES[parsed.table], parts)


def iter_rows(
    reference: Reference | str, store: Store | str | Path | None = None, *, columns: Sequence[str] | None = None
) -> Iterator[TableData]:
    """Yield the rows of `open_table` some 10,000 at a time, so that memory stays bounded; raises the same."""
    opened, parsed = _opened(reference, store)
    for ref, rows in find_rows(parsed, opened):
        if parsed.row is None:
            yield from opened.iter_batches(ref, parsed.table, columns=columns)
        else:
            yield opened.read(ref, parsed.table, columns=columns, rows=rows)


def table_files(reference: Reference | str, store: Store | str | Path | None = None) -> list[Path]:
    """Return the Parquet files whose rows a reference names, for pandas, polars, DuckDB; raises what `resolve` raises.

    The files are for reading only. The row of a reference is ignored.
    """
    opened, parsed = _opened(reference, store)
    return [opened.table_path(ref, parsed.table) for ref in resolve(parsed, opened)]


def find_rows(reference: Reference, store: Store) -> list[tuple[ArtifactRef, slice]]:
    """Return the artifacts that a reference names, with its rows in their parts of the table.

    Raises what `resolve` raises, and UnknownReference if there is no such row.
    """
    parts = [(ref, store.manifest(ref).tables[reference.table].rows) for ref in resolve(reference, store)]
    if reference.row is None:
        return [(ref, slice(0, num_rows)) for ref, num_rows in parts]
    row, left = reference.row, reference.row
    for ref, num_rows in parts:
        if left < num_rows:
            return [(ref, slice(left, left + 1))]
        left -= num_rows
    raise UnknownReference(f"'{reference.text}': there is no row {row}, the table has {row - left} rows here")


def _opened(reference: Reference | str, store: Store | str | Path | None) -> tuple[Store, Reference]:
    """Return the store as it is now; None is `$PASDEDEUX_STORE`, else the folder `store` here."""
    parsed = parse_reference(reference) if isinstance(reference, str) else reference
    if isinstance(store, Store):
        return store, parsed
    opened = Store(store if store is not None else os.environ.get("PASDEDEUX_STORE", "store"))
    opened.refresh()
    return opened, parsed


def _by_key(reference: Reference, store: Store) -> ArtifactRef:
    table, prefix = reference.table, reference.key_prefix
    manifests = [store.find(folder.parent.parent.name, folder.name) for folder in store.folders(key_prefix=prefix)]
    valid = [manifest for manifest in manifests if manifest is not None]
    if not valid:  # artifacts with the same content hold the same rows
        valid = list(
            {
                manifest.ref: manifest
                for manifest in store.artifacts()
                if manifest.ref.content_digest.startswith(prefix)
            }.values()
        )
    refs = [manifest.ref for manifest in valid if table in manifest.tables]
    if len(refs) == 1:
        return refs[0]
    if refs:
        listed = ", ".join(f"{ref.stage}@{ref.key[:16]}" for ref in refs[:8])
        raise UnknownReference(f"'{table}@{prefix}' names {len(refs)} artifacts; give more digits: {listed}")
    if valid:
        there = ", ".join(sorted({name for manifest in valid for name in manifest.tables}))
        raise UnknownReference(f"'{table}@{prefix}': the artifact holds no such table; it holds: {there}")
    raise UnknownReference(f"'{table}@{prefix}': no artifact in the store {store} has such a key or content")


def _of_study(reference: Reference, store: Store) -> list[ArtifactRef]:
    latest = read_latest(store, reference.study)
    if latest is None:
        there = ", ".join(latest_studies(store)) or "none"
        raise UnknownReference(
            f"study '{reference.study}' has not run in the store {store}; studies that have: {there}; "
            "`pasdedeux run` builds a study, --store names another store"
        )
    refs = latest.refs(partition=reference.partition)
    if not refs:
        partitions = sorted({shard.partition for shards in latest.stages.values() for shard in shards})
        raise UnknownReference(
            f"study '{reference.study}' has no partition '{reference.partition}'; it has: {', '.join(partitions)}"
        )
    whole = {ref: manifest for ref in refs if (manifest := store.find(ref.stage, ref.key)) is not None}
    # One stage writes a table; missing artifacts of other stages do not matter.
    stages = {ref.stage for ref, manifest in whole.items() if reference.table in manifest.tables}
    for ref in refs:
        if ref not in whole and (ref.stage in stages or not stages):
            raise MissingArtifact(
                f"artifact {ref.stage}@{ref.key[:12]} of study '{reference.study}' {what_is_wrong(ref, store)} "
                f"in the store {store}; run the study again"
            )
    return list(whole)


def what_is_wrong(ref: ArtifactRef, store: Store) -> str:
    """Return why an artifact that a study recorded cannot be read."""
    try:
        outdated = store.outdated_tables(store.load(ref.stage, ref.key))
    except OlderSchema:
        return "is of an older schema"
    except (MissingArtifact, CorruptArtifact):
        outdated = []
    return f"has columns of an earlier version ({', '.join(outdated)})" if outdated else "is incomplete"
