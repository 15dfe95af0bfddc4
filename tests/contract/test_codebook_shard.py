"""The codebook of the published search as a shard of stage `projections`, and the topic that compares with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from storage_schema import Store
from tasks import projections
from tasks.evaluation import STAGE
from tasks.evaluation.experiments.unseen_views import PARALLEL_VIEWS
from tasks.stage import StageInputs
from tests.builders.walking_takes import put_take


def test_a_codebook_numbers_the_projections_of_all_takes_and_serves_the_held_out_one(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    takes = [put_take(store, name) for name in "ab"]
    held_out = put_take(store, "c", is_held_out=True)
    parameters = projections.ProjectionsParameters(num_clusters=20)
    shards = projections.plan(StageInputs({"poses": [*takes, held_out]}, seed=0), parameters)
    assert [shard.name for shard in shards][-1] == "codebook"
    *parts, book = [store.manifest(projections.run_shard(shard, store)) for shard in shards]
    members = np.concatenate([np.asarray(one) for one in store.read(book.ref, "codebook")["members"]])
    assert sorted(members.tolist()) == list(range(30 * sum(part.facts["num_poses"] for part in parts)))
    assert book.facts["takes"] == ["a", "b"]
    settings = STAGE.parameters(unseen_views_deg=(0.0,))
    for books in ([book], []):
        tables = {"poses": [*takes, held_out], "projections": parts[::-1], "codebook": books}
        shard = PARALLEL_VIEWS.plan(StageInputs(tables, seed=0), settings)[0]
        assert shard.refs("codebook") == tuple(one.ref for one in books)
        methods = {score.method for score in PARALLEL_VIEWS.run(shard, store).scores}
        assert ("as_published" in methods) == bool(books)


def test_without_a_number_of_clusters_there_is_no_codebook(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    shards = projections.plan(
        StageInputs({"poses": [put_take(store, "a")]}, seed=0), projections.ProjectionsParameters()
    )
    assert [shard.name for shard in shards] == ["take-a-a"]
