"""Skinned bodies: a watertight mesh around a skeleton, made from the radii of its capsules."""

from pasdedeux.bodies.body import Body, body_of, standing_motion, standing_rest_m

__all__ = ["Body", "body_of", "standing_motion", "standing_rest_m"]
