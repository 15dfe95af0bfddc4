"""Lifting by sampling: the density of 3D pairs given 2D annotations, chains that sample it, and how well they cover."""
