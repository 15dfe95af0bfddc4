"""The storage format: every table's columns, the artifact store, references, runs and datasets."""

from storage_schema.ancestry import lineage, source_files
from storage_schema.artifact_writer import ArtifactFields
from storage_schema.credits import SourceCredit
from storage_schema.datasets import Dataset, list_datasets
from storage_schema.errors import CorruptArtifact, MissingArtifact, SchemaError, StorageError, UnknownReference
from storage_schema.keys import artifact_key, canonical_json, shard_key
from storage_schema.licences import create_dataset, source_credits
from storage_schema.manifest import ArtifactRef, Manifest
from storage_schema.references import (
    Reference,
    iter_rows,
    open_table,
    parse_reference,
    referenced_credits,
    resolve,
    table_files,
)
from storage_schema.runs import (
    InputRecord,
    LatestRun,
    RunFolder,
    ShardRecord,
    in_use,
    latest_studies,
    list_runs,
    new_run,
    open_run,
    read_latest,
    record_latest,
    record_page,
)
from storage_schema.store import Store
from storage_schema.table_data import TableData
from storage_schema.tables import TABLES
from storage_schema.verification import verify

__all__ = [
    "TABLES",
    "ArtifactFields",
    "ArtifactRef",
    "CorruptArtifact",
    "Dataset",
    "InputRecord",
    "LatestRun",
    "Manifest",
    "MissingArtifact",
    "Reference",
    "RunFolder",
    "SchemaError",
    "ShardRecord",
    "SourceCredit",
    "StorageError",
    "Store",
    "TableData",
    "UnknownReference",
    "artifact_key",
    "canonical_json",
    "create_dataset",
    "in_use",
    "iter_rows",
    "latest_studies",
    "lineage",
    "list_datasets",
    "list_runs",
    "new_run",
    "open_run",
    "open_table",
    "parse_reference",
    "read_latest",
    "record_latest",
    "record_page",
    "referenced_credits",
    "resolve",
    "shard_key",
    "source_credits",
    "source_files",
    "table_files",
    "verify",
]
