"""Current licences and credits of the sources of artifacts, and datasets made with them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime

from storage_schema.ancestry import find_manifest
from storage_schema.credits import SourceCredit, merge_credits
from storage_schema.datasets import Dataset, add_dataset, check_names, dataset_digest, datasets_with, next_version
from storage_schema.errors import DatasetExists, MissingArtifact, OlderSchema, StorageError
from storage_schema.manifest import ArtifactRef, Manifest
from storage_schema.runs import LatestRun, latest_studies, read_latest
from storage_schema.store import Store


def source_credits(store: Store, *refs: ArtifactRef) -> tuple[SourceCredit, ...]:
    """Return the current licence and credit of every source of these artifacts.

    A study may later state another licence for the same bytes, and artifacts made from them are not computed again.
    They get the credits stated by the last runs that have them on record, by those with these very artifacts if there
    are some. If no run has them, their sources get the credits stated by the last runs of all studies, else those of
    the newest dataset that contained them, else their own.

    Raises:
        MissingArtifact: An ancestor is no longer in the store, so that its licence is unknown.
    """
    runs = [{ref: ref for ref in last_run.refs()} for last_run in _last_runs(store)]
    mine = [run for run in runs if any(ref in run and run[ref].place == ref.place for ref in refs)]
    named = {ref.place for ref in refs}
    waiting, seen = list(refs), set(named)
    stated: list[Iterable[SourceCredit]] = []
    while waiting:
        ref = waiting.pop()
        # The same content in these runs may come from other sources than the earlier artifact.
        sources = _there(store, ref, mine)
        sources = [manifest for manifest in sources if manifest.ref.place in named] or sources
        every: Sequence[Manifest | None] = sources or [find_manifest(store, ref)]
        for manifest in every:
            if manifest is None:
                raise MissingArtifact(
                    f"artifact {ref.stage}@{ref.key[:12]}, which this comes from, is no longer whole in the store "
                    f"{store}, so its licence is not known; run the study again"
                )
            if sources or not manifest.sources:
                stated.append(manifest.sources)
            else:
                others = _there(store, ref, runs)
                stated += [other.sources for other in others] or [_as_it_came(store, manifest)]
            waiting += [read for read in manifest.inputs if read.place not in seen]
            seen.update(read.place for read in manifest.inputs)
    return merge_credits(*stated)


def _there(store: Store, ref: ArtifactRef, runs: Iterable[Mapping[ArtifactRef, ArtifactRef]]) -> list[Manifest]:
    """Return the artifacts of these runs with this content that are in the store."""
    manifests = (find_manifest(store, run[ref]) for run in runs if ref in run)
    return [manifest for manifest in manifests if manifest is not None]


def _as_it_came(store: Store, source: Manifest) -> tuple[SourceCredit, ...]:
    """Return the credits of a source from the newest dataset that needs it, else its own.

    If the dataset has other names of sources, return all its credits, because the source may be among them.
    """
    datasets = sorted(datasets_with(store, source.ref), key=lambda dataset: dataset.created_at)
    if not datasets:
        return source.sources
    names = {credit.name for credit in source.sources}
    stated = tuple(credit for credit in datasets[-1].sources if credit.name in names)
    return stated if names == {credit.name for credit in stated} else datasets[-1].sources


def _last_runs(store: Store) -> Iterator[LatestRun]:
    for study in latest_studies(store):
        with suppress(OlderSchema):  # artifacts of an older schema have other content
            if (latest := read_latest(store, study)) is not None:
                yield latest


def create_dataset(
    store: Store,
    name: str,
    refs: Sequence[ArtifactRef],
    *,
    version: str | None = None,
    note: str = "",
    attachments: Mapping[str, bytes] | None = None,
) -> Dataset:
    """Create a dataset: name a list of artifacts by a name and a version that never change.

    Without a version it gets the next free number; `attachments` are files beside the list, such as a dataset card.

    Raises:
        DatasetExists: This name and version are taken.
        MissingArtifact: An artifact or one of its ancestors is not in the store.
        StorageError: The list is empty.
        BadName: A name is not allowed.
        FullDisk: There is no room left.
    """
    check_names(name, version or "1", *(attachments or {}))
    if not refs:
        raise StorageError(f"dataset '{name}': a dataset needs at least one artifact")
    sources = source_credits(store, *refs)
    digest = dataset_digest(refs, sources)
    for ref in refs:
        store.manifest(ref)
    store.prepare()
    while True:
        chosen = version or next_version(store, name)
        path = store.root / "datasets" / f"{name}@{chosen}"
        created_at = datetime.now(UTC).isoformat(timespec="milliseconds")
        dataset = Dataset(name, chosen, tuple(refs), sources, digest, note, created_at, path)
        if add_dataset(store, dataset, attachments or {}):
            return dataset
        if version is not None:
            raise DatasetExists(f"dataset {dataset.label} was already made and never changes; name another version")
