"""Contacts as rows: who touches whom where, of takes, variants and reconstructed motions, found when they go out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from string import ascii_uppercase
from typing import Any

import numpy as np

from flows.exports.casts import MOVING, Cast, casts
from flows.exports.export_format import Export
from flows.exports.own_skeletons import take_of
from pasdedeux.augmentation import Source, UserContact
from pasdedeux.errors import InputError
from pasdedeux.interaction.objects import MovingObjects
from pasdedeux.skeletons import BODY22
from storage_schema import TABLES, ArtifactRef, Reference, Store, TableData, UnknownReference, resolve
from storage_schema.encoding import encode
from tasks.facts import TakeFacts
from tasks.takes import read_take

CONTACTS = TABLES["contacts"].name
_PARTS = {
    "poses": ("take_id",),
    "variants": ("take_id", "variant_id"),
    "motions": ("sequence_id", "method"),
}
"""Columns that the parts of a cast's name are."""


def touching(store: Store, reference: Reference) -> tuple[ArtifactRef, ...]:
    """Return the artifacts with takes, variants and motions that a reference to contacts names.

    Raises:
        InputError: There is none, or a row is named.
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
    """Yield the rows of the table `contacts`, those of one motion at a time."""
    for ref in export.refs:
        for table in MOVING:
            if table in export.store.manifest(ref).tables:
                one = replace(export, reference=replace(export.reference, table=table), refs=(ref,))
                for cast in casts(one):
                    rows = contact_columns(export.store, table, cast)
                    yield TableData(TABLES[CONTACTS], encode(TABLES[CONTACTS], rows))


def contact_columns(store: Store, table: str, cast: Cast) -> dict[str, Any]:
    """Return the contacts of one motion as columns of the table `contacts`.

    They are what `pasdedeux.interaction.contacts` finds: of a take those that augmentation keeps, of variants and
    motions their own.  A contact that is stated, by the study or a built-in duet, stands there in all variants of its
    take: whether they keep it its gap says.
    """
    objects: MovingObjects | None = None
    stated: tuple[UserContact, ...] = ()
    if table != "motions":
        assert cast.ref is not None
        ref = cast.ref if table == "poses" else take_of(store, cast.ref)
        objects, stated = read_take(store, ref).source.objects, TakeFacts.of(store.manifest(ref)).contacts
    source = Source(cast.positions_m, cast.rate_hz, " ".join(map(str, cast.parts)), objects=objects)
    found = source.contacts(stated)
    frame, at = np.nonzero(found.weights > 0.0)
    first_frame = cast.seen.frames[0] if cast.seen is not None else 0
    people = cast.positions_m.reshape(len(cast.positions_m), -1, 3)
    ends, bones, thing = found.ends(people)[frame, at], found.bones()[frame, at], found.objects[frame, at]
    radii, shares = source.radii_m.ravel(), found.shares[frame, at]
    names = [*ascii_uppercase[: source.num_people]]
    person, joint = np.divmod(np.maximum(bones, 0), BODY22.num_joints)
    reach = radii[bones[:, 0]] + np.where(thing < 0, radii[np.maximum(bones[:, 1], 0)], 0.0)
    if objects is not None:
        reach += np.where(thing >= 0, objects.radii_m[thing], 0.0)
    distance = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=-1)
    is_body = (thing < 0).tolist()
    parts = zip(_PARTS[table], cast.parts, strict=True)
    return {name: [str(part)] * len(frame) for name, part in parts} | {
        "origin": [table] * len(frame),
        "frame": frame + first_frame,
        "time_s": (frame + first_frame) / cast.rate_hz,
        "person": [names[one] for one in person[:, 0]],
        "bone": [BODY22.joint_names[one] for one in joint[:, 0]],
        "share": shares[:, 1],
        "point_m": ends[:, 0],
        "partner": [names[one] if body else None for one, body in zip(person[:, 1], is_body, strict=True)],
        "partner_bone": [
            BODY22.joint_names[one] if body else objects.names[number]  # type: ignore[union-attr]
            for one, number, body in zip(joint[:, 1], thing, is_body, strict=True)
        ],
        "partner_share": [-share if body else None for share, body in zip(shares[:, 3].tolist(), is_body, strict=True)],
        "partner_point_m": ends[:, 1],
        "distance_m": distance,
        "gap_m": distance - reach,
        "weight": found.weights[frame, at],
        "is_held": found.is_held[frame, at],
    }
