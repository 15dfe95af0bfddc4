"""Topic `models`: predictions of the trained models on the variants kept for testing."""

from __future__ import annotations

from pasdedeux.evaluation.models import key_contacts, model_errors, model_figure, model_scores
from pasdedeux.evaluation.verdicts import Yardstick
from pasdedeux.learning import BASELINES, VariantKey
from storage_schema import Manifest, Store
from tasks.evaluation.topic import Topic, TopicResult
from tasks.stage import Parameters, Shard, StageInputs
from tasks.training.items import StoredVariants
from tasks.training.run import load_stored, without_torch

__all__ = ["TOPIC"]


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per split, with every model trained on it."""
    splits: dict[str, list[Manifest]] = {}
    for manifest in inputs.of("models"):
        splits.setdefault(manifest.facts["split"], []).append(manifest)
    found = []
    for split, models in splits.items():
        tested = set(models[0].facts["test"])
        takes = [manifest for manifest in inputs.of("poses") if manifest.facts["take_id"] in tested]
        variants = [manifest for manifest in inputs.of("variants") if manifest.facts["take_id"] in tested]
        found.append(TOPIC.shard(inputs, split, models=models, takes=takes, variants=variants))
    return found


def _run(shard: Shard, store: Store) -> TopicResult:
    """Score every model of a split on its test variants."""
    stored = [store.manifest(ref) for ref in shard.refs("models")]
    facts = stored[0].facts
    manifests, left_out = without_torch(stored)
    notes = [f"{name} is left out: torch is not installed where this was scored" for name in left_out]
    if not manifests:
        return TopicResult(notes=notes)
    variants = StoredVariants(store, shard.refs("takes"), shard.refs("variants"))
    models = {manifest.facts["model"]: load_stored(store, manifest) for manifest in manifests}
    keys_of = {take_id: key_contacts(take.source.contacts()) for take_id, take in variants.takes.items()}
    errors: dict[str, list[dict[str, float]]] = {name: [] for name in models}
    at: list[float] = []
    owners: list[str] = []
    for item in variants.items([(take_id, name) for take_id, names in facts["test"].items() for name in names]):
        take_id = item.request.take_id
        owners.append(take_id)
        at.append(VariantKey(take_id, item.variant_id, item.request.bone_scale).furthest_scale)
        for name, model in models.items():
            errors[name].append(model_errors(model.predict(item.request), item.motion_m, keys_of[take_id]))
    split = f"{facts['split']} test"
    scores = model_scores(errors, baselines=BASELINES, split=split, item="all")
    for take_id in sorted(set(owners)):
        mine = {
            name: [e for e, owner in zip(found, owners, strict=True) if owner == take_id]
            for name, found in errors.items()
        }
        scores += model_scores(mine, baselines=BASELINES, split=split, item=take_id)
    name = f"models-{facts['split']}.svg"
    shared = " The takes are those of the training set, at other scales." if facts["shares_takes"] else ""
    return TopicResult(
        scores=scores,
        pictures={name: model_figure(at, errors, baselines=BASELINES, split=facts["split"])},
        captions={name: f"Error of each model on the {len(at)} test variants of split {facts['split']}.{shared}"},
        notes=notes,
    )


TOPIC = Topic(
    name="models",
    heading="Models",
    introduction="Models that predict a variant from the source and its bone scales; copy and naive forward kinematics "
    "are the baselines.",
    reads=("models", "poses", "variants", "variant_quality"),
    plan=_plan,
    run=_run,
    metrics=("E_*", "JPD", "PWD"),
    yardsticks=(
        Yardstick("E_r", "joint error E_r", ("ridge_scale", *BASELINES)),
        Yardstick("E_r", "joint error E_r", BASELINES),
    ),
    cautions=(
        (
            "models",
            "Models are scored on takes that they saw at other scales (cross-scale split) unless the split says "
            "otherwise.",
        ),
    ),
)
