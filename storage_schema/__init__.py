"""What lies on disk: every table's columns, the artifact store, references, runs and datasets."""

from storage_schema.columns import Column, Table
from storage_schema.credits import SourceCredit, merge_credits
from storage_schema.errors import (
    CorruptArtifact,
    DatasetExists,
    FullDisk,
    MissingArtifact,
    NewerSchema,
    SchemaError,
    StorageError,
    UnknownReference,
)
from storage_schema.keys import artifact_key, canonical_json, content_digest, file_sha256
from storage_schema.manifest import ArtifactRef, FileEntry, Manifest, TableFile
from storage_schema.store import ArtifactWriter, Store
from storage_schema.table_data import TableData
from storage_schema.tables import TABLES
from storage_schema.version import SCHEMA_VERSION

__all__ = [
    "SCHEMA_VERSION",
    "TABLES",
    "ArtifactRef",
    "ArtifactWriter",
    "Column",
    "CorruptArtifact",
    "DatasetExists",
    "FileEntry",
    "FullDisk",
    "Manifest",
    "MissingArtifact",
    "NewerSchema",
    "SchemaError",
    "SourceCredit",
    "StorageError",
    "Store",
    "Table",
    "TableData",
    "TableFile",
    "UnknownReference",
    "artifact_key",
    "canonical_json",
    "content_digest",
    "file_sha256",
    "merge_credits",
]
