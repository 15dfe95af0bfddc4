"""Base of settings: a user's choices, with default, range, unit and meaning in one place."""

from __future__ import annotations

from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.config import JsonDict

NOT_A_KEY: Final[JsonDict] = {"is_key": False}
"""`json_schema_extra` of a field that the program fills in: it is recorded, but is no key of a study."""


class Settings(BaseModel):
    """Settings of one part of the science: frozen, and unknown names are refused.

    A stage's section of a study consists of the settings of the methods that it runs, by inheritance or as fields. So
    each default, range and meaning stands once, beside its method.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")


def first_problem(error: ValidationError) -> str:
    """Return the first fault of a validation error: the path of the value, and the message."""
    first = error.errors()[0]
    place, message = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
    return f"{place}: {message}" if place else message
