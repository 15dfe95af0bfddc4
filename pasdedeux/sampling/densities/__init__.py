"""The densities that chains can sample.  A new one is one file with a `Density`, and one line here."""

from __future__ import annotations

from pasdedeux.sampling.densities.cartesian import CARTESIAN
from pasdedeux.sampling.densities.density import PRIOR_ONLY_DENSITY, Density
from pasdedeux.sampling.densities.interaction import INTERACTION
from pasdedeux.sampling.densities.shape_context import SHAPE_CONTEXT

DENSITIES: dict[str, Density] = {
    density.name: density for density in (INTERACTION, CARTESIAN, SHAPE_CONTEXT, PRIOR_ONLY_DENSITY)
}
"""The densities by their names in `chains.densities`."""
