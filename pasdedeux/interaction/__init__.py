"""Interaction of two people: interaction coordinates in 2D and 3D, dissimilarities, contacts."""

from pasdedeux.interaction.contacts import Contacts, closest_joint_pairs, gap_m, joint_pair_distances
from pasdedeux.interaction.dissimilarity import (
    BETA_M,
    align_plane,
    cartesian_dissimilarity,
    edge_vectors,
    edge_weights,
    interaction_dissimilarity,
    plane_residual,
)
from pasdedeux.interaction.graph import Graph, delaunay_edges, graph_edges
from pasdedeux.interaction.kernels import EdgeTable, edge_table, edge_table_3d
from pasdedeux.interaction.shape_context import ShapeCoverage, pair_shape_dissimilarity, plane_shape_dissimilarity

__all__ = [
    "BETA_M",
    "Contacts",
    "EdgeTable",
    "Graph",
    "ShapeCoverage",
    "align_plane",
    "cartesian_dissimilarity",
    "closest_joint_pairs",
    "delaunay_edges",
    "edge_table",
    "edge_table_3d",
    "edge_vectors",
    "edge_weights",
    "gap_m",
    "graph_edges",
    "interaction_dissimilarity",
    "joint_pair_distances",
    "pair_shape_dissimilarity",
    "plane_residual",
    "plane_shape_dissimilarity",
]
