"""Viewers that are stopped when their test has ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from flows.viewing.shelf import Shelf
    from flows.viewing.viewer import Viewer


@pytest.fixture
def open_viewer() -> Iterator[Callable[..., Viewer]]:
    """Return what opens a viewer of a shelf."""
    from flows.viewing.viewer import Viewer

    with ExitStack() as stack:

        def opened(shelf: Shelf, **options: object) -> Viewer:
            viewer = Viewer(shelf, **options)  # type: ignore[arg-type]
            stack.callback(viewer.stop)
            return viewer

        yield opened
