"""Keys and digests: sha256 over canonical bytes, the same on every machine and in every process."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import orjson

from storage_schema.errors import StorageError
from storage_schema.version import SCHEMA_VERSION

_ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def canonical_json(value: Any, where: str = "value") -> bytes:
    """Return the canonical bytes of a JSON value: sorted keys, no spaces, UTF-8, no NaN or infinity.

    Raises:
        StorageError: The value, `where` in the message, contains something that JSON lacks, such as NaN, an array or a
            key that is not text.
    """
    try:
        spelled = _ENCODER.encode(value).encode()
        try:
            orjson.dumps(value)  # a fast check that refuses the same keys, and more: a plan needs 100,000
        except TypeError:
            _check_keys(value)
    except (TypeError, ValueError) as error:
        raise StorageError(f"{where} cannot be said in JSON: {error}") from None
    return spelled


def _check_keys(value: Any) -> None:
    """Refuse keys that are not text; the encoder would convert them, so that 1 and "1" were the same."""
    if isinstance(value, dict):
        if other := [key for key in value if not isinstance(key, str)]:
            raise TypeError(f"keys must be texts, not {other[0]!r}")
        value = list(value.values())
    for part in value if isinstance(value, list | tuple) else ():
        _check_keys(part)


def plain_json(value: Any, where: str = "value") -> Any:
    """Return a deep copy of a JSON value as it is read from a file: mappings as dicts, sequences as lists."""
    return json.loads(canonical_json(value, where))


def json_file(values: Mapping[str, Any]) -> bytes:
    """Return values as the bytes of a readable JSON file."""
    return (json.dumps(values, indent=1, ensure_ascii=False) + "\n").encode()


def artifact_key(
    *,
    stage: str,
    version: int,
    parameters: Mapping[str, Any],
    input_digests: Sequence[str],
    after: Sequence[str] = (),
    seed: int,
) -> str:
    """Return the sha256 over everything that determines an artifact's content; parameters are JSON values.

    Paths, times, hosts, study names and worker counts are never part of it.  Inputs are content digests of artifacts
    and sha256 of outside files, in the order they are read; `after` are keys of other shards of the same plan.
    """
    described = {
        "stage": stage,
        "version": version,
        "parameters": dict(parameters),
        "inputs": list(input_digests),
        "after": list(after),
        "seed": seed,
        "schema_version": SCHEMA_VERSION,
    }
    return hashlib.sha256(canonical_json(described, "key")).hexdigest()


def shard_key(
    *,
    partition: str,
    name: str,
    parameters: Mapping[str, Any],
    reads: Mapping[str, Sequence[str]],
    files: Sequence[str],
    **described: Any,
) -> str:
    """Return the key of a shard's artifact.

    Args:
        partition: The step that people see.
        name: Name of the shard in its partition.
        parameters: JSON values that determine the result.
        reads: Content digests of the artifacts that it reads, by their role.
        files: The sha256 of the outside files that it reads.
        described: Stage, version, `after` and seed, as for `artifact_key`.
    """
    digests = [f"{what}:{digest}" for what in sorted(reads) for digest in reads[what]]
    identity = {"partition": partition, "name": name, "told": parameters}
    return artifact_key(parameters=identity, input_digests=[*digests, *files], **described)


def content_digest(*, partition: str, name: str, facts: Mapping[str, Any], files: Mapping[str, str]) -> str:
    """Return the digest of everything that others may read of an artifact: its place, its facts, its data files.

    Two artifacts of one stage with the same digest are the same to everything downstream, whatever their keys:
    times, versions, parameters and licences are not in it.  Facts are JSON values, `files` sha256 by file name.
    """
    described = {"partition": partition, "name": name, "facts": dict(facts), "files": dict(files)}
    return hashlib.sha256(canonical_json(described, "content")).hexdigest()


def file_sha256(path: str | Path) -> str:
    """Return the sha256 of a file's bytes; OSError if it cannot be read."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
