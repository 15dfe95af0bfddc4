"""Contacts that are known of a take, read from a table."""

from __future__ import annotations

from pydantic import ValidationError

from pasdedeux.errors import FormatError
from pasdedeux.formats.text import decode, parse_table
from pasdedeux.interaction.contacts import UserContact

__all__ = ["read_contacts"]


def read_contacts(data: bytes) -> tuple[UserContact, ...]:
    """Read a CSV whose columns are the fields of `UserContact`, a contact each row; what is empty has its default.

    Raises:
        FormatError: A column, joint or value is not known or allowed; the line is named.
    """
    columns, rows = parse_table(decode(data, "table of contacts"))
    known = list(UserContact.model_fields)
    unknown = [name for name in columns if name not in known]
    if unknown:
        raise FormatError(f"line 1: the column '{unknown[0]}' is not known; known: {', '.join(known)}")
    found = []
    for line, row in rows:
        try:
            found.append(UserContact.model_validate({name: value for name, value in row.items() if value}))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            said = f"{place}: {first['msg']}" if place else first["msg"]
            raise FormatError(f"line {line}: {said.replace('Value error, ', '')}") from None
    return tuple(found)
