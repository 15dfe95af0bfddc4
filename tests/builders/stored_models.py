"""Trained models in a store, as the stage `training` keeps them."""

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from pasdedeux.learning.model import VariantModel
from pasdedeux.learning.registry import describe_model, model_arrays
from pasdedeux.verdict import Level, Verdict
from storage_schema import Manifest, Store
from tasks.stage.judgements import VERDICT_FACT


def put_model(
    store: Store,
    model: VariantModel,
    split: str,
    takes: list[Manifest],
    test: Mapping[str, Sequence[str]] | None = None,
) -> Manifest:
    """Commit a model that was trained on some takes, perhaps to be tested on these variants by take."""
    arrays = model_arrays(model)
    judged = Verdict(Level.PASS, figure="joint error", value=1.25, unit="cm", baseline=2.0, baseline_name="naive_fk")
    ref = store.commit(
        stage="training",
        key=hashlib.sha256(f"{split} {model.name}".encode()).hexdigest(),
        partition=split,
        name=model.name,
        version=1,
        parameters={"settings": {"reach": 0.15}},
        seed=0,
        inputs=[take.ref for take in takes],
        files=[],
        tables={
            "models": {
                "split": [split] * len(arrays),
                "model": [model.name] * len(arrays),
                "array_name": sorted(arrays),
                "array_shape": [np.array(arrays[name].shape, np.int32) for name in sorted(arrays)],
                "array_dtype": [arrays[name].dtype.name for name in sorted(arrays)],
                "values": [arrays[name].ravel() for name in sorted(arrays)],
            },
            **({} if test is None else {"training_log": {}}),
        },
        facts={
            "model": model.name,
            "class": model.name,
            "description": describe_model(model).model_dump(mode="json"),
            "split": split,
            "takes": [take.facts["take_id"] for take in takes],
            "shares_takes": True,
            **{part: {take.facts["take_id"]: [part] for take in takes} for part in ("train", "validation", "test")},
            **({} if test is None else {"test": {take: list(names) for take, names in test.items()}}),
            VERDICT_FACT: judged.to_json(),
        },
        sources=[],
    )
    return store.manifest(ref)
