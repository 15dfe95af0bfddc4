"""The base of settings: what a user may choose, with default, range, unit and meaning in one place."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """Settings of one part of the science: frozen, and unknown names are refused.

    A stage's section of a study is made of the settings of what it runs (by inheritance or as a field), so that a
    default, its range and its meaning stand in one place: where the science that they steer is.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
