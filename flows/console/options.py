"""Options and arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

Study = Annotated[str, Argument(help="Name of a study that ships, or path of a .toml file.")]
Settings = Annotated[
    list[str] | None, Option("--set", metavar="A.B=C", help="Set one key of the study; may be given again.")
]
Reference = Annotated[
    str, Argument(metavar="REF", help="table@key, table:study/partition or table:dataset@version, with #row.")
]
Store = Annotated[Path, Option("--store", metavar="DIR", help="Folder of the store, or s3://BUCKET/PREFIX.")]
Workers = Annotated[
    int | None,
    Option("--workers", min=0, help="Local worker processes; default: one per core; 0: compute in this process."),
]
Scheduler = Annotated[
    str | None, Option("--scheduler", metavar="ADDRESS", help="Use this Dask cluster, for example tcp://host:8786.")
]
Cluster = Annotated[
    Path | None,
    Option(
        "--cluster", metavar="PROFILE", help="Start the Dask cluster that this file describes; it ends with the run."
    ),
]
Oversubscribe = Annotated[bool, Option("--oversubscribe", help="Allow more workers than usable cores.")]
Json = Annotated[bool, Option("--json", help="Answer as JSON on standard output.")]
Only = Annotated[list[str] | None, Option("--only", metavar="STAGE", help="Only these stages.")]
From = Annotated[str | None, Option("--from", metavar="STAGE", help="This stage and all that depend on it.")]
Until = Annotated[str | None, Option("--until", metavar="STAGE", help="This stage and all that it needs.")]
Force = Annotated[
    list[str] | None,
    Option("--force", metavar="STAGE", help="Compute this stage again, in place; datasets keep their artifacts."),
]
FailOn = Annotated[Literal["warn", "fail"] | None, Option(help="Exit code 1 if a verdict is this bad.")]
OutFolder = Annotated[Path, Option("--out", metavar="DIR", help="Folder for the files; made when missing.")]
