"""The manifest of an artifact, which describes it and is the only source that readers trust."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

import orjson

from storage_schema.credits import SourceCredit
from storage_schema.errors import CorruptArtifact, NewerSchema, OlderSchema, StorageError
from storage_schema.keys import canonical_json, content_digest, shard_key
from storage_schema.version import SCHEMA_VERSION

MANIFEST_NAME = "manifest.json"
_IN_NO_DIGEST = frozenset({"timings", "created_at", "digest"})
RESERVED_NAMES = frozenset({"tmp", "runs", "datasets"})
"""Folders of a store that are not stages."""

Identity = tuple[str, str, str]

_SHARED: dict[tuple[tuple[str, str], ...], dict[str, str]] = {}
"""Package versions of manifests, which are nearly always the same, so each is kept once."""
_REFS: dict[Identity, ArtifactRef] = {}
"""References of manifests, each kept once, because many shards read the same artifacts."""
_HEX_KEY = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, order=True)
class ArtifactRef:
    """Names one artifact: its stage, its key, and the digest of its content.

    Two references are equal if stage and content are, whatever the keys: an artifact that is made again with the same
    content has another key, and must still be found as an input. The key is the artifact's place.
    """

    stage: str
    key: str = field(compare=False)
    content_digest: str

    @property
    def identity(self) -> Identity:
        """Stage, key and content, which also distinguish artifacts of the same content."""
        return self.stage, self.key, self.content_digest

    @property
    def place(self) -> tuple[str, str]:
        """Place of the artifact: its stage and its key."""
        return self.stage, self.key

    def __post_init__(self) -> None:
        """Refuse a key that is not a sha256."""
        if not _HEX_KEY.fullmatch(self.key):
            raise StorageError(f"'{self.key}' is not an artifact key: 64 hexadecimal digits are needed")


@dataclass(frozen=True)
class TableFile:
    """The artifact's part of one table: rows, bytes, sha256, and the digest of the columns it was written with."""

    rows: int
    bytes: int
    sha256: str
    schema: str


@dataclass(frozen=True)
class FileEntry:
    """An attached file: its bytes and sha256."""

    bytes: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """The description of an artifact.

    Args:
        ref: The artifact.
        partition: The step that people see: a take, a seed, a split.
        name: Name of the shard, unique in its partition.
        version: Version of the stage.
        parameters: JSON values that determined the result.
        seed: Seed of the study.
        inputs: Artifacts that were read.
        files: Outside files that were read: (file name, sha256).
        reads: Indices into `inputs` that enter the key, by their role in the shard; None if unknown.
        after: Keys of other shards that enter the key.
        tables: Parts of tables by table name; the file is `<table>.parquet`.
        attachments: Attached files by file name.
        facts: Small JSON facts for later stages; they are part of the content.
        sources: Licence and credit of new sources; the inputs have their own (`source_credits`).
        schema_version: Version of the store's layout.
        code_version: Version of the installed program.
        source_digest: Digest of the program's sources.
        package_versions: Versions of the packages that can change a result.
        timings: Seconds by name; they enter no digest.
        created_at: Time of creation, UTC; enters no digest.
        digest: The manifest's digest of itself, as read; empty in new manifests and in those of earlier releases.
    """

    ref: ArtifactRef
    partition: str
    name: str
    version: int
    parameters: dict[str, Any]
    seed: int
    inputs: tuple[ArtifactRef, ...]
    files: tuple[tuple[str, str], ...]
    tables: dict[str, TableFile]
    attachments: dict[str, FileEntry]
    facts: dict[str, Any]
    sources: tuple[SourceCredit, ...]
    schema_version: int
    code_version: str
    source_digest: str
    package_versions: dict[str, str]
    timings: dict[str, float] = field(default_factory=dict, compare=False)
    created_at: str = field(default="", compare=False)
    reads: dict[str, list[int]] | None = None
    after: tuple[str, ...] = ()
    digest: str = field(default="", compare=False)

    @property
    def data_files(self) -> dict[str, FileEntry]:
        """Every data file of the artifact by file name: parts of tables and attachments."""
        files = {f"{name}.parquet": FileEntry(part.bytes, part.sha256) for name, part in self.tables.items()}
        return files | self.attachments

    @property
    def computed_digest(self) -> str:
        """The digest of the content as this manifest describes it."""
        files = {name: entry.sha256 for name, entry in self.data_files.items()}
        return content_digest(partition=self.partition, name=self.name, facts=self.facts, files=files)

    @property
    def num_bytes(self) -> int:
        """Bytes of all data files."""
        return sum([part.bytes for part in self.tables.values()]) + sum([e.bytes for e in self.attachments.values()])

    @property
    def faults(self) -> list[str]:
        """Contradictions in it, in words, which show later changes. Absent fields are not checked."""
        faults = []
        if self.computed_digest != self.ref.content_digest:
            words = f"content digest {self.ref.content_digest[:12]} is not that of what it describes"
            faults.append(f"{words}, {self.computed_digest[:12]}")
        if self.reads is not None and (key := self._computed_key(self.reads)) != self.ref.key:
            faults.append(f"its key is not that of the parameters, inputs, version and seed that it states, {key[:12]}")
        if self.digest and (digest := _own_digest(asdict(self))) != self.digest:
            faults.append(f"its digest of itself, {self.digest[:12]}, is not that of what it says, {digest[:12]}")
        return faults

    def _computed_key(self, reads: dict[str, list[int]]) -> str:
        places = range(len(self.inputs))
        return shard_key(
            stage=self.ref.stage,
            version=self.version,
            partition=self.partition,
            name=self.name,
            parameters=self.parameters,
            reads={
                what: [self.inputs[at].content_digest if at in places else "" for at in ats]
                for what, ats in reads.items()
            },
            files=[sha256 for _, sha256 in self.files],
            after=self.after,
            seed=self.seed,
        )

    def to_json(self) -> str:
        """Return the text of the manifest file."""
        values = asdict(self)
        values["digest"] = self.digest or _own_digest(values)
        return json.dumps(values, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: bytes, *, where: str) -> Manifest:
        """Parse the bytes of a manifest file; `where` is its name in messages.

        A plan reads 100,000 manifests, so the parsed values become fields without conversion.

        Raises:
            NewerSchema: It was written by a newer version of the program.
            OlderSchema: It was written under an older schema.
            CorruptArtifact: It is not a manifest.
        """
        try:
            values = orjson.loads(text)
            refuse_newer(values["schema_version"], where)
            refuse_older(values["schema_version"], where, values.get("code_version", ""))
            return build_from_fields(cls, _parsed(values))
        except (ValueError, KeyError, TypeError, AttributeError, StorageError) as error:
            if isinstance(error, NewerSchema | OlderSchema):
                raise
            raise CorruptArtifact(f"{where} is not a manifest: {error}") from error


def _own_digest(values: dict[str, Any]) -> str:
    """Return the digest of all fields of a manifest except times."""
    said = {name: value for name, value in values.items() if name not in _IN_NO_DIGEST}
    return hashlib.sha256(canonical_json(said, "manifest")).hexdigest()


def refuse_newer(version: int, where: str) -> None:
    """Raise NewerSchema when `version` is above the version this program knows."""
    if version > SCHEMA_VERSION:
        raise NewerSchema(
            f"{where} was written by a newer program (schema version {version}, this one knows up to {SCHEMA_VERSION}"
            "); update pasdedeux or use another store"
        )


def refuse_older(version: int, where: str, release: str) -> None:
    """Raise OlderSchema when `version`, written by this release of the program, is below the version it writes now."""
    if version < SCHEMA_VERSION:
        raise OlderSchema(
            f"{where} was written under schema version {version}, this program reads {SCHEMA_VERSION}; pasdedeux "
            f"{release or 'of that time'} reads it, and a run of its study with this one computes it anew beside it"
        )


_T = TypeVar("_T")


def build_from_fields(kind: type[_T], values: dict[str, Any]) -> _T:
    """Return a dataclass with these values as its fields, in a third of its constructor's time."""
    names = vars(kind)["__dataclass_fields__"].keys()
    if values.keys() != names:
        raise KeyError(", ".join(sorted(values.keys() ^ names)))
    instance = object.__new__(kind)
    vars(instance).update(values)
    return instance


def _shared_ref(values: dict[str, Any]) -> ArtifactRef:
    """Return a reference that was read, the same object for all manifests that name the artifact."""
    identity = values["stage"], values["key"], values["content_digest"]
    ref = _REFS.get(identity)
    if ref is None or len(values) != len(identity):
        ref = build_from_fields(ArtifactRef, values)
        ref.__post_init__()
        _REFS[identity] = ref
    return ref


def _parsed(values: dict[str, Any]) -> dict[str, Any]:
    """Convert the JSON values of a manifest to their types."""
    versions = values["package_versions"]
    if "digest" not in values:  # written before manifests had this field
        values |= {"reads": None, "after": (), "digest": ""}
    values["after"] = tuple(values["after"])
    values["ref"] = _shared_ref(values["ref"])
    values["inputs"] = tuple([_shared_ref(ref) for ref in values["inputs"]])
    values["files"] = tuple([(name, digest) for name, digest in values["files"]])
    values["tables"] = {name: build_from_fields(TableFile, part) for name, part in values["tables"].items()}
    values["attachments"] = {name: build_from_fields(FileEntry, entry) for name, entry in values["attachments"].items()}
    values["sources"] = tuple([build_from_fields(SourceCredit, source) for source in values["sources"]])
    values["package_versions"] = _SHARED.setdefault(tuple(versions.items()), versions)
    return values
