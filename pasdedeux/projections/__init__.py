"""Projections: retarget, database, exact search, choice over time, smoothing, reconstruction of a track."""
