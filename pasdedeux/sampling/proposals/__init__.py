"""Proposals of steps of a chain. A new one is one file with a `ProposalKind`, and one line here."""

from pasdedeux.sampling.proposals.blocks import UNBIASED
from pasdedeux.sampling.proposals.proposal import ProposalKind
from pasdedeux.sampling.proposals.velocity import VELOCITY

PROPOSALS: dict[str, ProposalKind] = {kind.name: kind for kind in (UNBIASED, VELOCITY)}
"""The kinds that a study may choose by `chains.proposal`; the first is the default, and the fallback of others."""
