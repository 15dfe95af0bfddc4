"""The densities that chains can sample: what each reads, and its likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.sampling import AnnotatedPairs, InteractionLikelihood, ViewBank
from pasdedeux.sampling.agreement import Agreement
from pasdedeux.sampling.measured_likelihood import ImageMeasure, MeasuredLikelihood
from storage_schema import Manifest, Store
from tasks.stage import Shard, StageInputs

__all__ = ["IMAGE_DENSITIES", "DensityName", "agreement_of", "density_inputs", "image_likelihood"]

DensityName = Literal["ic", "cartesian", "shape_context", "agreement", "prior_only"]

IMAGE_DENSITIES = ("ic", "cartesian", "shape_context")
"""Densities that compare images of a pair with annotations; the dissimilarity is what differs."""


def density_inputs(density: str, inputs: StageInputs, seen: Sequence[Manifest]) -> list[Manifest] | None:
    """Return what a density reads beside seeds and joint limits, None where a study has not got it.

    Args:
        density: Its name.
        inputs: Everything the stage may read.
        seen: Annotations and their views; none where there are not both.
    """
    if density in IMAGE_DENSITIES:
        return list(seen) or None
    if density == "agreement":
        return [manifest for manifest in inputs.of("seeds") if manifest.facts["kind"] == "grown_seeds"] or None
    return []


def image_likelihood(
    density: str, pairs: AnnotatedPairs, bank: ViewBank, options: dict[str, Any]
) -> InteractionLikelihood | MeasuredLikelihood:
    """Return the likelihood of a density that compares images."""
    if density == "ic":
        return InteractionLikelihood(pairs, bank, sigma_l=options["sigma_l"], beta_m=options["beta_m"])
    return MeasuredLikelihood(
        pairs, bank, ImageMeasure(density), sigma_l=options["sigma_l"], num_ranked=options["num_ranked"]
    )


def agreement_of(shard: Shard, store: Store, pair_m: np.ndarray) -> Agreement:
    """Return agreement with the grown seeds among a shard's inputs that are posed most like a pair (2, 17, 3).

    Raises:
        InputError: Nothing has grown.
    """
    parts = [
        np.asarray(store.read(ref, "seeds", columns=["pair17_m"])["pair17_m"], dtype=np.float64)
        for ref in shard.inputs
        if store.manifest(ref).facts.get("kind") == "grown_seeds"
    ]
    grown = np.concatenate([np.zeros((0, 2, 17, 3)), *parts])
    if not len(grown):
        raise InputError("the density 'agreement' needs grown seeds, and none has grown (seeds.num_grown)")
    return Agreement(grown, near_m=pair_m)
