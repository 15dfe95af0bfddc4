"""Publishing: a finished run of a whole study becomes a version of a dataset, if verdicts allow it and it is new."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from flows.finished_builds import read_environment
from flows.outcomes import Outcome, Run
from flows.records import ENVIRONMENT_FILE
from pasdedeux.evaluation.verdicts import verdict_words
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Dataset, canonical_json, create_dataset, source_credits
from storage_schema.ancestry import has_lineage
from storage_schema.datasets import newest_version, next_version
from storage_schema.errors import DatasetExists
from storage_schema.runs import STUDY_FILE
from tasks.files.curation import SECTION, recorded_choices
from tasks.summary import product_verdicts, summary_of


class VerdictError(Exception):
    """Verdicts prevent publishing, or are too bad; the message names them, with figures."""


@dataclass(frozen=True)
class Published:
    """The result of publishing a run: a new version, an existing one with the same content, or none.

    Args:
        name: Name of the dataset.
        words: What happened, in one line.
        dataset: The version with the results of the run; None if nothing is published.
        failures: The verdicts that prevent publishing, with figures.
    """

    name: str
    words: str
    dataset: Dataset | None = None
    failures: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        label = None if self.dataset is None else self.dataset.label
        return {"name": self.name, "dataset": label, "words": self.words, "failures": list(self.failures)}


def publish(run: Run, outcome: Outcome) -> Published | None:
    """Publish the products of a run, fresh ones included; None if its study does not publish.

    The version names exactly the artifacts of this run, whatever other runs do meanwhile, and appears in one step with
    the study, the environment and the card. Not published are runs of a part of a study, runs with a failed required
    verdict, and runs without anything new; lost artifacts of a version count as new.

    Raises:
        MissingArtifact, CorruptArtifact: An artifact of the run is no longer complete in the store.
        FullDisk: There is no room left.
    """
    settings, store = run.study.publish, run.store
    if settings is None:
        return None
    name = settings.name or run.study.name
    built = {stage.name for stage in outcome.stages}
    if built != set(run.study.parameters) or outcome.missing:
        return Published(name, f"{name} is not published: this is not the whole of the study")
    refs = [ref for stage in outcome.stages for ref in stage.artifacts]
    manifests = [store.manifest(ref) for ref in refs]
    sources = source_credits(store, *refs)
    verdicts = summary_of(manifests).verdicts
    required = product_verdicts(manifests) if settings.required is None else settings.required
    nothing = f"there is no such verdict; verdicts: {', '.join(verdicts)}"
    failures = tuple(
        f"{verdict_name}: {verdict_words(verdicts.get(verdict_name)) or nothing}"
        for verdict_name in required
        if verdict_name not in verdicts or verdicts[verdict_name].level is Level.FAIL
    )
    if failures:
        words = f"{name} is not published: {len(failures)} of {len(required)} required verdicts fail"
        return Published(name, words, failures=failures)
    choices = run.study.resolved().get(SECTION, {}).get("choices", {})
    while True:
        version = next_version(store, name)  # first, so that a version that another run publishes meanwhile is noticed
        before = newest_version(store, name)
        is_same = before is not None and _content(before.refs) == _content(refs) and before.sources == sources
        is_same = is_same and before is not None and recorded_choices(before.path) == choices
        if before is not None and is_same and has_lineage(store, before.refs, {ref.place for ref in refs}):
            return Published(name, f"{before.label} stays: nothing has changed since", before)
        note = f"run {outcome.run_id}"
        try:
            dataset = create_dataset(store, name, refs, version=version, note=note, attachments=_files(run, outcome))
        except DatasetExists:  # another run was first: compare with its version
            continue
        new = "" if before is None else f"; what is new: pasdedeux diff {before.label} {dataset.label} --store {store}"
        return Published(name, f"{dataset.label} is published{new}", dataset)


def refuse_unpublished(published: Published | None) -> None:
    """Fail if a verdict prevents publishing.

    Raises:
        VerdictError: Says which, with the figure.
    """
    if published is not None and published.failures:
        raise VerdictError("\n       ".join([published.words, *published.failures]))


def refuse_bad_verdicts(run: Run, outcome: Outcome, worst: Level) -> None:
    """Fail if a verdict on a product of a run, fresh ones included, is this bad or worse.

    Raises:
        VerdictError: Says which, with the figure.
    """
    stored = [run.store.manifest(ref) for stage in outcome.stages for ref in stage.artifacts]
    bad = {name: verdict for name, verdict in summary_of(stored).verdicts.items() if verdict.level.rank >= worst.rank}
    if bad:
        said = f"verdicts that {'warn or fail' if worst is Level.WARN else 'fail'}: {len(bad)}"
        raise VerdictError(
            "\n       ".join([said, *(f"{name}: {verdict_words(verdict)}" for name, verdict in bad.items())])
        )


def _content(refs: Sequence[ArtifactRef]) -> Counter[tuple[str, str]]:
    return Counter((ref.stage, ref.content_digest) for ref in refs)


def _files(run: Run, outcome: Outcome) -> dict[str, bytes]:
    """Return the files of a version: study, environment, card."""
    card = None if outcome.report is None else outcome.report / "card.md"
    return {
        STUDY_FILE: canonical_json(run.study.resolved()),
        ENVIRONMENT_FILE: canonical_json(read_environment(run.store, outcome.run_id)),
        **({card.name: card.read_bytes()} if card is not None and card.is_file() else {}),
    }
