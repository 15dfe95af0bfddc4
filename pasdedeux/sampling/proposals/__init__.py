"""Proposals: where a chain looks next.  A new kind is one file with a `ProposalKind`, and one line here."""

from pasdedeux.sampling.proposals.blocks import GaussianBlocks, Steps, UnbiasedKind
from pasdedeux.sampling.proposals.proposal import (
    Context,
    Correction,
    Proposal,
    ProposalInputs,
    ProposalKind,
    Proposed,
    Scales,
)
from pasdedeux.sampling.proposals.velocity import VelocityBlocks, VelocityKind

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
    "Steps",
    "VelocityBlocks",
]

PROPOSALS: dict[str, ProposalKind] = {
    kind.name: kind
    for kind in (
        UnbiasedKind(),
        VelocityKind(),
    )
}
"""The kinds that a study may choose by `chains.proposal`; the first is the default, and samples where others cannot."""
