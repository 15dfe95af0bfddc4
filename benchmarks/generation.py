"""The published network compared with the interaction mesh, for one motion (Li et al. 2024, section 5.3)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.benchmark import BenchmarkResult, measure_rate
from pasdedeux.augmentation import Augmenter, Source
from pasdedeux.augmentation.variations import uniform_variations
from pasdedeux.choreography.duets import make_duet
from pasdedeux.learning.sampling import sample_motion
from pasdedeux.learning.settings import PaperCvaeConfig, has_torch
from pasdedeux.learning.window_vae import PaperCvaeModel
from pasdedeux.skeletons import BODY22

_DURATION_S, _RATE_HZ = 4.0, 30.0
_SCALE = 0.9
_PUBLISHED_S = 0.323, 120.0
"""Seconds of network and of interaction mesh for one motion, from the paper."""


def _model() -> BenchmarkResult:
    """Measure motions per second of the network, before clean-up, and of the solver with its mesh, one at a time."""
    from pasdedeux.learning.networks.interaction_cvae import InteractionCvae  # torch
    from pasdedeux.learning.networks.layers import initialise

    duet = make_duet("waltz", duration_s=_DURATION_S, rate_hz=_RATE_HZ)
    source = Source(duet.positions_m(), _RATE_HZ, "waltz")
    # What the network learned does not change how long it takes.
    known = np.stack([np.ones(BODY22.num_joints), np.full(BODY22.num_joints, 0.1)]).astype(np.float32)
    network, generator = InteractionCvae(PaperCvaeConfig()), np.random.default_rng(0)
    initialise(network, generator)
    model = PaperCvaeModel(PaperCvaeConfig(), known, network)
    (variation,) = uniform_variations([_SCALE], ("B",))
    scale = np.full(BODY22.num_joints, _SCALE)
    fast = measure_rate("published network", lambda: sample_motion(model, source, generator, scale=scale))
    plain = measure_rate("interaction mesh", lambda: Augmenter(source).solve([variation]), repeats=1)
    both = (1.0 / fast.per_s, 1.0 / plain.per_s), _PUBLISHED_S
    ours, theirs = (f"{first:.3g} s against {other:.3g} s" for first, other in both)
    size = f"{_DURATION_S:g} s of 2 x {BODY22.num_joints} joints at {_RATE_HZ:g} Hz"
    note = f"a motion takes {ours} ({size}); as published {theirs}"
    return BenchmarkResult("generation: one motion", "motions", *fast, *plain, note)


BENCHMARKS: dict[str, Callable[[], BenchmarkResult]] = {"model": _model} if has_torch() else {}
