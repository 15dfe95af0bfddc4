"""Models of motion from a class, and other architectures of the published model: laws, and what each ignores."""

import numpy as np
import pytest
import torch

from pasdedeux.augmentation import Source, uniform_variations
from pasdedeux.errors import InputError
from pasdedeux.learning.model import Arrays, Training, TrainingItem, VariantRequest
from pasdedeux.learning.networks.class_vaes import _divergence_between
from pasdedeux.learning.networks.interaction_cvae import InteractionCvae
from pasdedeux.learning.networks.layers import WindowNetwork, divergence
from pasdedeux.learning.networks.motion_predictor import MotionPredictor
from pasdedeux.learning.registry import describe_model, load_model, model_arrays
from pasdedeux.learning.settings import PaperCvaeConfig
from pasdedeux.learning.window_vae import Action2MotionLikeModel, ActorLikeModel, PaperCvaeModel, WindowVae
from tests.builders.moving_pairs import swaying_pair

TAKE = Source(swaying_pair(48), 20.0, "sway")
SIZES = {"actor_like": {"width": 8, "num_blocks": 1}, "action2motion_like": {"hidden": 6, "latent_size": 3}}
KINDS = pytest.mark.parametrize("kind", [ActorLikeModel, Action2MotionLikeModel], ids=SIZES)
ARCHITECTURES = ("st_gcn_decoders", "without_ends", "whole_motion", "scales_for_a")
SMALL = PaperCvaeConfig(window_s=1.0, width=6, hidden=5, latent_size=3, num_blocks=2, kernel=3)


def _learned(network: WindowNetwork) -> WindowNetwork:
    """Return the network with parameters that somebody might have learned."""
    generator = torch.Generator().manual_seed(5)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0.0, 0.3, generator)
    return network


def _model(kind: type[WindowVae]) -> WindowVae:
    """Return a model that knows B at 0.8, 0.9 and 1.1."""
    scales = np.stack([v.bone_scale[1] for v in uniform_variations([0.8, 0.9, 1.1], ["B"])]).astype(np.float32)
    settings = kind.config_kind.model_validate({"window_s": 1.0} | SIZES[kind.name])
    known = kind.learned_scales(np.concatenate([scales, scales]))
    return kind(settings, known, _learned(kind.build(settings, known)))


def _ask(model: WindowVae, scale: float) -> np.ndarray:
    (variation,) = uniform_variations([scale], ["B"])
    return model.predict(VariantRequest("another", TAKE, variation.bone_scale))


@KINDS
def test_a_scale_is_a_class_and_one_that_was_not_trained_on_is_the_nearest(kind: type[WindowVae]) -> None:
    model = _model(kind)
    assert model.known_scales.shape == (3, 22)
    np.testing.assert_array_equal(_ask(model, 0.75), _ask(model, 0.8))
    np.testing.assert_array_equal(_ask(model, 1.5), _ask(model, 1.1))
    assert np.abs(_ask(model, 0.8) - _ask(model, 0.9)).max() > 1e-3
    drawn = [model.generate(TAKE, np.random.default_rng(seed)) for seed in range(20)]
    assert {float(scale[1, 3].round(3)) for scale, _ in drawn} == {0.8, 0.9, 1.1}
    assert len({float(motion.sum()) for _, motion in drawn}) == 20


@KINDS
def test_a_class_model_answers_any_length_and_refuses_arrays_of_others(kind: type[WindowVae]) -> None:
    model = _model(kind)
    for count in (1, 2, 21, 48):
        source = TAKE.take_frames(slice(0, count))
        request = VariantRequest("short", source, uniform_variations([0.8], ["A"])[0].bone_scale)
        motion = model.predict(request)
        assert motion.shape == source.positions_m.shape
        assert np.isfinite(motion).all()
    with pytest.raises(InputError, match="weights of another topology or size"):
        load_model(describe_model(model), model_arrays(model) | {"known_scales": np.ones((2, 22), np.float32)})
    with pytest.raises(InputError, match="scales, or some that are not positive"):
        load_model(describe_model(model), model_arrays(model) | {"known_scales": np.zeros((3, 22), np.float32)})


@KINDS
def test_motion_that_is_not_a_number_ends_training_and_names_its_take(kind: type[WindowVae]) -> None:
    request = VariantRequest("sway", TAKE, uniform_variations([0.8], ["B"])[0].bone_scale)
    items = [TrainingItem("B", request, np.full_like(TAKE.positions_m, np.nan))]
    settings = kind.config_kind.model_validate({"window_s": 1.0, "num_steps": 2} | SIZES[kind.name])
    with pytest.raises(InputError, match=f"{kind.name}: step 0 .* not finite on takes sway"):
        kind.train(Training(lambda: iter(items), settings=settings))
    settings = settings.model_copy(update={"segment_steps": 1})
    good = [TrainingItem("B", request, TAKE.positions_m)]
    state = kind.train(Training(lambda: iter(good), settings=settings)).state
    with pytest.raises(InputError, match=r"step 1 .* not finite .*; what segment 0 left is kept"):
        kind.train(Training(lambda: iter(items), settings=settings, segment=1, state=state))


def test_the_divergence_of_frames_from_their_prior_is_that_of_normals() -> None:
    found, prior = torch.tensor([[0.3, -1.0, 0.5, -0.2]]), torch.tensor([[0.1, 0.2, -0.3, 0.4]])
    normal, prior_normal = (torch.distributions.Normal(x[:, :2], torch.exp(0.5 * x[:, 2:])) for x in (found, prior))
    wanted = torch.distributions.kl_divergence(normal, prior_normal).sum()
    torch.testing.assert_close(_divergence_between(found, prior), wanted)
    torch.testing.assert_close(_divergence_between(found, torch.zeros(1, 4)), divergence(found))


def _displacement(architecture: str, template: np.ndarray, scale: float = 1.0) -> np.ndarray:
    network = InteractionCvae(SMALL.model_copy(update={"architecture": architecture}))
    condition = np.full((1, 22), scale, np.float32)
    noise = {f"noise_{name}": np.zeros((1, *shape), np.float32) for name, shape in network.noise_shapes(11).items()}
    batch = {"template_m": template[None].astype(np.float32), "condition": condition, **noise}
    return _learned(network).displacement(batch)[0]


def test_other_architectures_do_without_what_they_are_named_for() -> None:
    template = TAKE.positions_m[:22:2]
    moved_b = template + np.array([0.0, 0.1])[:, None, None]  # B elsewhere
    moved = {name: _displacement(name, template) for name in ("published", "scales_for_a", "without_ends")}
    assert np.abs(_displacement("published", moved_b)[:, 0] - moved["published"][:, 0]).max() > 1e-4
    np.testing.assert_array_equal(_displacement("scales_for_a", moved_b)[:, 0], moved["scales_for_a"][:, 0])
    assert np.abs(_displacement("scales_for_a", template, 2.0)[:, 0] - moved["scales_for_a"][:, 0]).max() > 1e-4
    assert np.abs(_displacement("published", moved_b)[:, 1] - moved["published"][:, 1]).max() > 1e-4
    np.testing.assert_array_equal(_displacement("without_ends", moved_b)[:, 1], moved["without_ends"][:, 1])
    # The output is the motion itself, whatever the template between its ends.
    middle = template.copy()
    middle[1:-1] += 0.2
    said = [_displacement("whole_motion", motion) + motion for motion in (template, middle)]
    np.testing.assert_allclose(said[0][:, 1], said[1][:, 1], atol=1e-6)
    # A network that has the time as input can give something else in every frame.
    assert np.ptp(_displacement("st_gcn_decoders", template), axis=0).max() > 1e-3


@pytest.mark.parametrize("architecture", ["published", *ARCHITECTURES])
def test_every_architecture_is_trained_segment_by_segment(architecture: str) -> None:
    settings = SMALL.model_copy(update={"architecture": architecture, "num_steps": 2, "segment_steps": 1})
    request = VariantRequest("sway", TAKE, uniform_variations([0.8], ["B"])[0].bone_scale)
    items = [TrainingItem("B", request, TAKE.positions_m + 0.1)]
    state: Arrays = {}
    for segment in range(2):
        trained = PaperCvaeModel.train(Training(lambda: iter(items), settings=settings, segment=segment, state=state))
        state = trained.state
    loaded = load_model(describe_model(trained.model), model_arrays(trained.model))
    np.testing.assert_array_equal(loaded.predict(request), trained.model.predict(request))


def test_networks_keep_everything_on_the_device_of_their_parameters() -> None:
    frames = 11
    networks = [(_model(ActorLikeModel).network, 3), (_model(Action2MotionLikeModel).network, 3)]
    for architecture in ("published", "st_gcn_decoders"):
        networks.append((InteractionCvae(SMALL.model_copy(update={"architecture": architecture})), 22))
    for network, size in networks:
        shapes = {"template_m": (2, frames, 2, 22, 3), "motion_m": (2, frames, 2, 22, 3), "condition": (2, size)}
        shapes |= {f"noise_{name}": (2, *shape) for name, shape in network.noise_shapes(frames).items()}
        batch = {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}
        assert network.to("meta").loss(batch).device.type == "meta"
    predictor = MotionPredictor(132, np.random.default_rng(0)).to("meta")
    assert predictor.loss({"clips": torch.empty((2, 30, 132), device="meta")}).device.type == "meta"
