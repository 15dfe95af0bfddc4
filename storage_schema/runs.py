"""Records of runs: a folder per run, and for each study the artifacts of its last run.

`runs/<run_id>/` holds the resolved study, the plan, the environment and the report. `runs/latest/<study>.json` has the
shards of each stage with their parameters and inputs, to explain why something is stale. `runs/latest/<study>.html` is
a copy of the study's last report under a permanent path.
"""

from __future__ import annotations

import fcntl
import re
import secrets
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import orjson

from storage_schema.durable import locked_file, make_folder, write_errors
from storage_schema.errors import CorruptArtifact, MissingArtifact, OlderSchema, StorageError
from storage_schema.keys import json_file, plain_json
from storage_schema.manifest import ArtifactRef, Manifest, build_from_fields, refuse_newer, refuse_older
from storage_schema.staging import replace_file
from storage_schema.store import Store
from storage_schema.version import SCHEMA_VERSION

STUDY_FILE = "study.json"
"""File of a run's folder, and of a dataset: the resolved study."""
REPORT_PAGE = "report.html"
"""Page of a report, in the folder of its run."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True)
class InputRecord:
    """An artifact that a shard read: its place in its stage, and its content."""

    stage: str
    partition: str
    name: str
    content_digest: str


@dataclass(frozen=True)
class ShardRecord:
    """A shard of the last run of a study: its artifact and everything that determined it."""

    partition: str
    name: str
    key: str
    content_digest: str
    version: int
    seed: int
    parameters: dict[str, Any]
    inputs: tuple[InputRecord, ...] = ()
    files: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(cls, manifest: Manifest, store: Store) -> ShardRecord:
        """Return the record of an artifact; its inputs are named by their own manifests (else MissingArtifact)."""
        inputs = [store.manifest(ref) for ref in manifest.inputs]
        return cls(
            partition=manifest.partition,
            name=manifest.name,
            key=manifest.ref.key,
            content_digest=manifest.ref.content_digest,
            version=manifest.version,
            seed=manifest.seed,
            parameters=manifest.parameters,
            inputs=tuple(InputRecord(m.ref.stage, m.partition, m.name, m.ref.content_digest) for m in inputs),
            files=manifest.files,
        )


@dataclass(frozen=True)
class LatestRun:
    """The last run of a study: for each stage its shards, in the order of the plan."""

    study: str
    run_id: str
    stages: dict[str, tuple[ShardRecord, ...]] = field(default_factory=dict)

    def refs(self, stage: str | None = None, partition: str | None = None) -> list[ArtifactRef]:
        """Return the artifacts of a stage or of all, of one partition or of all; none when the stage has not run."""
        return [
            ArtifactRef(name, shard.key, shard.content_digest)
            for name in (self.stages if stage is None else [stage])
            for shard in self.stages.get(name, ())
            if partition in (None, shard.partition)
        ]


@dataclass(frozen=True)
class RunFolder:
    """The folder of one run."""

    run_id: str
    path: Path

    def write(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file to the folder in one step; FullDisk if there is no room left."""
        self.write_bytes(name, json_file(plain_json(dict(content), name)))

    def write_bytes(self, name: str, data: bytes) -> None:
        """Write a file to the folder in one step; FullDisk if there is no room left."""
        with write_errors(self.path):
            replace_file(self.path / name, data, staging_root=self.path.parents[1] / "tmp")

    def read(self, name: str) -> bytes:
        """Return the bytes of a file of the folder; MissingArtifact without it."""
        try:
            return (self.path / name).read_bytes()
        except FileNotFoundError:
            raise MissingArtifact(f"run {self.run_id} has no file '{name}'") from None


def new_run(store: Store, study: str) -> RunFolder:
    """Create the folder of a new run; its name holds the UTC time to the microsecond, so a study's runs sort by age."""
    now = datetime.now(UTC)
    run_id = f"{now:%Y%m%dT%H%M%S}-{_checked(study)}-{now.microsecond:05x}{secrets.token_hex(1)}"
    store.prepare()
    with write_errors(store.root):
        make_folder(store.root / "runs" / run_id)
    return RunFolder(run_id, store.root / "runs" / run_id)


def open_run(store: Store, run_id: str) -> RunFolder:
    """Return the folder of a run; MissingArtifact without it."""
    path = store.root / "runs" / _checked(run_id)
    if run_id == "latest" or not path.is_dir():
        raise MissingArtifact(f"there is no run '{run_id}' in the store {store}")
    return RunFolder(run_id, path)


def list_runs(store: Store) -> list[RunFolder]:
    """Return the folders of all runs, oldest first."""
    folder = store.root / "runs"
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    return [RunFolder(path.name, path) for path in paths if path.is_dir() and path.name != "latest"]


def latest_studies(store: Store) -> list[str]:
    """Return the names of the studies that have run in this store."""
    return sorted(
        path.stem for path in (store.root / "runs" / "latest").glob("*.json") if not path.name.startswith(".")
    )


def read_latest(store: Store, study: str) -> LatestRun | None:
    """Return the last run of a study; None if it has not run in this store.

    Raises:
        CorruptArtifact: The record cannot be read.
        NewerSchema: It was written by a newer program.
        OlderSchema: It was written under an older schema, and has another form.
    """
    path = _latest_path(store, study)
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        return None
    version = SCHEMA_VERSION
    try:
        values = orjson.loads(text)
        version = int(values["schema_version"])
        refuse_newer(version, str(path))
        stages = {stage: tuple(_shard(shard) for shard in shards) for stage, shards in values["stages"].items()}
        return LatestRun(study=values["study"], run_id=values["run_id"], stages=stages)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        refuse_older(version, str(path), "")
        raise CorruptArtifact(f"{path} cannot be read: {error!r}; a run of its study writes it anew") from error


def record_latest(store: Store, study: str, run_id: str, stages: Mapping[str, Sequence[ShardRecord]]) -> LatestRun:
    """Record the artifacts of these stages in a run; records of other stages stay.

    Readers see the old record or the new one; concurrent runs record one after the other.
    """
    path = _latest_path(store, study)
    store.prepare()
    with write_errors(store.root), locked_file(path, fcntl.LOCK_EX):
        before = None
        with suppress(CorruptArtifact, OlderSchema):  # such a record is replaced
            before = read_latest(store, study)
        merged = {**(before.stages if before else {}), **{stage: tuple(shards) for stage, shards in stages.items()}}
        latest = LatestRun(study=study, run_id=run_id, stages=merged)
        values = plain_json({"schema_version": SCHEMA_VERSION, **asdict(latest)}, "record")
        replace_file(path, json_file(values), staging_root=store.staging_root)
    return latest


def record_page(store: Store, study: str, page: bytes) -> Path:
    """Keep the page of a study's last report under a path that stays, which is returned."""
    path = _latest_path(store, study, "html")
    with write_errors(store.root):
        if not path.is_file() or path.read_bytes() != page:
            replace_file(path, page, staging_root=store.staging_root)
    return path


def in_use(store: Store, *, alone: bool = False) -> AbstractContextManager[None]:
    """Protect the store from garbage collection in a block (`Store.in_use`)."""
    return store.in_use(alone=alone)


def _latest_path(store: Store, study: str, suffix: str = "json") -> Path:
    return store.root / "runs" / "latest" / f"{_checked(study)}.{suffix}"


def _shard(values: dict[str, Any]) -> ShardRecord:
    values["inputs"] = tuple([build_from_fields(InputRecord, record) for record in values["inputs"]])
    values["files"] = tuple([(name, digest) for name, digest in values["files"]])
    return build_from_fields(ShardRecord, values)


def _checked(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise StorageError(f"'{name}' cannot name a study or a run: letters, digits, '.', '_' and '-' are allowed")
    return name
