"""Fixtures of toys that wait at gates, and of stores in buckets."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.builders.s3_server import S3Server, s3_server
from tests.builders.toy_runs import Gates


@pytest.fixture
def gates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Gates:
    """Return gates of the toys that this process and all that it starts compute."""
    gates = Gates(tmp_path)
    monkeypatch.setenv("TOY_FOLDER", str(gates.folder))
    return gates


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[S3Server]:
    """Start a server of buckets; stores in them have their mirrors in a cache of the test."""
    monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / "cache"))
    with s3_server(monkeypatch) as server:
        yield server


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], None]:
    """Go to another machine: nothing is here of what was there."""
    number = itertools.count()
    return lambda: monkeypatch.setenv("PASDEDEUX_CACHE", str(tmp_path / f"cache-{next(number)}"))
