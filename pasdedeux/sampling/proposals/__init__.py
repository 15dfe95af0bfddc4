"""Proposals: where a chain looks next.  A new kind is one file with a `ProposalKind`, and one line here."""

from typing import Any

from pasdedeux.sampling.proposals.blocks import GaussianBlocks, StepSettings, UnbiasedKind
from pasdedeux.sampling.proposals.proposal import (
    Context,
    Correction,
    Proposal,
    ProposalInputs,
    ProposalKind,
    Proposed,
    Scales,
)
from pasdedeux.sampling.proposals.velocity import VelocityBlocks, VelocityKind, VelocitySettings

__all__ = [
    "PROPOSALS",
    "Context",
    "Correction",
    "GaussianBlocks",
    "Proposal",
    "ProposalInputs",
    "ProposalKind",
    "Proposed",
    "Scales",
    "StepSettings",
    "VelocityBlocks",
    "VelocitySettings",
]

PROPOSALS: dict[str, ProposalKind[Any]] = {
    kind.name: kind
    for kind in (
        UnbiasedKind(),
        VelocityKind(),
    )
}
"""The kinds that a study may choose by `chains.proposal`; the first is the default, and samples where others cannot."""
