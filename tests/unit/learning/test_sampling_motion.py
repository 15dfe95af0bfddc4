"""Sampling of bodies and motion from a trained model, with scales or key frames given."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pasdedeux.augmentation import Augmenter, Source, uniform_variations
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.baselines import NaiveFkModel
from pasdedeux.learning.key_frames import KeyFrames, read_key_frames
from pasdedeux.learning.model import Training, TrainingItem, VariantRequest
from pasdedeux.learning.sampling import sample_motion
from pasdedeux.learning.settings import ActorLikeConfig, PaperCvaeConfig
from pasdedeux.learning.window_vae import ActorLikeModel, PaperCvaeModel
from pasdedeux.skeletons import BODY22
from tests.builders.moving_pairs import swaying_pair

TAKE = Source(swaying_pair(40), 30.0, "sway")


def items() -> list[TrainingItem]:
    variants = Augmenter(TAKE).solve(uniform_variations([0.8, 1.2], ["B"]))
    return [
        TrainingItem(v.variation.variant_id, VariantRequest("sway", TAKE, v.bone_scale), v.positions_m)
        for v in variants
    ]


@pytest.fixture(scope="module")
def model() -> PaperCvaeModel:
    small = {"num_steps": 20, "windows_per_step": 2, "num_blocks": 1, "kernel": 1, "width": 8, "hidden": 8}
    settings, variants = PaperCvaeConfig.model_validate({**small, "learning_rate": 0.01}), items()
    found = PaperCvaeModel.train(Training(items=lambda: iter(variants), settings=settings)).model
    assert isinstance(found, PaperCvaeModel)
    return found


def test_one_seed_is_one_body_and_motion_and_another_is_another(model: PaperCvaeModel) -> None:
    sample, again, another = (sample_motion(model, TAKE, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(sample.motion_m, again.motion_m)
    assert np.abs(sample.bone_scale[1] - another.bone_scale[1]).max() > 1e-6
    assert np.abs(sample.motion_m - another.motion_m).max() > 1e-6
    np.testing.assert_array_equal(sample.bone_scale[0], 1.0)


def test_given_scales_are_kept_and_needed_where_a_model_draws_none(model: PaperCvaeModel) -> None:
    scale = np.full(22, 0.9)
    for sampler in (model, NaiveFkModel()):
        found = sample_motion(sampler, TAKE, np.random.default_rng(0), scale=scale)
        np.testing.assert_allclose(found.bone_scale[1], scale, atol=1e-12)
    lengths = bone_lengths(BODY22, found.motion_m[:, 1])
    np.testing.assert_allclose(lengths[:, 1:], np.broadcast_to(0.9 * TAKE.lengths_m[1, 1:], (40, 21)), atol=1e-9)
    with pytest.raises(InputError, match="naive_fk draws no bodies: scales must be given"):
        sample_motion(NaiveFkModel(), TAKE, np.random.default_rng(0))
    with pytest.raises(InputError, match=r"allowed are 0\.05 to 20"):
        sample_motion(model, TAKE, np.random.default_rng(0), scale=-scale)


def test_b_goes_through_its_key_frames_has_their_bones_and_a_follows_b(model: PaperCvaeModel) -> None:
    frames = np.array([10, 20])
    pose = 1.1 * TAKE.positions_m[frames, 1] + [0.3, 0.0, 0.0]
    found = sample_motion(model, TAKE, np.random.default_rng(3), key_frames=KeyFrames(frames, pose))
    np.testing.assert_allclose(found.motion_m[frames, 1], pose, atol=1e-9)
    moving = [joint for _, joint in BODY22.bones]
    np.testing.assert_allclose(found.bone_scale[1, moving], 1.1, atol=1e-2)
    plain = sample_motion(model, TAKE, np.random.default_rng(3), scale=found.bone_scale[1])
    assert np.abs(found.motion_m[:, 0] - plain.motion_m[:, 0]).max() > 1e-6
    same_keys = KeyFrames(frames, plain.motion_m[frames, 1])
    again = sample_motion(model, TAKE, np.random.default_rng(3), scale=found.bone_scale[1], key_frames=same_keys)
    np.testing.assert_allclose(again.motion_m, plain.motion_m, atol=1e-5)  # the network is in single precision


def test_what_key_frames_add_fades_out_beyond_them() -> None:
    motion = np.zeros((90, 22, 3))
    bent = KeyFrames(np.array([45]), np.ones((1, 22, 3))).bend(motion, 30.0)
    assert np.abs(bent[45] - 1.0).max() < 1e-12
    assert np.abs(bent[[15, 75, 89]]).max() == 0.0
    assert (np.diff(bent[15:46, 0, 0]) > 0.0).all()


@pytest.mark.parametrize(
    ("frames", "shape", "sentence"),
    [
        ([3, 40], (2, 22, 3), "frame 40 is outside the motion of sway, which has 40 frames, 0 to 39"),
        ([-1], (1, 22, 3), "frame -1 is outside the motion"),
        ([4], (1, 18, 3), "poses have 18 joints"),
        ([4, 4], (2, 22, 3), "frames must increase"),
        ([], (0, 22, 3), "frames must increase"),
        ([4], (2, 22, 3), "poses of 1 frame have"),
    ],
)
def test_key_frames_that_are_not_of_the_motion_are_refused(
    model: PaperCvaeModel, frames: list[int], shape: tuple[int, ...], sentence: str
) -> None:
    def sample() -> None:
        keys = KeyFrames(np.array(frames, dtype=np.int64), np.zeros(shape))
        sample_motion(model, TAKE, np.random.default_rng(0), key_frames=keys)

    with pytest.raises(InputError, match=sentence):
        sample()


def test_a_model_without_a_motion_of_b_takes_no_key_frames() -> None:
    settings, variants = ActorLikeConfig(num_steps=1, width=4, windows_per_step=1), items()
    actor = ActorLikeModel.train(Training(items=lambda: iter(variants), settings=settings)).model
    keys = KeyFrames(np.array([4]), TAKE.positions_m[[4], 1])
    with pytest.raises(InputError, match="actor_like takes no key frames"):
        sample_motion(actor, TAKE, np.random.default_rng(0), key_frames=keys)


def test_key_frames_are_read_from_json_and_anything_else_ends_with_a_sentence() -> None:
    pose = TAKE.positions_m[[7], 1]
    found = read_key_frames(json.dumps({"frames": [7], "body22_m": pose.tolist()}).encode(), "keys.json")
    np.testing.assert_array_equal(found.positions_m, pose)
    nan = json.dumps({"frames": [7], "body22_m": (np.nan * pose).tolist()}).encode()
    for data in (b"", b"[]", b"\xff", b'{"frames": [1.5], "body22_m": [[[0, 0, 0]]]}', b'{"frames": 3}', nan):
        with pytest.raises(InputError, match=r"^keys.json: (no )?key frames"):
            read_key_frames(data, "keys.json")
