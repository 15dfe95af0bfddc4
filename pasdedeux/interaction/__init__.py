"""Interaction of two people: interaction coordinates in 2D and 3D, dissimilarities, contacts."""
