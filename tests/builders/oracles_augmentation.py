"""The energy of variants as its formulas are written, term by term, beside which the added-up matrix is checked."""

import numpy as np

from pasdedeux.augmentation.contacts import added_by_girth, contact_class
from pasdedeux.augmentation.problem import GIRDLE_PAIRS, Problem, Targets
from pasdedeux.augmentation.terms import bending_rows
from pasdedeux.interaction.contacts import joint_pair_distances


def plain_residuals(problem: Problem, targets: Targets, offsets: np.ndarray) -> np.ndarray:
    """Return all residuals of one variant at offsets (T, 44, 3); the energy is the sum of their squares."""
    apart = offsets - targets.difference[0]
    w, mesh, source = problem.weights, problem.mesh, problem.source.positions_m
    pair = (targets.reference[0] + offsets).reshape(-1, 2, 22, 3)
    added = added_by_girth(problem.source, problem.settings.girth)
    vectors, distances = source[:, 0, :, None] - source[:, 1, None], joint_pair_distances(source)
    moved = apart[:, :22, None] - apart[:, None, 22:] - vectors * (added / np.maximum(distances, 1e-9))[..., None]
    stretched = joint_pair_distances(pair) - np.maximum(distances + added, 0.0)
    turning = (1.0 - w.contact_direction) * problem.contact
    parts = [
        np.sqrt(w.laplacian) * (mesh.laplacian @ offsets - mesh.cross_laplacian @ targets.difference[0]),
        np.sqrt(problem.smoothness) * np.diff(offsets, n=2, axis=0),
        np.sqrt(w.reference) * offsets,
        np.sqrt(w.bending) * (bending_rows(problem.source) @ offsets),
        np.sqrt(problem.floor) * (offsets[..., 1] - targets.height[0]),
        np.sqrt(problem.stance)[..., None] * np.diff(apart, axis=0)[..., [0, 2]],
        np.sqrt(w.contact_direction * problem.contact)[..., None] * moved,
        (np.sqrt(turning) * (contact_class() == 2))[..., None] * moved,
        np.sqrt(turning) * (contact_class() < 2) * stretched,
    ]
    near = problem.clearance
    for t in range(len(offsets)):
        between = (near.shares[t][..., None] * offsets[t, near.points[t]]).sum(axis=1)
        short = targets.clearance_m[0, t] - (between * near.normals[t]).sum(axis=-1)
        parts.append(np.sqrt(near.weights[t]) * np.maximum(short, 0.0))
    ends = (targets.reference[0] + offsets)[:, GIRDLE_PAIRS]
    girdle = np.linalg.norm(ends[..., 0, :] - ends[..., 1, :], axis=-1) - targets.girdle_m[0]
    return np.concatenate([*(part.ravel() for part in parts), np.sqrt(w.girdle) * girdle.ravel()])
