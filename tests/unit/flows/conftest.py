"""The toy study, built once for the tests of flows."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from storage_schema import Store


@pytest.fixture(scope="session")
def _toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the store in which the toy study is built."""
    from tests.builders.toy_runs import run_toys, write_study

    folder = tmp_path_factory.mktemp("toys")
    run_toys(write_study(folder), folder / "store")
    return folder / "store"


@pytest.fixture
def toy_store(_toys: Path, tmp_path: Path) -> Store:
    """Return a copy of the store in which the toy study is built: `store` in the folder of the test."""
    from storage_schema import Store

    return Store(shutil.copytree(_toys, tmp_path / "store"))
