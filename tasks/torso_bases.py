"""The torso basis that a stage lifts torsos with: from prior takes, or a default that has not seen what is lifted."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pasdedeux.cameras.torso import TorsoBasis
from pasdedeux.cameras.torso_proportions import proportions_torso_basis
from pasdedeux.choreography import duet_torso_basis
from storage_schema import ArtifactRef, Manifest, Store
from tasks.facts import SequenceFacts, TakeFacts, facts_of

BUILT_IN_DUETS = "built-in duets"
BODY_PROPORTIONS = "body proportions"


def default_origin(shown: Iterable[Manifest]) -> str:
    """Return what the default basis is learned from: the built-in duets, where these artifacts show none of them.

    On the duets themselves it comes from body proportions alone, so that nothing is evaluated on what it was learned
    from.
    """
    return (
        BODY_PROPORTIONS
        if any(facts.is_built_in for one in shown if isinstance(facts := facts_of(one), TakeFacts | SequenceFacts))
        else BUILT_IN_DUETS
    )


def default_torso_basis(origin: str) -> TorsoBasis:
    """Return the torso basis of studies that name no prior takes, learned from what `default_origin` gave."""
    make = duet_torso_basis if origin == BUILT_IN_DUETS else proportions_torso_basis
    return make()


def read_torso_basis(store: Store, refs: Iterable[ArtifactRef]) -> TorsoBasis:
    """Return the torso basis among these artifacts; the default for what they show where there is none."""
    manifests = [store.manifest(ref) for ref in refs]
    for manifest in manifests:
        if "torso_basis" in manifest.tables:
            table = store.read(manifest.ref, "torso_basis")
            return TorsoBasis(
                mean_m=np.asarray(table["torso_m"][0]),
                components_m=np.asarray(table["torso_m"][1:]),
                standard_deviation_m=np.asarray(table["standard_deviation_m"][1:]),
                explained_variance=np.asarray(table["explained_variance"][1:]),
            )
    return default_torso_basis(default_origin(manifests))
