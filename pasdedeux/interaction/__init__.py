"""Interaction of two people: interaction coordinates in 2D and 3D, dissimilarities, contacts."""

from pasdedeux.interaction.dissimilarity import (
    BETA_M,
    align_plane,
    cartesian_dissimilarity,
    edge_vectors,
    edge_weights,
    interaction_dissimilarity,
    plane_residual,
)
from pasdedeux.interaction.graph import delaunay_edges
from pasdedeux.interaction.kernels import EdgeTable, edge_table, edge_table_3d
from pasdedeux.interaction.shape_context import ShapeCoverage
from pasdedeux.interaction.surfaces import closest_joint_distance

__all__ = [
    "BETA_M",
    "EdgeTable",
    "ShapeCoverage",
    "align_plane",
    "cartesian_dissimilarity",
    "closest_joint_distance",
    "delaunay_edges",
    "edge_table",
    "edge_table_3d",
    "edge_vectors",
    "edge_weights",
    "interaction_dissimilarity",
    "plane_residual",
]
