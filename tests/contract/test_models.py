"""What every registered model does, as `VariantModel` says."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from pasdedeux.augmentation import Augmenter, Source, uniform_variations
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.meter import model_errors
from pasdedeux.learning.model import Arrays, Training, TrainingItem, VariantModel, VariantRequest
from pasdedeux.learning.registry import BASELINES, MODELS, describe_model, load_model, model_arrays
from pasdedeux.skeletons import BODY22
from tests.builders.moving_pairs import swaying_pair

TAKE = Source(swaying_pair(8), 30.0, "sway")
UNSEEN = Source(swaying_pair(5, seed=9), 30.0, "unseen")
SMALL = {
    "paper_cvae": {"num_steps": 25, "segment_steps": 10, "windows_per_step": 4, "num_blocks": 1, "kernel": 1}
    | {"width": 8, "hidden": 8, "latent_size": 4, "learning_rate": 0.01},
    "actor_like": {"num_steps": 60, "segment_steps": 15, "windows_per_step": 4, "width": 16, "learning_rate": 0.01},
    "action2motion_like": {"num_steps": 40, "segment_steps": 15, "windows_per_step": 4, "hidden": 16}
    | {"latent_size": 4, "learning_rate": 0.01},
}
"""Settings of models that would take long."""
KINDS = pytest.mark.parametrize("kind", MODELS.values(), ids=MODELS)


Trainer = Callable[[type[VariantModel]], VariantModel]


@pytest.fixture(scope="module")
def variants() -> list[TrainingItem]:
    variations = uniform_variations([0.8, 0.9, 1.1, 1.2], ["A", "B"])
    return [
        TrainingItem(v.variation.variant_id, VariantRequest("sway", TAKE, v.bone_scale), v.positions_m)
        for v in Augmenter(TAKE).solve(variations)
    ]


@pytest.fixture(scope="module")
def trained(variants: list[TrainingItem]) -> Trainer:
    """Return a function that trains a model on the variants, once for all tests."""
    return cache(lambda kind: train(kind, variants))


def train(kind: type[VariantModel], variants: list[TrainingItem]) -> VariantModel:
    """Train all segments, each from what the one before left as a store would keep it."""
    settings = getattr(kind, "config_kind", kind.settings).model_validate(SMALL.get(kind.name, {}))
    start = kind.start(settings)
    built_on = None if start is None else train(MODELS[start], variants)
    state: Arrays = {}
    for segment in range(kind.num_segments(settings)):
        trained = kind.train(
            Training(
                items=lambda: iter(variants),
                validation=lambda: iter(variants),
                settings=settings,
                generator=np.random.default_rng([3, segment]),
                segment=segment,
                state=state,
                start=built_on,
            )
        )
        assert all(np.isfinite(entry.value) for entry in trained.log)
        state = {name: values.copy() for name, values in trained.state.items()}
    return trained.model


def requests() -> list[VariantRequest]:
    scales = [variation.bone_scale for variation in uniform_variations([0.75, 1.0, 1.25], ["A", "AB"])]
    return [VariantRequest(take.name, take, scale) for take in (TAKE, UNSEEN) for scale in scales]


@KINDS
def test_a_model_predicts_finite_motions_of_both_people_for_seen_and_unseen_takes(
    kind: type[VariantModel], trained: Trainer
) -> None:
    model = trained(kind)
    for request in requests():
        motion = model.predict(request)
        assert motion.shape == request.source.positions_m.shape
        assert motion.dtype == np.float64
        assert np.isfinite(motion).all()
        assert not np.shares_memory(motion, request.source.positions_m)


@KINDS
def test_training_again_gives_the_same_arrays_and_the_arrays_the_same_model(
    kind: type[VariantModel], variants: list[TrainingItem], trained: Trainer
) -> None:
    model, again = trained(kind), train(kind, variants)
    arrays = model_arrays(model)
    assert {name: values.tobytes() for name, values in arrays.items()} == {
        name: values.tobytes() for name, values in model_arrays(again).items()
    }
    assert all(values.dtype in (np.float32, np.float64) for values in arrays.values())
    loaded = load_model(describe_model(model), arrays)
    for request in requests():
        np.testing.assert_array_equal(model.predict(request), loaded.predict(request))


@KINDS
def test_bone_lengths_are_exact_where_promised(kind: type[VariantModel], trained: Trainer) -> None:
    model = trained(kind)
    errors = []
    for request in requests():
        wanted = request.source.lengths_m * request.bone_scale
        wanted[:, BODY22.root] = 0.0
        errors.append(np.abs(bone_lengths(BODY22, model.predict(request)) - wanted).max())
    assert (max(errors) < 1e-9) == kind.has_exact_bones


@KINDS
def test_what_is_trained_beats_the_copy_on_its_take_and_refuses_to_learn_from_nothing(
    kind: type[VariantModel], variants: list[TrainingItem]
) -> None:
    if not kind.is_trained:
        train(kind, [])
        return
    train_on = [item for item in variants if "0.90" in item.variant_id or "1.10" in item.variant_id]
    models = [train(kind, train_on), train(MODELS["copy"], train_on)]
    learned, copied = (
        np.mean([model_errors(model.predict(item.request), item.motion_m)["E_r"] for item in variants])
        for model in models
    )
    assert learned < copied
    with pytest.raises(InputError):
        train(kind, [])
    with pytest.raises(InputError):
        kind.restore({}, {})


def test_baselines_are_registered_and_learn_nothing() -> None:
    assert BASELINES == ("copy", "naive_fk")
    assert not any(MODELS[name].is_trained for name in BASELINES)
