"""What lies on disk: every table's columns, the artifact store, references, runs and datasets."""

from storage_schema.ancestry import LineageStep, SourceFileUse, lineage, source_files
from storage_schema.artifact_writer import ArtifactWriter
from storage_schema.columns import Column, Table
from storage_schema.credits import SourceCredit, merge_credits
from storage_schema.datasets import Dataset, create_dataset, list_datasets, open_dataset
from storage_schema.errors import (
    BadName,
    CorruptArtifact,
    DatasetExists,
    FullDisk,
    MissingArtifact,
    NewerSchema,
    NotAStore,
    SchemaError,
    StorageError,
    UnknownReference,
)
from storage_schema.keys import artifact_key, canonical_json, content_digest, file_sha256
from storage_schema.manifest import ArtifactRef, FileEntry, Manifest, TableFile
from storage_schema.references import (
    Reference,
    default_store,
    iter_rows,
    open_table,
    parse_reference,
    resolve,
    table_files,
)
from storage_schema.runs import (
    InputRecord,
    LatestRun,
    RunFolder,
    ShardRecord,
    latest_studies,
    list_runs,
    new_run,
    open_run,
    read_latest,
    record_latest,
)
from storage_schema.store import ArtifactFields, Store
from storage_schema.table_data import TableData
from storage_schema.tables import TABLES
from storage_schema.verification import Problem, ProblemKind, Verification, verify
from storage_schema.version import SCHEMA_VERSION

__all__ = [
    "SCHEMA_VERSION",
    "TABLES",
    "ArtifactFields",
    "ArtifactRef",
    "ArtifactWriter",
    "BadName",
    "Column",
    "CorruptArtifact",
    "Dataset",
    "DatasetExists",
    "FileEntry",
    "FullDisk",
    "InputRecord",
    "LatestRun",
    "LineageStep",
    "Manifest",
    "MissingArtifact",
    "NewerSchema",
    "NotAStore",
    "Problem",
    "ProblemKind",
    "Reference",
    "RunFolder",
    "SchemaError",
    "ShardRecord",
    "SourceCredit",
    "SourceFileUse",
    "StorageError",
    "Store",
    "Table",
    "TableData",
    "TableFile",
    "UnknownReference",
    "Verification",
    "artifact_key",
    "canonical_json",
    "content_digest",
    "create_dataset",
    "default_store",
    "file_sha256",
    "iter_rows",
    "latest_studies",
    "lineage",
    "list_datasets",
    "list_runs",
    "merge_credits",
    "new_run",
    "open_dataset",
    "open_run",
    "open_table",
    "parse_reference",
    "read_latest",
    "record_latest",
    "resolve",
    "source_files",
    "table_files",
    "verify",
]
