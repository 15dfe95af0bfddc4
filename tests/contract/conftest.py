"""What the stages on sampled pairs read, for the tests of each of them."""

from __future__ import annotations

import pytest

from storage_schema import Manifest, Store
from tests.builders.sampling_store import put_sampling_inputs


@pytest.fixture
def inputs(store: Store) -> tuple[Store, dict[str, list[Manifest]]]:
    """Return a store with two takes to learn from, one held out and one of a single person, annotations and views."""
    return store, put_sampling_inputs(store)
