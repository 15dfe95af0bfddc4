"""Projections: retargeting of proportions, the database of poses seen from all sides, and its search."""
