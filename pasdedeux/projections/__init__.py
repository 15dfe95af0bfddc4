"""Projections: proportions retargeted, the database of poses seen from all around, and its search."""
