"""Trained models as safetensors, each with a card: training data, parameters and scores."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from flows.exports.export_format import Export, ExportFormat, FileNames, write_text
from flows.records import last_runs
from flows.templates import fill_template
from pasdedeux.learning.registry import Weights, write_weights
from pasdedeux.plain_text import markdown_text
from storage_schema import Manifest, Store
from tasks.stage.facts import ModelFacts, TakeFacts
from tasks.stage.judgements import verdict_of
from tasks.training.run import load_stored


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write weights, which `retarget --model` reads, and a model card in Markdown."""
    names = FileNames(out)
    paths = []
    for ref in export.refs:
        manifest = export.store.manifest(ref)
        facts = ModelFacts.of(manifest)
        path = names.path(facts.split, facts.model, suffix=".safetensors")
        path.write_bytes(write_weights(stored_weights(export.store, manifest)))
        paths += [path, write_text(path.with_suffix(".md"), _card(export.store, manifest))]
    return paths


FORMAT = ExportFormat(_write, lambda reference: reference.table == "models" and reference.row is None, "models")


def stored_weights(store: Store, manifest: Manifest) -> Weights:
    """Return a stored model with the takes that it was trained on."""
    learned = ModelFacts.of(manifest).takes
    takes = {
        take_id: read.ref.content_digest
        for read in _read(store, manifest)
        if read.ref.stage == "ingest" and (take_id := TakeFacts.of(read).take_id) in learned
    }
    return Weights(load_stored(store, manifest), takes)


def _read(store: Store, manifest: Manifest) -> list[Manifest]:
    """Return the training data of a model that is still in the store."""
    inputs = (store.find(ref.stage, ref.key) for ref in manifest.inputs)
    return [found_manifest for found_manifest in inputs if found_manifest is not None]


def _card(store: Store, manifest: Manifest) -> str:
    facts = ModelFacts.of(manifest)
    return fill_template(
        "model_card.md",
        facts=facts,
        manifest=manifest,
        counts={part: sum(map(len, getattr(facts, part).values())) for part in ("train", "validation", "test")},
        settings=json.dumps(manifest.parameters.get("settings", {}), indent=1),
        verdict=verdict_of(manifest),
        metrics=list(dict.fromkeys(_metrics(store, manifest))),
    )


def _metrics(store: Store, manifest: Manifest) -> Iterator[str]:
    """Yield the scores of a model as rows: those of the last runs of studies, else all."""
    evaluations = [
        part for part in store.artifacts("evaluation") if manifest.ref in part.inputs and "scores" in part.tables
    ]
    current = {ref.place for last in last_runs(store) for ref in last.refs("evaluation")}
    for scores in [part for part in evaluations if part.ref.place in current] or evaluations:
        rows = store.read(scores.ref, "scores")
        for row in map(rows.row, range(rows.num_rows)):
            if row["method"] == ModelFacts.of(manifest).model and row["item"] == "all" and np.isnan(row["at"]):
                words = [markdown_text(row[name]) for name in ("metric", "split", "unit")]
                yield f"| {words[0]}, {words[1]} | {row['value']:.4g} {words[2]} | |"
