"""What decides a result: the key of a shard, and the random numbers that it draws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from storage_schema import ArtifactRef
from tasks.stage import Parameters, Shard, SourceFile
from tasks.stage.streams import stream


class Named(Parameters):
    name: str = "given"


def test_all_that_decides_a_shard_is_in_its_key_and_where_things_lie_is_not() -> None:
    digest, changed = "1" * 64, "2" * 64
    read = ArtifactRef("ingest", digest, digest)
    shard = Shard(
        *("grow", 1, "t0", "a", Named()), {"log": (read,)}, (SourceFile("here", digest),), after=("k",), seed=1
    )
    deciding: list[dict[str, Any]] = [
        *({"stage": "bend"}, {"version": 2}, {"partition": "t1"}, {"name": "b"}, {"seed": 2}, {"after": ("l",)}),
        {"parameters": Named(name="b")},
        {"inputs": {"log": (replace(read, content_digest=changed),)}},
        {"inputs": {"other": (read,)}},
        {"files": (SourceFile("here", changed),)},
    ]
    keys = {replace(shard, **change).key for change in deciding}
    assert len(keys | {shard.key}) == len(deciding) + 1
    assert replace(shard, files=(SourceFile("there", digest),)).key == shard.key
    assert replace(shard, inputs={"log": (replace(read, key=changed),)}).key == shard.key, "other work, the same bytes"


def test_streams_of_other_seeds_and_labels_are_other_streams_and_the_same_ones_repeat() -> None:
    labels = [
        (1,),
        (2,),
        (1, "a"),
        (1, "b"),
        (2, "a"),
        (1, "a", 0),
        (1, "a", 1),
        (1, "a", "b"),
        (1, "ab"),
        (1, "b", "a"),
    ]
    drawn = [stream(*label).random(4) for label in labels]
    assert len({tuple(values) for values in drawn}) == len(labels)
    for values, label in zip(drawn, labels, strict=True):
        np.testing.assert_array_equal(stream(*label).random(4), values)
    assert stream(3, "chains", 1).integers(10**9) == 546688386, "in every process and on every machine"
