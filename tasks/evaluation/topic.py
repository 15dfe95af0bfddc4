"""What every topic of the evaluation gives: figures, pictures with captions, and what was left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.evaluation.scores import Score, columns_of
from storage_schema import ArtifactRef, Manifest, Store
from tasks.stage import Shard, commit, merge_takes

__all__ = ["STAGE_NAME", "VERSION", "TopicResult", "commit_topic", "make_shard", "read_people", "refuse_overlap"]

STAGE_NAME = "evaluation"
VERSION = 15


@dataclass(frozen=True)
class TopicResult:
    """What a topic found.

    Args:
        scores: The figures.
        pictures: Files by name (.png or .webp).
        captions: A caption for each picture.
        notes: Sentences for the reader: what was measured, what was skipped and why.
    """

    scores: Sequence[Score] = ()
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    captions: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()


def make_shard(*, topic: str, name: str, inputs: Sequence[Manifest], parameters: Mapping[str, Any], seed: int) -> Shard:
    """Return a shard of a topic that reads these artifacts."""
    return Shard(
        stage=STAGE_NAME,
        version=VERSION,
        partition=topic,
        name=name,
        parameters={"topic": topic, **parameters},
        inputs=tuple(manifest.ref for manifest in inputs),
        seed=seed,
    )


def commit_topic(shard: Shard, store: Store, result: TopicResult) -> ArtifactRef:
    """Commit what a topic found."""
    facts = {
        "topic": shard.partition,
        "takes": merge_takes(*(store.manifest(ref) for ref in shard.inputs)),
        "captions": dict(result.captions),
        "notes": list(result.notes),
    }
    tables = {"scores": columns_of(result.scores)} if result.scores else {}
    return commit(shard, store, tables=tables, attachments=dict(result.pictures), facts=facts)


def read_people(store: Store, ref: ArtifactRef, column: str) -> np.ndarray:
    """Read one positions column of a take's poses as (frame, person, joint, 3), float64."""
    num_persons = int(store.manifest(ref).facts["num_persons"])
    data = store.read(ref, "poses", columns=[column])[column].astype(np.float64)
    return np.swapaxes(data.reshape(num_persons, -1, *data.shape[1:]), 0, 1)


def refuse_overlap(what: str, learned_from: Sequence[str], evaluated: Sequence[str]) -> None:
    """Refuse to evaluate takes that were learned from.

    Raises:
        InputError: A take is in both lists.
    """
    both = sorted(set(learned_from) & set(evaluated))
    if both:
        raise InputError(f"{what} learned from {', '.join(both)}, which it is evaluated on; hold these takes out")
