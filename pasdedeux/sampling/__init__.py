"""Lifting by sampling: the density of 3D pairs given 2D annotations, and the chains that sample it."""
