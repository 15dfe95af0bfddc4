"""Several couples in one image: each is a pair of its own, as if it had an image to itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from storage_schema import Manifest, Store
from tasks import lifting, views
from tasks.lifting import LiftingParameters
from tasks.rows.annotated_pairs import PLACE_COLUMNS, PairPlace, gather, gather_tracks, place_of
from tasks.stage import StageInputs
from tasks.views import ViewsParameters
from tests.builders.sampling_store import put, with_seeds


def together(store: Store, manifest: Manifest, table: str, inputs: tuple[Manifest, ...] = ()) -> Manifest:
    """Commit a table again with the people of every second image in the image before it, as people 2 and 3."""
    read = store.read(manifest.ref, table)
    columns = {name: list(read[name]) for name in read.column_names}
    number = np.array([int(name[-5:]) for name in columns["sequence_id"]])
    for name, of_row in {
        "sequence_id": [f"ball/view{at - at % 2:05d}" for at in number.tolist()],
        **{name: np.asarray(columns[name]) + 2 * (number % 2) for name in ("person_id", "partner_id")},
    }.items():
        columns[name] = list(of_row)
    order = np.lexsort([columns["person_id"], columns["frame"], columns["sequence_id"]])
    columns = {name: [values[row] for row in order] for name, values in columns.items()}
    stage = "ingest" if table == "annotations" else table
    return put(store, stage, "ball", {table: columns}, {**manifest.facts, "num_persons": 4}, inputs)


def test_couples_in_one_image_are_sampled_and_lifted_as_if_each_had_its_own(inputs: Any) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=20)
    annotations, seen = tables["annotations"][0], tables["views"][0]
    ball = together(store, annotations, "annotations")
    ball_views = together(store, seen, "views", (ball,))
    apart = gather(store, annotations=[annotations.ref], views=[seen.ref], num_hypotheses=1)
    shared = gather(store, annotations=[ball.ref], views=[ball_views.ref], num_hypotheses=1)
    assert len({(place.sequence_id, place.frame) for place in shared.places}) < len(shared.places)
    assert {(place.person_id, place.partner_id) for place in shared.places} == {(0, 1), (2, 3)}
    np.testing.assert_array_equal(shared.gathered.pairs.annotation_index, apart.gathered.pairs.annotation_index)
    np.testing.assert_array_equal(shared.gathered.pairs.points_m, apart.gathered.pairs.points_m)
    np.testing.assert_array_equal(gather_tracks(shared), gather_tracks(apart))

    lifted = {}
    for name, its_annotations, its_views in (("apart", annotations, seen), ("shared", ball, ball_views)):
        stage_inputs = StageInputs({**given.manifests, "annotations": [its_annotations], "views": [its_views]}, seed=1)
        (shard,) = lifting.plan(stage_inputs, LiftingParameters(max_frames=6))
        table = store.read(store.manifest(lifting.run_shard(shard, store)).ref, "lifted_pairs")
        rows = np.flatnonzero(np.asarray(table["method"]) == "fitted")
        lifted[name] = np.asarray(table["pair17_m"])[rows]
    np.testing.assert_array_equal(lifted["shared"], lifted["apart"])


def test_every_couple_of_an_image_gets_views(inputs: Any) -> None:
    store, tables = inputs
    ball = together(store, tables["annotations"][0], "annotations")
    (shard,) = views.plan(StageInputs({"annotations": [ball]}, seed=1), ViewsParameters())
    table = store.read(views.run_shard(shard, store), "views")
    places = {place_of(table, row) for row in range(table.num_rows)}
    assert {PairPlace("ball/view00000", 0, 0, 1), PairPlace("ball/view00000", 0, 2, 3)} <= places
    keys = list(zip(*(table[name] for name in (*PLACE_COLUMNS, "hypothesis")), strict=True))
    assert keys == sorted(keys)
