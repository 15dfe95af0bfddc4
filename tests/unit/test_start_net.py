"""The network of `start_net`: what it keeps whatever it learned, and what its training refuses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from pasdedeux.augmentation import Source, reference_motion, uniform_variations
from pasdedeux.errors import InputError
from pasdedeux.learning import (
    RidgeScaleModel,
    StartNetModel,
    Training,
    TrainingItem,
    VariantRequest,
    load_model,
    model_arrays,
)
from pasdedeux.learning.local_mesh import first_weights
from pasdedeux.learning.windows import Spread, frames_looked_at
from pasdedeux.skeletons import BODY22
from tests.builders.moving_pairs import swaying_pair

TAKE = Source(swaying_pair(12), 30.0, "sway")
UNSEEN = Source(swaying_pair(9, seed=9), 30.0, "unseen")
FEW = StartNetModel.settings(num_steps=40, segment_steps=20, frames_per_step=4, variants_per_step=4)


def _model(seed: int = 5) -> StartNetModel:
    """Return a network with weights that somebody might have learned."""
    generator = np.random.default_rng(seed)
    weights = {
        name: (values + generator.normal(0.0, 0.5, values.shape)).astype(np.float32)
        for name, values in first_weights().items()
    }
    return StartNetModel(RidgeScaleModel(), weights)


def _items(source: Source) -> list[TrainingItem]:
    """Return variants of which B follows A: what no kinematics of one body can know."""
    items = []
    for variation in uniform_variations([0.8, 0.9, 1.1, 1.2], ["A", "B"]):
        motion = reference_motion(source, variation.bone_scale[None])[0]
        moved = (source.positions_m - motion)[:, ::-1].mean(axis=2, keepdims=True)
        request = VariantRequest(source.name, source, variation.bone_scale)
        items.append(TrainingItem(variation.variant_id, request, motion - 0.5 * moved))
    return items


def _ask(model: StartNetModel, source: Source, scale: np.ndarray) -> np.ndarray:
    return np.asarray(model.predict(VariantRequest("another", source, scale)))


def _train(items: list[TrainingItem]) -> StartNetModel:
    ridge = RidgeScaleModel.train(Training(lambda: iter(items))).model
    state = {}
    for segment in range(FEW.num_segments):
        generator = np.random.default_rng(segment)
        trained = StartNetModel.train(
            Training(lambda: iter(items), lambda: iter(items), FEW, generator, segment, state, ridge)
        )
        state = trained.state
    assert isinstance(trained.model, StartNetModel)
    return trained.model


def test_nothing_moves_at_scale_one() -> None:
    np.testing.assert_allclose(_ask(_model(), TAKE, np.ones((2, 22))), TAKE.positions_m, atol=1e-6)


def test_a_turned_mirrored_or_swapped_pair_is_answered_by_the_same_motion_so_changed() -> None:
    model, (variation,) = _model(), uniform_variations([0.8], ["A"])
    plain, source = _ask(model, TAKE, variation.bone_scale), TAKE.positions_m
    turn = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
    away = np.array([3.0, 0.0, -2.0])
    turned = replace(TAKE, positions_m=source @ turn.T + away)
    np.testing.assert_allclose(_ask(model, turned, variation.bone_scale), plain @ turn.T + away, atol=2e-5)
    flip, mirror = np.array([-1.0, 1.0, 1.0]), list(BODY22.mirror)
    mirrored = replace(TAKE, positions_m=source[:, :, mirror] * flip)
    np.testing.assert_allclose(
        _ask(model, mirrored, variation.bone_scale[:, mirror]), plain[:, :, mirror] * flip, atol=2e-5
    )
    swapped = replace(TAKE, positions_m=np.ascontiguousarray(source[:, ::-1]))
    np.testing.assert_allclose(_ask(model, swapped, variation.bone_scale[::-1]), plain[:, ::-1], atol=2e-5)


def test_it_learns_what_one_body_alone_cannot_tell_and_is_better_on_a_take_it_never_saw() -> None:
    model = _train(_items(TAKE))
    untrained = StartNetModel(RidgeScaleModel(), first_weights())
    wrong = [
        np.mean([np.linalg.norm(one.predict(i.request) - i.motion_m, axis=-1).mean() for i in _items(UNSEEN)])
        for one in (model, untrained, load_model("naive_fk", {}))
    ]
    assert wrong[0] < 0.8 * wrong[1]
    assert wrong[0] < 0.95 * wrong[2]
    assert set(model.seen.coefficients) == {"sway"}


def test_the_floor_and_frames_between_are_followed_smoothly() -> None:
    long = Source(swaying_pair(40), 60.0, "sway")
    (variation,) = uniform_variations([0.8], ["A"])
    moved = _ask(_model(), long, variation.bone_scale)
    jerk = [np.abs(np.diff(motion, 3, axis=0)).max() for motion in (moved, long.positions_m)]
    assert jerk[0] < 3.0 * jerk[1]
    alone = Source(swaying_pair(1), 30.0, "one frame")
    assert np.isfinite(_ask(_model(), alone, variation.bone_scale)).all()


def test_numbers_that_are_not_finite_end_training_and_are_named() -> None:
    items = _items(TAKE)
    broken = items[0].motion_m.copy()
    broken[:] = np.nan
    with pytest.raises(InputError, match=r"start_net: step \d+ came to a number that is not finite on takes sway"):
        StartNetModel.train(
            Training(
                lambda: iter([replace(item, motion_m=broken) for item in items]), settings=FEW, start=RidgeScaleModel()
            )
        )
    with pytest.raises(InputError, match="device 'abacus' cannot be used"):
        StartNetModel.train(
            Training(lambda: iter(items), settings=FEW.model_copy(update={"device": "abacus"}), start=RidgeScaleModel())
        )


def test_weights_of_another_shape_or_that_are_not_finite_are_refused() -> None:
    arrays = model_arrays(_model())
    assert all(arrays[name].dtype == np.float32 for name in first_weights())
    with pytest.raises(InputError, match=r"'own' has shape \(17, 17\), not \(22, 22\): weights of another"):
        load_model("start_net", {**arrays, "own": np.zeros((17, 17), np.float32)})
    with pytest.raises(InputError, match="'own' has a value that is not finite"):
        load_model("start_net", {**arrays, "own": np.full((22, 22), np.nan, np.float32)})
    with pytest.raises(InputError, match="ridge_scale"):
        load_model("start_net", {name: arrays[name] for name in first_weights()})


@pytest.mark.parametrize("num_frames", [1, 2, 30, 605, 1801])
def test_frames_between_those_looked_at_are_on_a_cubic_spline_and_long_takes_need_little(num_frames: int) -> None:
    source = Source(np.zeros((num_frames, 2, 22, 3)), 30.0, "still")
    frames = frames_looked_at(source)
    values = np.random.default_rng(0).standard_normal((len(frames), 3))
    wanted = CubicSpline(frames, values)(np.arange(num_frames)) if num_frames > 1 else values
    spread = Spread.over(source, frames)
    np.testing.assert_allclose(spread.apply(values), wanted, atol=1e-12)
    assert sum(shares.size for _, shares in spread.stretches) <= 280 * num_frames
