"""Topic `models`: predictions of the trained models on the variants kept for testing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.evaluation.models import key_contacts, model_errors, model_figure, model_scores
from pasdedeux.evaluation.verdicts import Yardstick
from pasdedeux.learning import BASELINES, VariantKey, VariantModel, load_model
from storage_schema import ArtifactRef, Store
from tasks.augmentation import read_take
from tasks.evaluation.topic import Topic, TopicResult
from tasks.stage import Parameters, Shard, StageInputs
from tasks.training import read_items

__all__ = ["TOPIC"]


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per split."""
    found = []
    for models in inputs.of("models"):
        tested = set(models.facts["test"])
        takes = [manifest for manifest in inputs.of("poses") if manifest.facts["take_id"] in tested]
        variants = [manifest for manifest in inputs.of("variants") if manifest.facts["take_id"] in tested]
        found.append(TOPIC.shard(inputs, models.facts["split"], models=[models], takes=takes, variants=variants))
    return found


def _run(shard: Shard, store: Store) -> TopicResult:
    """Score every model of a split on its test variants."""
    facts = store.manifest(shard.ref("models")).facts
    takes = {store.manifest(ref).facts["take_id"]: read_take(store, ref) for ref in shard.refs("takes")}
    keys, homes, scales = _test_variants(store, shard.refs("variants"), facts["test"])
    models = _read_models(store, shard.ref("models"))
    keys_of = {take_id: key_contacts(take.source.contacts()) for take_id, take in takes.items()}
    errors: dict[str, list[dict[str, float]]] = {name: [] for name in models}
    at: list[float] = []
    owners: list[str] = []
    for item in read_items(store, keys, homes, takes):
        take_id = item.request.take_id
        owners.append(take_id)
        at.append(scales[take_id, item.variant_id])
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
    name = f"models-{facts['split']}.png"
    shared = " The takes are those of the training set, at other scales." if facts["shares_takes"] else ""
    return TopicResult(
        scores=scores,
        pictures={name: model_figure(at, errors, baselines=BASELINES, split=facts["split"])},
        captions={name: f"Error of each model on the {len(at)} test variants of split {facts['split']}.{shared}"},
    )


def _test_variants(
    store: Store, refs: Sequence[ArtifactRef], wanted: dict[str, list[str]]
) -> tuple[list[VariantKey], dict[tuple[str, str], ArtifactRef], dict[tuple[str, str], float]]:
    """Return the test variants, where each lies, and the scale of person A (NaN where not uniform)."""
    keys, homes, scales = [], {}, {}
    for ref in refs:
        take_id = store.manifest(ref).facts["take_id"]
        table = store.read(ref, "variant_quality", columns=["variant_id", "bone_scale", "uniform_scale"])
        for row, variant_id in enumerate(table["variant_id"]):
            if variant_id in wanted[take_id]:
                keys.append(VariantKey(take_id, str(variant_id), table["bone_scale"][row].reshape(2, -1)))
                homes[take_id, str(variant_id)] = ref
                scales[take_id, str(variant_id)] = float(table["uniform_scale"][row][0])
    return keys, homes, scales


def _read_models(store: Store, ref: ArtifactRef) -> dict[str, VariantModel]:
    table = store.read(ref, "models")
    arrays: dict[str, dict[str, np.ndarray]] = {}
    for row, model in enumerate(table["model"]):
        values = np.asarray(table["values"][row], dtype=np.float64).reshape(table["array_shape"][row])
        arrays.setdefault(str(model), {})[str(table["array_name"][row])] = values
    return {name: load_model(name, found) for name, found in arrays.items()}


TOPIC = Topic(
    name="models",
    heading="Models",
    introduction="Models that predict a variant from the source and its bone scales; copy and naive forward kinematics "
    "are the baselines.",
    reads=("models", "poses", "variants", "variant_quality"),
    plan=_plan,
    run=_run,
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
