"""Cameras: pinhole and weak-perspective projection, virtual video, views of a pair and their density."""
