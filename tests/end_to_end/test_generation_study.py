"""A study trains a few steps on duets and generates: exact bodies, contacts kept, origin, figures, files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flows.exports import export_reference
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import BODY22
from storage_schema import Store
from tasks.stage.facts import VariantFacts
from tasks.training.items import StoredVariants
from tests.builders.real_study import STUDIES, build_here

pytestmark = pytest.mark.slow


def test_a_model_trained_on_duets_generates_sound_variants_that_are_scored_and_exported(tmp_path: Path) -> None:
    build_here(STUDIES / "generation.toml", tmp_path / "store")
    store = Store(tmp_path / "store")
    generated = list(store.artifacts("generation"))
    (model,) = [manifest for manifest in store.artifacts("training") if "models" in manifest.tables]
    takes = [manifest.ref for manifest in store.artifacts("ingest") if "poses" in manifest.tables]
    stored = StoredVariants(store, takes, [manifest.ref for manifest in generated])
    assert {VariantFacts.of(manifest).take_id for manifest in generated} == {"waltz", "hug", "push_hands"}
    bones = [child for _, child in BODY22.bones]
    for manifest in generated:
        facts = VariantFacts.of(manifest)
        assert facts.origin is not None
        assert (facts.origin.model, facts.origin.artifact) == ("paper_cvae", model.ref.key)
        first, second = stored.items([(facts.take_id, name) for name in facts.variants])
        assert np.abs(first.request.bone_scale[1] - second.request.bone_scale[1]).max() > 1e-6
        for item in (first, second):
            wanted_m = item.request.source.lengths_m * item.request.bone_scale
            away_m = (bone_lengths(BODY22, item.motion_m) - wanted_m)[..., bones]
            np.testing.assert_allclose(away_m, 0.0, atol=1e-6)
        quality = store.read(manifest.ref, "variant_quality")
        assert set(quality["solver"]) == {"model"}
        assert quality["contact_drift_m"].max() < 0.01
    (topic,) = [manifest for manifest in store.artifacts("evaluation") if manifest.partition == "generation"]
    scores = store.read(topic.ref, "scores")
    figures = {
        (metric, method): value
        for metric, method, value in zip(scores["metric"], scores["method"], scores["value"], strict=True)
    }
    assert {method for metric, method in figures if metric == "FID"} == {
        "paper_cvae",
        "solver",
        "real_halves",
        "strangers",
    }
    assert figures["FID", "paper_cvae"] < figures["FID", "strangers"]
    assert figures["contact_error", "paper_cvae"] < figures["contact_error", "naive_fk"]
    paths = export_reference(store, f"variants@{generated[0].ref.key[:12]}", "bvh", tmp_path)
    assert sum(path.suffix == ".bvh" for path in paths) == 4
