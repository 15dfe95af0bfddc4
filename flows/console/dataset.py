"""`dataset`: names built artifacts as immutable versions, and transfers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from flows.console import options
from flows.console.context import answer, app, open_store
from flows.dataset_folder import read_folder, write_folder
from flows.finished_builds import portable_files
from flows.planning import PlanError
from flows.records import ENVIRONMENT_FILE, mixture, read_last_run
from pasdedeux.plain_text import counted, visible
from storage_schema import (
    ArtifactRef,
    Dataset,
    SourceCredit,
    Store,
    create_dataset,
    in_use,
    list_datasets,
    source_credits,
)
from storage_schema.bucket import RemoteStore
from storage_schema.datasets import dataset_labels, open_dataset
from storage_schema.remote import pull_dataset, push_dataset
from storage_schema.runs import STUDY_FILE

_group = typer.Typer(
    help="Name built artifacts as immutable versions, and move them.", no_args_is_help=True, rich_markup_mode=None
)
app.add_typer(_group, name="dataset")


@_group.command()
def create(
    name: Annotated[str, Argument(metavar="NAME", help="Letters, digits, '.', '_' and '-'.")],
    study: Annotated[str, Option("--study", help="Study whose last run is used.")] = "duets",
    stages: Annotated[
        list[str] | None, Option("--stage", metavar="STAGE", help="Only this stage; may be given again.")
    ] = None,
    version: Annotated[str | None, Option("--version", help="Version; the next number when not given.")] = None,
    note: Annotated[str, Option("--note", help="A line about it.")] = "",
    store: options.Store = Path("store"),
    as_json: options.Json = False,
) -> None:
    """Name the artifacts of the last run of a study as an immutable version of a dataset.

    \b
      pasdedeux dataset create salsa --study cmu_salsa
      pasdedeux dataset create salsa --study cmu_salsa --version 2.0

    Then `variants:salsa@2.0` names its rows, on the command line and in Python.
    """
    opened = open_store(store)
    refs, files = _built(opened, study, stages or [])
    today = (list(refs), source_credits(opened, *refs))
    stated = [source for ref in refs for source in opened.manifest(ref).parameters.get("sources", ())]
    if gone := [source for source in stated if SourceCredit(**source) not in today[1]]:
        raise PlanError(
            f"the report of study '{study}' says {gone[0]['name']}: {gone[0]['licence']}, which is no longer so; "
            "run the study to its end first"
        )
    versions = [version for version in list_datasets(opened, name) if version.name == name]
    same = [dataset for dataset in versions if (list(dataset.refs), dataset.sources) == today]
    if same and version is None:
        dataset, words = same[-1], "exists already with this content"
    else:
        dataset, words = create_dataset(opened, name, refs, version=version, note=note, attachments=files), "made"
    line = f"{dataset.label} {words}: {counted(len(dataset.refs), 'artifact')}, digest {dataset.digest[:12]}"
    answer(_describe(dataset), [line], as_json=as_json)


@_group.command("list")
def show_all(store: options.Store = Path("store"), as_json: options.Json = False) -> None:
    """List the datasets of a store."""
    opened = open_store(store)
    datasets = list_datasets(opened)
    labels = {dataset.label for dataset in datasets}
    lines = [
        f"{dataset.label}  {counted(len(dataset.refs), 'artifact')}  {dataset.created_at}  "
        f"{visible(dataset.note, is_line=True)}".rstrip()
        for dataset in datasets
    ]
    lines += [
        f"{label}  is of an older schema; `pasdedeux verify` names what reads it"
        for label in dataset_labels(opened)
        if label not in labels
    ]
    answer([_describe(dataset) for dataset in datasets], lines or [f"store {store}: no datasets yet"], as_json=as_json)


_LabelArgument = Annotated[str, Argument(metavar="NAME@V", help="Version of a dataset, or a name: the newest.")]
_PlaceArgument = Annotated[
    str, Argument(metavar="S3", help="s3://BUCKET/PREFIX; address and credentials from the environment.")
]


@_group.command()
def push(
    label: _LabelArgument, place: _PlaceArgument, store: options.Store = Path("store"), as_json: options.Json = False
) -> None:
    """Copy a version of a dataset, with everything it was computed from, to S3-compatible storage.

    \b
      export AWS_ENDPOINT_URL=https://s3.example.org AWS_REGION=...
      export AWS_ACCESS_KEY_ID=... AWS_SECRET_ACCESS_KEY=...
      pasdedeux dataset push salsa@3 s3://bucket/datasets
      pasdedeux dataset pull salsa s3://bucket/datasets --store elsewhere

    Only missing files are sent, the list last.  An interrupted push leaves nothing visible, and the same command
    continues it.
    """
    opened = open_store(store)
    with in_use(opened):
        dataset = open_dataset(opened, label)
        num_new = push_dataset(opened, dataset, RemoteStore(place), portable_files(dataset.path))
    _say_moved(dataset, num_new, f"is in {place}", as_json=as_json)


@_group.command()
def pull(
    label: _LabelArgument, place: _PlaceArgument, store: options.Store = Path("store"), as_json: options.Json = False
) -> None:
    """Copy a version of a dataset (default: the newest), with everything it was computed from, into a store.

    The digest of every file is checked.  `rerun`, `diff`, `export` and `run` then work as for a dataset built here.
    """
    opened = open_store(store)
    dataset, num_new = pull_dataset(RemoteStore(place), label, opened)
    _say_moved(dataset, num_new, f"is in {opened}", as_json=as_json)


@_group.command()
def write(
    label: _LabelArgument,
    out: Annotated[Path, Option("--out", metavar="FOLDER", help="Folder to write; one that has --since is updated.")],
    since: Annotated[
        str, Option("--since", metavar="NAME@V", help="Version already in the folder: write only what is new.")
    ] = "",
    withhold: Annotated[
        list[str] | None, Option("--withhold", metavar="SOURCE", help="Source to leave out; may be given again.")
    ] = None,
    store: options.Store = Path("store"),
    as_json: options.Json = False,
) -> None:
    """Write a version of a dataset as one folder that any tool opens: Parquet, a card, splits, figures, players.

    \b
      pasdedeux dataset write salsa@3 --out salsa
      pasdedeux dataset write salsa@4 --out salsa --since salsa@3

    Rejected items and withheld sources are left out.  After an interruption, repeat the command.  `rerun FOLDER`
    builds the folder again from its record.
    """
    opened = open_store(store)
    with in_use(opened):
        dataset = open_dataset(opened, label)
        written = write_folder(opened, dataset, out, since=since, withheld=withhold or ())
    files = written.manifest.files
    size = f"{counted(len(files), 'file')}, {sum(file.bytes for file in files.values()) / 1e6:,.1f} MB"
    new = f"{counted(len(written.new), 'data file')} of them new" if written.new else "no data file of them new"
    described = {"name": dataset.name, "version": dataset.version, "folder": str(out), "new": written.new}
    answer(
        {**described, "left_out": written.left_out},
        [f"{dataset.label} is in {out}: {size}, {new}", *written.left_out],
        as_json=as_json,
    )


@_group.command()
def read(
    folder: Annotated[Path, Argument(metavar="FOLDER", help="Folder that `dataset write` made.")],
    store: options.Store = Path("store"),
    as_json: options.Json = False,
) -> None:
    """Read the folder of a dataset into a store, as if it had been built there.

    The digest of every file is checked.
    """
    opened = open_store(store)
    dataset, num_new = read_folder(folder, opened)
    _say_moved(dataset, num_new, f"is in {opened}", as_json=as_json)


def _say_moved(dataset: Dataset, num_new: int, words: str, *, as_json: bool) -> None:
    line = f"{dataset.label} {words}: {counted(num_new, 'artifact')} new, digest {dataset.digest[:12]}"
    answer({**_describe(dataset), "num_new": num_new}, [line], as_json=as_json)


def _built(store: Store, study: str, stages: list[str]) -> tuple[list[ArtifactRef], dict[str, bytes]]:
    """Return the artifacts of a study's last run, with the files study, environment and dataset card."""
    last = read_last_run(store, study)
    if last is None:
        raise PlanError(f"study '{study}' was not built in the store {store} yet; run it first")
    unknown = [stage for stage in stages if stage not in last.stages]
    if unknown:
        raise PlanError(f"study '{study}' has no stage '{unknown[0]}'; it has: {', '.join(last.stages)}")
    reason = mixture(store, last, stages or list(last.stages))
    if reason:
        raise PlanError(f"study '{study}' is a mixture of runs in the store {store}: {reason}; run it to its end first")
    refs = [ref for stage in last.stages if not stages or stage in stages for ref in last.refs(stage)]
    run = store.root / "runs" / last.run_id
    files = [run / STUDY_FILE, run / ENVIRONMENT_FILE, run / "report" / "card.md"]
    return refs, {path.name: path.read_bytes() for path in files if path.is_file()}


def _describe(dataset: Dataset) -> dict[str, object]:
    return {
        "name": dataset.name,
        "version": dataset.version,
        "num_artifacts": len(dataset.refs),
        "digest": dataset.digest,
        "note": dataset.note,
        "created_at": dataset.created_at,
        "folder": str(dataset.path),
    }
