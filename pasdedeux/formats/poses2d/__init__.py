"""Formats of 2D keypoints and annotations, and the cameras of a video."""
