from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np
import pytest

from storage_schema import StorageError, artifact_key, canonical_json
from storage_schema.keys import content_digest, file_sha256, plain_json


def key(**changes: object) -> str:
    values: dict = {"stage": "chains", "version": 1, "parameters": {"a": 1}, "input_digests": ["x"], "seed": 0}
    return artifact_key(**(values | changes))


def test_canonical_json_does_not_depend_on_the_order_of_keys() -> None:
    assert (
        canonical_json({"b": [1, 2.5], "a": {"d": None, "c": "ü"}}) == '{"a":{"c":"ü","d":null},"b":[1,2.5]}'.encode()
    )


def test_a_key_is_a_sha256_and_never_changes_between_releases_of_one_schema() -> None:
    spelled = (
        b'{"after":[],"inputs":["x"],"parameters":{"a":1},"schema_version":1,"seed":0,"stage":"chains","version":1}'
    )
    assert key() == hashlib.sha256(spelled).hexdigest()


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "seeds"},
        {"version": 2},
        {"parameters": {"a": 2}},
        {"input_digests": ["y"]},
        {"input_digests": ["x", "x"]},
        {"after": ("k",)},
        {"seed": 1},
    ],
)
def test_everything_that_decides_a_result_changes_its_key(change: dict) -> None:
    assert key(**change) != key()


def test_a_key_does_not_tell_tuples_from_lists() -> None:
    assert key(parameters={"a": (1, 2)}) == key(parameters={"a": [1, 2]})


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"a": math.nan}, "parameters.a is nan"),
        ({"a": [0, math.inf]}, r"parameters.a\[1\] is inf"),
        ({"a": {1: 2}}, "parameters.a has the key 1 of type int"),
        ({"a": np.zeros(2)}, "parameters.a is of type ndarray"),
        ({"a": np.int64(2)}, "parameters.a is of type int64"),
        ({"a": {1, 2}}, "parameters.a is of type set"),
    ],
)
def test_values_that_are_not_json_are_refused_by_name(value: object, words: str) -> None:
    with pytest.raises(StorageError, match=words):
        plain_json(value, "parameters")


def test_content_digest_is_over_names_and_digests_in_any_order() -> None:
    assert content_digest({"a": "1", "b": "2"}) == content_digest({"b": "2", "a": "1"})
    assert content_digest({"a": "1", "b": "2"}) != content_digest({"a": "2", "b": "1"})
    assert content_digest({}) == hashlib.sha256(b"").hexdigest()


def test_file_sha256_is_that_of_its_bytes(tmp_path: Path) -> None:
    data = bytes(range(256)) * 10_000
    (tmp_path / "file").write_bytes(data)
    assert file_sha256(tmp_path / "file") == hashlib.sha256(data).hexdigest()
