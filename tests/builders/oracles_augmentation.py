"""The energy of variants as its formulas are written, term by term, beside which the added-up matrix is checked."""

import numpy as np

from pasdedeux.augmentation import weights as w
from pasdedeux.augmentation.problem import MeshProblem, Targets, girdle_pairs
from pasdedeux.augmentation.terms import bending_rows


def plain_residuals(problem: MeshProblem, targets: Targets, offsets: np.ndarray) -> np.ndarray:
    """Return all residuals of one variant at offsets (T, 44, 3); the energy is the sum of their squares."""
    apart = offsets - targets.difference[0]
    mesh, contacts, direction = problem.mesh, problem.contacts, w.CONTACT_DIRECTION
    frames = np.arange(len(offsets))[:, None, None]
    vectors = (contacts.shares[..., None] * (targets.reference[0] + offsets)[frames, contacts.points]).sum(axis=2)
    missed = vectors - targets.contact_m[0]
    stretched = np.linalg.norm(vectors, axis=-1) - np.linalg.norm(targets.contact_m[0], axis=-1)
    parts = [
        np.sqrt(w.LAPLACIAN) * (mesh.laplacian @ offsets - mesh.cross_laplacian @ targets.difference[0]),
        np.sqrt(problem.smoothness) * np.diff(offsets, n=2, axis=0),
        np.sqrt(w.REFERENCE) * offsets,
        np.sqrt(w.BENDING) * (bending_rows(problem.source) @ offsets),
        np.sqrt(problem.floor) * (offsets[..., 1] - targets.height[0]),
        np.sqrt(problem.stance)[..., None] * np.diff(apart, axis=0)[..., [0, 2]],
        np.sqrt(direction * problem.contact_weights)[..., None] * missed,
        np.sqrt((1.0 - direction) * problem.contact_weights) * stretched,
    ]
    near = problem.clearance
    for t in range(len(offsets)):
        between = (near.shares[t][..., None] * offsets[t, near.points[t]]).sum(axis=1)
        short = targets.clearance_m[0, t] - (between * near.normals[t]).sum(axis=-1)
        parts.append(np.sqrt(near.weights[t]) * np.maximum(short, 0.0))
    ends = (targets.reference[0] + offsets)[:, girdle_pairs(problem.source.num_people)]
    girdle = np.linalg.norm(ends[..., 0, :] - ends[..., 1, :], axis=-1) - targets.girdle_m[0]
    return np.concatenate([*(part.ravel() for part in parts), np.sqrt(w.GIRDLE) * girdle.ravel()])
