"""What the stages on sampled pairs read, for the tests of each of them."""

from __future__ import annotations

import pytest

from storage_schema import Manifest, Store
from tests.builders.sampling_store import put_annotations, put_take


@pytest.fixture
def inputs(store: Store) -> tuple[Store, dict[str, list[Manifest]]]:
    """Return a store with two takes to learn from, one held out and one of a single person, annotations and views."""
    poses = [put_take(store, "one"), put_take(store, "two"), put_take(store, "kept_back", is_held_out=True)]
    poses.append(put_take(store, "single", num_persons=1))
    annotations, views = put_annotations(store, "one")
    hidden_annotations, hidden_views = put_annotations(store, "kept_back", is_held_out=True)
    return store, {"poses": poses, "annotations": [annotations, hidden_annotations], "views": [views, hidden_views]}
