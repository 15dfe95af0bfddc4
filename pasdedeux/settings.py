"""The base of settings: what a user may choose, with default, range, unit and meaning in one place."""

from __future__ import annotations

from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.config import JsonDict

NOT_A_KEY: Final[JsonDict] = {"is_key": False}
"""`json_schema_extra` of a field that the program fills in: it is on record, and no key of a study."""


class Settings(BaseModel):
    """Settings of one part of the science: frozen, and unknown names are refused.

    A stage's section of a study is made of the settings of what it runs (by inheritance or as a field), so that a
    default, its range and its meaning stand in one place: where the science that they steer is.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")


def first_problem(error: ValidationError) -> str:
    """Return the first fault of a validation error: its place in the values, and the message."""
    first = error.errors()[0]
    place, message = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
    return f"{place}: {message}" if place else message
