"""Shared parts of ingest: name and version of the stage, names of sources, and names in registries."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import AfterValidator

from tasks.stage import StageName

INGEST = StageName("ingest", 24)
ID = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
"""Pattern of names of takes and sources."""


def frames_in(seconds: float, rate_hz: float) -> int:
    """Return the number of frames in some seconds from the start of a take or sequence, at least 2."""
    return max(2, round(seconds * rate_hz))


def one_of(names: Iterable[str]) -> AfterValidator:
    """Return a validator that accepts names in a registry and "auto"; its error lists the allowed names."""
    allowed = ("auto", *names)

    def check(name: str) -> str:
        if name not in allowed:
            raise ValueError(f"should be one of {', '.join(allowed)}")
        return name

    return AfterValidator(check)
