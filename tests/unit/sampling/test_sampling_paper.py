"""The studies of lifting by sampling use the published settings, and the same ones on both sources."""

from __future__ import annotations

import tomllib
from typing import Any

from flows.study_files import shipped_studies
from pasdedeux.sampling.densities.annotated import Pooling
from tasks.chains import ChainsParameters

COUNTS = {"num_draws", "segment_draws"}


def chains_of(study: str) -> dict[str, Any]:
    return dict(tomllib.loads(shipped_studies()[study])["chains"])


def test_the_published_target_and_steps_stand_together() -> None:
    section = ChainsParameters.model_validate(chains_of("sampling_paper"))
    published = section.named()["ic"]
    found = (published.sigma_l, published.pooling, published.truncation, published.proposal)  # type: ignore[attr-defined]
    assert found == (0.01, Pooling.MEAN, 100.0, "velocity")
    default = ChainsParameters()
    ours = section.named()["our_default"]
    for name in ("sigma_l", "pooling", "truncation", "proposal"):
        assert getattr(ours, name) == getattr(default, name)


def test_both_studies_differ_in_the_number_of_draws_alone() -> None:
    def rest(section: dict[str, Any]) -> dict[str, Any]:
        return {
            name: rest(value) if isinstance(value, dict) else value
            for name, value in section.items()
            if name not in COUNTS
        }

    assert rest(chains_of("sampling_paper")) == rest(chains_of("sampling_paper_duets"))
