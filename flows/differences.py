"""Differences of two runs or versions of datasets: parameters, environment, source files, artifacts, scores."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from flows.finished_builds import ArtifactPlace, Recorded, environment_changes
from flows.staleness import changed_leaves
from pasdedeux.plain_text import counted
from storage_schema import Manifest, Store
from storage_schema.comparison import Difference, compare_artifacts


class ScoreName(NamedTuple):
    """Identifies a figure of the table `scores`; `at` is None unless it is a point of a curve."""

    topic: str
    metric: str
    method: str
    split: str
    item: str
    at: float | None


Figures = Mapping[ScoreName, tuple[float | None, str]]
"""Value and unit of figures; None stands for NaN, which JSON lacks."""


def _figures_of(store: Store, manifests: Iterable[Manifest]) -> Figures:
    """Return the scores among these artifacts."""
    figures: dict[ScoreName, tuple[float | None, str]] = {}
    for manifest in manifests:
        if "scores" in manifest.tables:
            table = store.read(manifest.ref, "scores", columns=[*ScoreName._fields, "value", "unit"])
            columns = [[_plain(value) for value in table[name]] for name in ScoreName._fields]
            for *name, value, unit in zip(*columns, table["value"], table["unit"], strict=True):
                figures[ScoreName(*name)] = (_plain(value), unit)
    return figures


def _plain(value: Any) -> Any:
    return value if isinstance(value, str) else float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class ScoreChange:
    """A score before and after; None if it is absent or NaN."""

    figure: ScoreName
    unit: str
    a: float | None
    b: float | None

    @property
    def name(self) -> str:
        """Return its name in words."""
        *words, at = self.figure
        said = " ".join(str(word) for word in words if word not in ("", "all"))
        return said if at is None else f"{said} at {at:g}"

    @property
    def cells(self) -> tuple[str, str, str]:
        """Return both figures and the unit as text."""
        a, b = ("-" if value is None else f"{value:.5g}" for value in (self.a, self.b))
        return a, b, self.unit


@dataclass(frozen=True)
class Changes:
    """Two runs or versions side by side.

    Args:
        pairs: Differences of parameters, environment, files and licences, as text by name.
        artifacts: For each stage the number of artifacts that are the same, have other bytes (`other`), or are in one
            only.
        scores: Scores that differ, the largest relative change first.
        num_scores: Number of scores in either.
    """

    pairs: Mapping[str, Mapping[str, tuple[str, str]]]
    artifacts: Mapping[str, Mapping[str, int]]
    scores: Sequence[ScoreChange]
    num_scores: int


def differences(store: Store, first: Recorded, other: Recorded) -> Changes:
    """Compare two runs or versions; raises the errors of reading their scores."""
    counts: dict[str, dict[str, int]] = {}
    for place in {**first.artifacts, **other.artifacts}:
        mine, theirs = first.artifacts.get(place), other.artifacts.get(place)
        if mine is None or theirs is None:
            which = "only_b" if mine is None else "only_a"
        else:
            which = "same" if mine.ref.content_digest == theirs.ref.content_digest else "other"
        counts.setdefault(place[0], dict.fromkeys(("same", "other", "only_a", "only_b"), 0))[which] += 1
    before, after = (_figures_of(store, recorded.artifacts.values()) for recorded in (first, other))
    names = {**before, **after}
    scores = [
        ScoreChange(name, names[name][1], a, b)
        for name in names
        for a, b in [(before.get(name, (None, ""))[0], after.get(name, (None, ""))[0])]
        if a != b
    ]
    return Changes(
        pairs={
            "parameters": changed_leaves(first.sections, other.sections),
            "environment": environment_changes(first.environment, other.environment),
            "files": changed_leaves(first.sources, other.sources),
            "licences": changed_leaves(first.licences, other.licences),
        },
        artifacts=counts,
        scores=sorted(scores, key=lambda score: -_size(score)),
        num_scores=len(names),
    )


@dataclass(frozen=True)
class Comparison:
    """Differences of two builds of one study.

    Args:
        num_same: Artifacts with the same bytes.
        only_one: Places that only one build has.
        differing: Differences by place, each after its inputs.
        beyond: The first place with more than rounding; None without one.
    """

    num_same: int
    only_one: tuple[ArtifactPlace, ...]
    differing: Mapping[ArtifactPlace, Sequence[Difference]]
    beyond: ArtifactPlace | None

    @property
    def is_same(self) -> bool:
        """Return whether all differences are rounding."""
        return self.beyond is None and not self.only_one

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "is_same": self.is_same,
            "num_same_bytes": self.num_same,
            "only_in_one": [" ".join(place) for place in self.only_one],
            "first_beyond_rounding": None if self.beyond is None else " ".join(self.beyond),
            "differing": {
                " ".join(place): [str(difference) for difference in differences]
                for place, differences in self.differing.items()
            },
        }

    def lines(self) -> list[str]:
        """Return it as lines for people."""
        lines = [f"same bytes: {self.num_same} of {counted(self.num_same + len(self.differing), 'artifact')}"]
        lines += [f"only in one of the two: {' '.join(place)}" for place in self.only_one[:3]]
        first = self.beyond or next(iter(self.differing), None)
        if first is not None:
            lines.append(f"first {'beyond rounding' if self.beyond else 'that differs'}: {' '.join(first)}")
            lines += [
                f"    {worst}" for worst in sorted(self.differing[first], key=lambda difference: -difference.excess)[:5]
            ]
        return lines


def compare_builds(
    one_store: Store,
    first: Mapping[ArtifactPlace, Manifest],
    other_store: Store,
    other: Mapping[ArtifactPlace, Manifest],
) -> Comparison:
    """Compare two builds artifact by artifact; only those with different digests are read.

    Attached files (pages, pictures, weights) have no tolerance: other bytes count as rounding if a table before or
    beside them differs by rounding. A missing file never does.

    Raises:
        CorruptArtifact, SchemaError: A table cannot be read.
    """
    both = [place for place in first if place in other]
    compared = {place: compare_artifacts(one_store, first[place], other_store, other[place]) for place in both}
    differing = {place: differences for place, differences in compared.items() if differences}
    beyond, is_rounded = None, False
    for place, differences in differing.items():
        is_rounded = is_rounded or any(not difference.is_attachment for difference in differences)
        if any(
            difference.is_beyond and (difference.is_missing or not (is_rounded and difference.is_attachment))
            for difference in differences
        ):
            beyond = place
            break
    return Comparison(len(compared) - len(differing), tuple(sorted(first.keys() ^ other.keys())), differing, beyond)


def _size(score: ScoreChange) -> float:
    a, b = score.a, score.b
    return math.inf if a is None or b is None else abs(a - b) / max(abs(a), abs(b))
