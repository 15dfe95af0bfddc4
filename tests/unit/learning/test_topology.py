"""Models of ExPI's 18 joints: items follow from body22, and weights of different skeletons do not mix."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pasdedeux.augmentation import Source, reference_motion, uniform_variations
from pasdedeux.augmentation.source import complete_scales
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.baselines import CopyModel
from pasdedeux.learning.meter import ModelMeter
from pasdedeux.learning.model import Training, TrainingItem, VariantModel, VariantRequest, mapped_item, mapped_source
from pasdedeux.learning.registry import (
    MODELS,
    Weights,
    describe_model,
    load_model,
    model_arrays,
    read_weights,
    write_weights,
)
from pasdedeux.skeletons import BODY22, EXPI18, EXPI18_OF_BODY22, MODEL_SKELETONS
from storage_schema import Store
from tasks.evaluation.realism import TOPIC, LearnedSettings
from tasks.stage import StageInputs
from tasks.training.parameters import TrainingParameters, TrainingSegmentParameters
from tests.builders.moving_pairs import swaying_pair
from tests.builders.stored_models import put_model
from tests.builders.walking_takes import put_take

TAKE = Source(swaying_pair(30), 20.0, "sway")
MAPPED = mapped_source(TAKE, EXPI18_OF_BODY22)
FREE = [kind for kind in MODELS.values() if kind.is_of_any_skeleton]
SMALL = {
    "paper_cvae": {"width": 6, "hidden": 5, "latent_size": 3, "num_blocks": 2, "kernel": 3},
    "actor_like": {"width": 8, "num_blocks": 1},
    "action2motion_like": {"hidden": 6, "latent_size": 3},
}


def _items(scales: tuple[float, ...] = (0.8, 0.9, 1.1)) -> list[TrainingItem]:
    """Return variants on body22 by plain kinematics."""
    found = []
    for variation in uniform_variations(scales, ["B"]):
        motion = reference_motion(TAKE, complete_scales(TAKE, variation.bone_scale[None]))[0]
        found.append(TrainingItem(variation.variant_id, VariantRequest("sway", TAKE, variation.bone_scale), motion))
    return found


def _trained(kind: type[VariantModel], *, is_mapped: bool) -> VariantModel:
    items = [mapped_item(item, EXPI18_OF_BODY22, MAPPED) if is_mapped else item for item in _items()]
    sizes = SMALL.get(kind.name)
    settings = kind.config_kind.model_validate({"window_s": 1.0, "num_steps": 2} | sizes) if sizes else None
    return kind.train(Training(lambda: iter(items), settings=settings)).model


def test_a_mapped_item_has_the_scales_and_the_motion_that_its_bones_have() -> None:
    assert len({skeleton.num_joints for skeleton in MODEL_SKELETONS.values()}) == len(MODEL_SKELETONS)
    (item,) = (mapped_item(item, EXPI18_OF_BODY22, MAPPED) for item in _items((0.8,)))
    np.testing.assert_allclose(item.request.bone_scale[0], 1.0, atol=1e-12)
    bones = [child for _, child in EXPI18.bones]
    np.testing.assert_allclose(item.request.bone_scale[1, bones], 0.8, atol=1e-9)
    lengths = [np.median(bone_lengths(EXPI18, motion), axis=0) for motion in (item.motion_m, MAPPED.positions_m)]
    np.testing.assert_allclose(lengths[0][1], 0.8 * lengths[1][1], atol=1e-9)
    assert item.request.source.floor_m == TAKE.floor_m
    # If one leg is longer, so are its bones, and no others.
    scale = np.ones((2, 22))
    scale[0, BODY22.indices(["left_knee"])] = 1.2
    longer = replace(_items((0.8,))[0], request=VariantRequest("sway", TAKE, scale))
    found = mapped_item(longer, EXPI18_OF_BODY22, MAPPED).request.bone_scale[0]
    assert [EXPI18.joint_names[row] for row in np.flatnonzero(np.abs(found - 1.0) > 1e-9)] == ["left_knee"]
    assert found[EXPI18.index("left_knee")] == pytest.approx(1.2)


def test_people_on_18_joints_touch_where_they_do_on_22_and_contacts_drift_as_far() -> None:
    wide, narrow = VariantRequest("sway", TAKE, np.ones((2, 22))), VariantRequest("sway", MAPPED, np.ones((2, 18)))
    apart = np.array([0.0, 0.0, 0.1]) * np.arange(2)[:, None, None]
    found = [
        (meter.key_names(), meter.measure(asked.bone_scale, {"moved": moved}, asked.source.positions_m))
        for asked in (wide, narrow)
        for meter, moved in [(ModelMeter(asked), asked.source.positions_m + apart)]
    ]
    assert found[0][0] == found[1][0] != ""
    for metric in ("JPD", "contact_error"):
        assert found[1][1]["moved"][metric] == pytest.approx(found[0][1]["moved"][metric], rel=0.05)
    assert found[1][1]["solver"]["contact_error"] == 0.0


@pytest.mark.parametrize("kind", FREE, ids=lambda kind: kind.name)
def test_a_model_learns_and_answers_on_18_joints_and_refuses_the_other_topology(kind: type[VariantModel]) -> None:
    model, wide = _trained(kind, is_mapped=True), _trained(kind, is_mapped=False)
    asked = mapped_item(_items((0.85,))[0], EXPI18_OF_BODY22, MAPPED).request
    motion = model.predict(asked)
    assert motion.shape == (30, 2, 18, 3)
    assert np.isfinite(motion).all()
    unseen = replace(asked, take_id="another")
    loaded = load_model(describe_model(model), model_arrays(model))
    np.testing.assert_array_equal(loaded.predict(unseen), model.predict(unseen))
    found = ModelMeter(asked).measure(asked.bone_scale, {kind.name: motion}, MAPPED.positions_m)[kind.name]
    assert {"E_r", "E_b", "PWD"} <= {name for name, value in found.items() if np.isfinite(value)}
    if model.skeleton is None:
        return
    assert (model.skeleton, wide.skeleton) == (EXPI18, BODY22)
    with pytest.raises(InputError, match=f"{kind.name}: weights of another topology: it is of expi18, 18 joints"):
        model.predict(_items((0.85,))[0].request)
    with pytest.raises(InputError, match="weights of another topology: it is of body22, 22 joints"):
        wide.predict(asked)
    # Mixed arrays, and a file that states the other skeleton, are refused.
    key = "mix" if kind.name == "ridge_scale" else "known_scales"
    with pytest.raises(InputError, match="weights of another topology"):
        load_model(describe_model(wide), {**model_arrays(wide), key: model_arrays(model)[key]})
    data = write_weights(Weights(model))
    assert read_weights(data, "own").model.skeleton is EXPI18
    said = b",".join(name.encode() for name in EXPI18.joint_names)
    assert said in data
    with pytest.raises(InputError, match="weights of another topology, 18 joints"):
        read_weights(data.replace(said, said.replace(b"back", b"hips")), "other")


def test_a_study_says_which_models_may_be_of_18_joints_and_keys_of_body22_stay() -> None:
    with pytest.raises(InputError, match="'ridge_adapted' is of body22 alone; of expi18 can be copy, naive_fk"):
        TrainingParameters.model_validate({"skeleton": "expi18", "models": ["copy", "ridge_adapted"]}).named()
    keys = {"split": "random", "test_takes": (), "name": "copy", "model": "copy", "segment": 0}
    keys["settings"] = MODELS["copy"].settings()
    assert "skeleton" not in TrainingSegmentParameters.model_validate(keys).model_dump(mode="json")
    narrow = TrainingSegmentParameters.model_validate(keys | {"skeleton": "expi18"})
    assert narrow.model_dump(mode="json")["skeleton"] == "expi18"


def test_models_of_18_joints_are_no_distributions_and_that_is_said(tmp_path: Path) -> None:
    store = Store(tmp_path)
    takes = [put_take(store, take_id) for take_id in ("hug", "judo")]
    model = put_model(store, CopyModel(), "random", takes)
    narrow = replace(model, facts={**model.facts, "skeleton": "expi18"})
    settings = LearnedSettings(num_realism_variants=2)
    for models, planned in (([model, narrow], "all"), ([narrow], "other_skeleton"), ([], None)):
        shards = TOPIC.plan(StageInputs({"poses": takes, "models": models}, 0), settings)
        assert [shard.name for shard in shards] == [planned] * bool(models)
    (shard,) = TOPIC.plan(StageInputs({"poses": takes, "models": [narrow]}, 0), settings)
    assert TOPIC.compute(shard, store).notes == ["Skipped: the clip classifier works on body22, and no model does."]
