"""The published conditional VAE: equivariance, losses as printed, and refused input."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from pasdedeux.augmentation import Source, uniform_variations
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.mesh_refine import MeshRefineModel
from pasdedeux.learning.meter import ModelMeter
from pasdedeux.learning.model import Trained, Training, TrainingItem, VariantRequest
from pasdedeux.learning.networks.interaction_cvae import InteractionCvae
from pasdedeux.learning.networks.layers import _graph, draw_latent
from pasdedeux.learning.registry import MODELS, ModelDescription, describe_model, load_model, model_arrays
from pasdedeux.learning.ridge_scale import RidgeScaleModel
from pasdedeux.learning.window_vae import PaperCvaeModel
from pasdedeux.learning.windows import blend_windows, cut_windows, sampled_frames
from pasdedeux.skeletons import BODY22
from tests.builders.moving_pairs import swaying_pair

TAKE = Source(swaying_pair(48), 20.0, "sway")
SMALL = PaperCvaeModel.config_kind(window_s=1.0, width=6, hidden=5, latent_size=3, num_blocks=2, kernel=3)
SCALED_A, SCALED_B, BOTH = (v.bone_scale for v in uniform_variations([0.8], ["A", "B", "AB"]))


def _model(seed: int = 5) -> PaperCvaeModel:
    """Return a model with weights that somebody might have learned."""
    network, generator = InteractionCvae(SMALL), torch.Generator().manual_seed(seed)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0.0, 0.1, generator)
    return PaperCvaeModel(SMALL, np.stack([np.ones(22), np.full(22, 0.1)]).astype(np.float32), network)


def _ask(source: Source, scale: np.ndarray) -> np.ndarray:
    return np.asarray(_model().predict(VariantRequest("another", source, scale)))


def test_a_turned_or_swapped_pair_is_answered_by_the_turned_or_swapped_motion() -> None:
    plain, source = _ask(TAKE, SCALED_A), TAKE.positions_m
    assert np.abs(plain - source).max() > 0.01
    turn = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]])
    turned = replace(TAKE, positions_m=source @ turn.T + (3.0, 0.0, -2.0))
    np.testing.assert_allclose(_ask(turned, SCALED_A), plain @ turn.T + (3.0, 0.0, -2.0), atol=1e-4)
    swapped = replace(TAKE, positions_m=np.ascontiguousarray(source[:, ::-1]))
    np.testing.assert_allclose(_ask(swapped, SCALED_A[::-1]), plain[:, ::-1], atol=1e-12)


def test_where_both_are_scaled_what_it_says_of_either_is_added() -> None:
    moved = [_ask(TAKE, scale) - TAKE.positions_m for scale in (SCALED_A, SCALED_B, BOTH)]
    np.testing.assert_allclose(moved[0] + moved[1], moved[2], atol=1e-12)


def test_takes_shorter_than_a_window_or_a_little_longer_are_answered_smoothly() -> None:
    for count in (1, 2, 19, 21, 23, 48):
        motion = _ask(TAKE.take_frames(slice(0, count)), SCALED_B)
        assert motion.shape == (count, 2, 22, 3)
        assert np.isfinite(motion).all()
    moved = motion - TAKE.positions_m
    # Where one window ends another goes on: no frame moves further from the one before than ten times the median.
    step = np.linalg.norm(np.diff(moved, axis=0), axis=-1).mean(axis=(1, 2))
    assert step.max() < 10.0 * np.median(step)


def test_losses_are_those_of_the_paper() -> None:
    generator = torch.Generator().manual_seed(0)
    true, found = torch.randn(2, 3, 4, 22, 3, generator=generator)
    lengths = [
        torch.stack([(m[..., child, :] - m[..., parent, :]).norm(dim=-1) for parent, child in BODY22.bones], -1)
        for m in (found, true)
    ]
    speeds = [motion[:, 1:] - motion[:, :-1] for motion in (found, true)]
    terms = (found - true).abs(), (speeds[0] - speeds[1]).abs(), (lengths[0] - lengths[1]) ** 2
    for balance, reduced in (("summed", lambda x: x.sum() / len(true)), ("averaged", torch.mean)):
        wanted = 0.75 * reduced(terms[0]) + 0.1 * reduced(terms[1]) + 0.05 * reduced(terms[2])
        cvae = InteractionCvae(SMALL.model_copy(update={"balance": balance}))
        torch.testing.assert_close(cvae._motion_loss(found, true), wanted)


def test_a_latent_is_drawn_from_its_normal() -> None:
    drawn = draw_latent(torch.tensor([[0.3, -1.0, 0.5, -0.2]]), torch.ones(1, 2))
    torch.testing.assert_close(drawn, torch.tensor([[0.3, -1.0]]) + torch.exp(torch.tensor([[0.25, -0.1]])))


def test_with_free_bits_an_axis_that_says_little_costs_the_same_and_one_that_says_much_its_divergence() -> None:
    cvae = InteractionCvae(SMALL.model_copy(update={"balance": "free_bits"}))
    little, none, much = (torch.tensor([[mean, 0.0, 0.0, 0.0]]) for mean in (0.4, 0.0, 2.0))
    torch.testing.assert_close(cvae._divergence(little), cvae._divergence(none))
    torch.testing.assert_close(cvae._divergence(much) - cvae._divergence(none), torch.tensor((2.0 - 0.1) / 2))


def test_a_generated_pair_has_scales_of_its_own_and_the_same_seed_gives_the_same() -> None:
    (scale, motion), again, another = (_model().generate(TAKE, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(motion, again[1])
    assert np.abs(motion - another[1]).max() > 1e-4
    assert scale.shape == (2, 22)
    assert scale.min() > 0.0
    assert (scale[0] == 1.0).all()
    assert scale[1].std() > 0.0


def test_motions_that_are_drawn_are_judged_by_the_bones_drawn_beside_baselines_at_the_same_scales() -> None:
    meter = ModelMeter(VariantRequest("sway", TAKE, SCALED_B))
    baselines = {"copy": MODELS["copy"](), "naive_fk": MODELS["naive_fk"](), "ridge_scale": RidgeScaleModel()}
    models = {"cvae": _model(), "mesh": MeshRefineModel(baselines["copy"], 0), **baselines}
    found = meter.measure_generated(models, lambda name: np.random.default_rng(0))
    assert set(found) == {"cvae", *baselines}
    more = meter.measure_generated({"a": _model(4), **models}, lambda name: np.random.default_rng(len(name)))
    alone = meter.measure_generated(models, lambda name: np.random.default_rng(len(name)))
    assert more["cvae"] == alone["cvae"] != more["a"]
    assert found["naive_fk"]["E_b"] < 1e-6 < 1.0 < found["copy"]["E_b"]
    assert found["copy"]["JPD"] == 0.0 or np.isnan(found["copy"]["JPD"])
    scale, motion = _model().generate(TAKE, np.random.default_rng(0))
    wanted = np.abs(bone_lengths(BODY22, motion) - scale * bone_lengths(BODY22, TAKE.positions_m))
    assert found["cvae"]["E_b"] == pytest.approx(1000.0 * wanted[..., 1:].mean())
    assert meter.measure_generated(baselines, lambda name: np.random.default_rng(0)) == {}


def test_variants_of_both_are_not_learned_from_and_weights_of_another_size_are_refused() -> None:
    both = [TrainingItem("AB", VariantRequest("sway", TAKE, BOTH), TAKE.positions_m)]
    with pytest.raises(InputError, match="no variant of one scaled person"):
        PaperCvaeModel.train(Training(lambda: iter(both), settings=SMALL))
    arrays, description = model_arrays(_model()), describe_model(_model())
    with pytest.raises(InputError, match=r"'st_gcn1.blocks.0.mix.edges' has shape \(18, 18\), not \(22, 22\)"):
        load_model(description, {**arrays, "st_gcn1.blocks.0.mix.edges": np.ones((18, 18), np.float32)})
    for change in ({"width": 10**9}, {"architecture": "another"}, {"height": 3}):
        changed = ModelDescription(model="paper_cvae", config={**description.config, **change})
        with pytest.raises(InputError, match=f"its settings do not fit: {next(iter(change))}: "):
            load_model(changed, arrays)
    with pytest.raises(ValueError, match="is even"):
        PaperCvaeModel.config_kind.model_validate({"kernel": 4})


@pytest.mark.parametrize("num_frames", [1, 2, 30, 605])
def test_frames_between_the_sampled_ones_are_on_a_cubic_spline(num_frames: int) -> None:
    source = Source(swaying_pair(num_frames), 30.0, "sway")
    frames = sampled_frames(source)
    (window,) = cut_windows(source, "", 1, len(frames))
    values = np.random.default_rng(0).standard_normal(window.template_m.shape).astype(np.float32)
    in_world = values.astype(np.float64) @ window.axes.T
    wanted = CubicSpline(frames, in_world)(np.arange(num_frames)) if num_frames > 1 else in_world
    np.testing.assert_allclose(blend_windows(source, [window], iter([values])), wanted, atol=1e-12)


def test_a_gpu_that_runs_out_of_memory_is_said_and_what_was_trained_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    items = [TrainingItem("b", VariantRequest("sway", TAKE, SCALED_B), TAKE.positions_m)]
    settings = PaperCvaeModel.settings(num_steps=2, segment_steps=1)

    def train(segment: int, **more: Any) -> Trained:
        return PaperCvaeModel.train(Training(lambda: iter(items), settings=settings, segment=segment, **more))

    first = train(0)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match=r"paper_cvae: training\.device is cuda, and torch finds no GPU here"):
        train(0, device="cuda")

    def full(*_: object) -> None:
        raise torch.cuda.OutOfMemoryError

    monkeypatch.setattr(InteractionCvae, "loss", full)
    with pytest.raises(InputError, match=r"too little free memory .*; what segment 0 left is kept; .*device=c"):
        train(1, state=first.state)


def test_the_graph_of_a_skeleton_is_symmetric_and_keeps_the_roots_of_the_numbers_of_neighbours() -> None:
    """D^-1/2 (A + 1) D^-1/2 of Kipf and Welling 2017 has the eigenvector sqrt(D) with eigenvalue 1, and none above."""
    graph = _graph(BODY22).double().numpy()
    root = np.sqrt([1.0 + len(BODY22.children(joint)) + (joint != BODY22.root) for joint in range(BODY22.num_joints)])
    np.testing.assert_array_equal(graph, graph.T)
    np.testing.assert_allclose(graph @ root, root, rtol=1e-6)
    assert np.linalg.eigvalsh(graph).max() < 1.0 + 1e-6
