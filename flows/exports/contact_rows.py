"""Contacts of takes, variants and reconstructed motions as rows, found at export."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

from flows.exports.casts import MOVING, Cast, casts
from flows.exports.export_format import Export
from pasdedeux.augmentation import Source
from pasdedeux.errors import InputError
from storage_schema import TABLES, ArtifactRef, Reference, Store, TableData, UnknownReference, resolve
from storage_schema.encoding import encode
from tasks.rows.contacts import ContactRows, find_contact_rows

CONTACTS = TABLES["contacts"].name
_PARTS = {"poses": ("take_id",), "variants": ("take_id", "variant_id"), "motions": ("sequence_id", "method")}
"""Columns of the parts of a cast's name."""


def touching(store: Store, reference: Reference) -> tuple[ArtifactRef, ...]:
    """Return the artifacts with takes, variants and motions for a reference to contacts.

    Raises:
        InputError: There are none, or a row is named.
    """
    refs: list[ArtifactRef] = []
    for table in MOVING if reference.row is None else ():
        with suppress(UnknownReference):
            refs += resolve(replace(reference, table=table), store)
    if not refs:
        raise InputError(
            f"'{reference.text}': contacts are found in all takes, variants and reconstructed motions of a study, a "
            "partition, a dataset or a key; here are none"
        )
    return tuple(dict.fromkeys(refs))


def contact_rows(export: Export) -> Iterator[TableData]:
    """Yield the rows of the table `contacts`, one motion at a time."""
    contact_table = TABLES[CONTACTS]
    for table, names in _PARTS.items():
        refs = tuple(ref for ref in export.refs if table in export.store.manifest(ref).tables)
        for cast in casts(replace(export, reference=replace(export.reference, table=table), refs=refs)):
            contacts, first_frame = _contacts_of(export.store, cast), 0 if cast.seen is None else cast.seen.frames[0]
            count, frame = len(contacts.frame), contacts.frame + first_frame
            rows = {name: [str(part)] * count for name, part in zip(names, cast.parts, strict=False)}
            rows |= {"origin": [table] * count} | contacts.columns() | {"frame": frame, "time_s": frame / cast.rate_hz}
            yield TableData(contact_table, encode(contact_table, rows))


def _contacts_of(store: Store, cast: Cast) -> ContactRows:
    """Return the contacts of a motion; a reconstructed one has no objects and no stated contacts."""
    assert cast.ref is not None
    name = " ".join(map(str, cast.parts))
    if cast.seen is None:
        return find_contact_rows(store, cast.ref, cast.positions_m, name)
    return ContactRows.of(Source(cast.positions_m, cast.rate_hz, name))
