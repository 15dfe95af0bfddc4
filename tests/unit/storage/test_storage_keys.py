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
        b'{"after":[],"inputs":["x"],"parameters":{"a":1},"schema_version":2,"seed":0,"stage":"chains","version":1}'
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
        ({"a": math.nan}, "not JSON compliant"),
        ({"a": [0, math.inf]}, "not JSON compliant"),
        ({"a": np.zeros(2)}, "ndarray"),
        ({"a": np.int64(2)}, "int64"),
        ({"a": {1, 2}}, "set"),
        ({"a": [{1: "b"}]}, "keys must be texts, not 1"),
    ],
)
def test_values_that_are_not_json_are_refused(value: object, words: str) -> None:
    with pytest.raises(StorageError, match=f"parameters cannot be said in JSON: .*{words}"):
        plain_json(value, "parameters")


def digest(**changes: object) -> str:
    values: dict = {"partition": "waltz", "name": "take", "facts": {"takes": ["waltz"]}, "files": {"a": "1", "b": "2"}}
    return content_digest(**(values | changes))


def test_a_content_digest_does_not_depend_on_the_order_of_files_and_facts() -> None:
    assert digest(files={"b": "2", "a": "1"}) == digest()


@pytest.mark.parametrize(
    "change", [{"files": {"a": "2", "b": "1"}}, {"facts": {"takes": ["hug"]}}, {"partition": "hug"}, {"name": "other"}]
)
def test_a_content_digest_is_over_all_that_others_may_read(change: dict) -> None:
    assert digest(**change) != digest()


def test_file_sha256_is_that_of_its_bytes(tmp_path: Path) -> None:
    data = bytes(range(256)) * 10_000
    (tmp_path / "file").write_bytes(data)
    assert file_sha256(tmp_path / "file") == hashlib.sha256(data).hexdigest()
