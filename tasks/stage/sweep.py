"""Sweeps: named repetitions of a study's section with other keys."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import Field, StringConstraints, field_validator

from tasks.stage import Parameters

SweepName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]*$")]


class SweptParameters(Parameters):
    """A section that a study may repeat with other settings: the section itself, and one for each entry of `sweep`."""

    sweep: dict[SweepName, dict[str, Any]] = Field(
        {}, description="By a name of your own, keys of this section: it is computed once more with them"
    )

    @field_validator("sweep")
    @classmethod
    def _is_flat(cls, sweep: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        for name, section in sweep.items():
            if "sweep" in section:
                raise ValueError(f"'{name}' sets sweep, and a sweep has no sweeps")
        return sweep

    def swept_values(self) -> dict[str, dict[str, Any]]:
        """Return all values of the section of each sweep, by its name; tables are merged, lists replaced."""
        base = self.model_dump(exclude={"sweep"})
        return {name: merged(base, section) for name, section in self.sweep.items()}

    def swept(self) -> dict[str, Self]:
        """Return the section of each sweep by its name.

        Raises:
            ValidationError: A key or a value is not allowed; a study that is loaded has been checked.
        """
        return {name: type(self).model_validate(values) for name, values in self.swept_values().items()}


def merged(base: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a section overridden by those of a sweep; tables are merged, lists replaced."""
    values = dict(base)
    for name, value in overrides.items():
        before = values.get(name)
        values[name] = merged(before, value) if isinstance(before, dict) and isinstance(value, dict) else value
    return values
