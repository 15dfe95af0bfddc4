"""Networks of windows learn a few variants by heart, and layers that died are found."""

from collections.abc import Iterator
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import nn

from pasdedeux.augmentation import Augmenter, Source
from pasdedeux.augmentation.variations import group_variations
from pasdedeux.choreography.duets import make_duet
from pasdedeux.learning.model import ACTIVITY, LogEntry, Trained, TrainingItem, VariantRequest
from pasdedeux.learning.networks.layers import activity
from pasdedeux.learning.networks.training import train_segment
from pasdedeux.learning.settings import SegmentSettings
from pasdedeux.learning.window_vae import Action2MotionLikeModel, ActorLikeModel, PaperCvaeModel, WindowVae
from pasdedeux.learning.windows import Window, gather_windows
from pasdedeux.verdict import Level
from tasks.training.run import _judge

SIZES = {"width": 16, "hidden": 32, "latent_size": 8, "num_blocks": 1, "kernel": 3, "balance": "free_bits"}
KINDS: dict[str, tuple[type[WindowVae], dict[str, Any], int]] = {
    "published": (PaperCvaeModel, SIZES, 100),
    "ours": (PaperCvaeModel, {"architecture": "over_kinematics", "learning_rate": 0.008, **SIZES}, 220),
    "actor": (ActorLikeModel, {"learning_rate": 0.01}, 400),
    "action2motion": (Action2MotionLikeModel, {}, 130),
}
"""A kind, small, and how many steps it takes to learn 8 variants of a window by heart."""


@cache
def window() -> Window:
    """Return a window of 1 s of a duet, with 8 variants of B."""
    take = Source(make_duet("judo", duration_s=1.0, rate_hz=10.0).positions_m(), 10.0, "judo")
    variations = group_variations([0.75, 0.85, 1.15, 1.25], ["B"], ["arms", "legs"])
    items = [
        TrainingItem(v.variation.variant_id, VariantRequest("judo", take, v.bone_scale), v.positions_m)
        for v in Augmenter(take).solve(variations)
    ]
    return gather_windows(lambda: iter(items), 11)[0]


def model_of(name: str, **changes: Any) -> WindowVae:
    kind, settings, num_steps = KINDS[name]
    options = kind.config_kind.model_validate(
        {**settings, "num_steps": num_steps, "segment_steps": num_steps, **changes}
    )
    known = kind.learned_scales(window().bone_scale)
    return kind(options, known, kind.build(options, known))


def train(
    model: WindowVae, errors: Iterator[float] | None = None, **segment: Any
) -> tuple[list[LogEntry], dict[str, Any]]:
    """Train one segment on the variants; validation gives these errors, one after the other."""
    generator = np.random.default_rng(0)

    def draw() -> tuple[dict[str, Any], str]:
        return batch_of(model) | model._noise(8, 11, generator), "the window"

    def validate() -> dict[str, float]:
        return {} if errors is None else {"validation_error_cm": next(errors)}

    more: dict[str, Any] = {"segment": 0, "state": {}, **segment}
    return train_segment(model.name, model.network, model.options, draw, validate, generator=generator, **more)


def batch_of(model: WindowVae) -> dict[str, Any]:
    """Return the variants, z = 0."""
    return model.batch([window()] * 8, list(range(8))) | model._noise(8, 11, None)


@pytest.mark.parametrize("name", KINDS)
def test_a_network_learns_variants_by_heart_and_all_of_its_layers_stay_active(name: str) -> None:
    model = model_of(name)
    log, _ = train(model)
    batch = batch_of(model)
    wanted = batch["motion_m"] - batch["template_m"]
    moved = model.network.displacement(batch, is_posterior=name == "actor")  # of its z = 0 says little
    copied, error = (100.0 * np.linalg.norm(found, axis=-1).mean((0, 1, 3)) for found in (wanted, moved - wanted))
    assert (100.0 * moved.std(0).mean((0, 2, 3)) > 0.1).all()
    active = [entry.value for entry in log if entry.quantity.startswith(ACTIVITY)]
    assert len(active) > 0
    assert min(active) > 1.0
    # A of the published network sees B's motion but not its change, and needs far longer.
    assert (error < (copied if name == "published" else 0.6)).all()
    assert (copied > 2.5).all()


def test_a_layer_that_died_is_found_and_fails_the_verdict_of_the_training() -> None:
    model = model_of("published", num_steps=1)
    train(model)
    batch = {key: torch.tensor(values) for key, values in batch_of(model).items()}
    assert min(activity(model.network, batch).values()) > 1.0
    layer = cast(nn.Linear, model.network.get_submodule("g_gru2.out.0"))
    nn.init.constant_(layer.bias, -1e3)
    found = activity(model.network, batch)
    assert [name for name, value in found.items() if value < 1.0] == ["g_gru2.out.1"]
    log = [LogEntry(1, f"{ACTIVITY}{name}", value) for name, value in found.items()]
    verdict = _judge("net", Trained(model, log), lambda: iter(()))
    assert (verdict.level, "g_gru2.out.1 0 %" in verdict.reason) == (Level.FAIL, True)
    alive = _judge("net", Trained(model, [entry for entry in log if entry.value > 1.0]), lambda: iter(()))
    assert alive.level is Level.WARN


@pytest.mark.parametrize(
    ("num_steps", "patience", "expected"), [(600, None, 4), (1_600, None, 4), (3_200, None, 6), (3_200, 2, 2)]
)
def test_longer_trainings_wait_longer(num_steps: int, patience: int | None, expected: int) -> None:
    settings = SegmentSettings(num_steps=num_steps, segment_steps=200, patience=patience)
    assert settings.patience_of_length == expected


def test_training_ends_where_validation_falls_no_more_and_leaves_the_best_parameters() -> None:
    model = model_of("action2motion", num_steps=6, segment_steps=1, patience=2)
    errors = iter([3.0, 2.0, 2.5, 2.0, 1.0, 0.5])
    state: dict[str, Any] = {}
    stops = []
    for segment in range(6):
        log, state = train(model, errors, segment=segment, state=state)
        stops.append("train_loss" not in {entry.quantity for entry in log})
        if segment == 1:
            best = {key: values.clone() for key, values in model.network.state_dict().items()}
    assert stops == [False, False, False, False, True, True]
    assert next(errors) == 1.0
    assert all(torch.equal(values, best[key]) for key, values in model.network.state_dict().items())
