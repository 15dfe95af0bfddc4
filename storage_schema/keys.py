"""Keys and digests: sha256 over canonical bytes, the same on every machine and in every process."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from storage_schema.errors import StorageError
from storage_schema.version import SCHEMA_VERSION

_BLOCK_BYTES = 1 << 20
_ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def canonical_json(value: Any, where: str = "value") -> bytes:
    """Return the one spelling of a JSON value: sorted keys, no spaces, UTF-8, no NaN or infinity.

    `where` names the value in messages.

    Raises:
        StorageError: The value holds something that JSON has no spelling for, such as NaN or an array.
    """
    try:
        return _ENCODER.encode(value).encode()
    except (TypeError, ValueError) as error:
        raise StorageError(f"{where} cannot be said in JSON: {error}") from None


def plain_json(value: Any, where: str = "value") -> Any:
    """Return a JSON value as it reads back from a file: mappings as dicts, sequences as lists, a copy all through."""
    return json.loads(canonical_json(value, where))


def artifact_key(
    *,
    stage: str,
    version: int,
    parameters: Mapping[str, Any],
    input_digests: Sequence[str],
    after: Sequence[str] = (),
    seed: int,
) -> str:
    """Return the sha256 that names an artifact by everything that decides its content.

    Paths, times, hosts, study names and worker counts are never part of it.

    Inputs are content digests of artifacts and sha256 of outside files, in the order they are read; `after` are keys of
    other shards of the same plan.

    Raises:
        StorageError: The parameters are not JSON values.
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


def content_digest(*, partition: str, name: str, facts: Mapping[str, Any], files: Mapping[str, str]) -> str:
    """Return the digest of all that others may read of an artifact: where it stands, its facts, its data files.

    Two artifacts of one stage with the same digest are the same to everything downstream, whatever their keys:
    times, versions, parameters and licences are not in it.

    Data files are given as their sha256 by file name.

    Raises:
        StorageError: The facts are not JSON values.
    """
    described = {"partition": partition, "name": name, "facts": dict(facts), "files": dict(files)}
    return hashlib.sha256(canonical_json(described, "content")).hexdigest()


def file_sha256(path: str | Path) -> str:
    """Return the sha256 of a file's bytes, read in blocks.

    Raises:
        OSError: The file cannot be read.
    """
    digest = hashlib.sha256()
    with Path(path).open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()
