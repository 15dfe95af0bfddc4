"""The densities that chains can sample.  A new one is one file with a `DensityKind`, and one line here."""

from __future__ import annotations

from typing import Any

from pasdedeux.sampling.density import DensityKind, PriorOnlyKind
from pasdedeux.sampling.likelihood import InteractionKind

DENSITIES: dict[str, DensityKind[Any]] = {kind.name: kind for kind in (InteractionKind(), PriorOnlyKind())}
"""The densities by their names in `chains.densities`."""
