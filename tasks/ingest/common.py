"""What all parts of ingest share: the stage's name and version, names of sources, and names that a registry knows."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import AfterValidator

from tasks.stage import StageName

INGEST = StageName("ingest", 24)
ID = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
"""Names of takes and of sources."""


def one_of(names: Iterable[str]) -> AfterValidator:
    """Refuse a name that is neither in a registry nor "auto"; the allowed ones are listed."""
    allowed = ("auto", *names)

    def check(name: str) -> str:
        if name not in allowed:
            raise ValueError(f"should be one of {', '.join(allowed)}")
        return name

    return AfterValidator(check)
