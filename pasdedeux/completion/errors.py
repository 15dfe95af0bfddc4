"""Errors of lifted pairs, completed joints and in-betweens against the ground truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.completion.in_betweens import fill_between, straight_between
from pasdedeux.completion.neighbours import nearest_rigid
from pasdedeux.completion.occlusion import NUM_NEAREST, blend_onto, complete_pair
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity
from pasdedeux.kinematics import align_rigid
from pasdedeux.skeletons import PAIR17

HIDDEN = {
    "arm": PAIR17.arms,
    "leg": tuple(leg[1:] for leg in PAIR17.legs),
    "limbs": ([joint for side in zip(PAIR17.arms, PAIR17.legs, strict=True) for limb in side for joint in limb[1:]],),
}
"""Hidden joints of one person: an arm, a leg, or everything beyond shoulders and hips."""

_ROOT = PAIR17.root


def lifted_errors(lifted_m: Array, truth_m: Array) -> dict[str, Array]:
    """Return errors (n,), metres, of lifted pairs (n, person=2, joint=17, 3) against true ones in the same camera axes.

    - `lifted_pair_error`: mean joint distance, with the middles of the pairs aligned: distance and depth count;
    - `lifted_person_error`: mean joint distance, each person about their root;
    - `lifted_D_C`: after the best rigid motion of the whole pair;
    - `person_distance_error`, `relative_depth_error`: of the distance between the two roots, and of its depth.
    """
    flat, true = (merge_axes(pairs, 1, -1) for pairs in (lifted_m, truth_m))
    centred, centred_truth = flat - flat.mean(axis=1, keepdims=True), true - true.mean(axis=1, keepdims=True)
    about_root, own_truth = (pairs - pairs[:, :, _ROOT : _ROOT + 1] for pairs in (lifted_m, truth_m))
    between, between_truth = (pairs[:, 1, _ROOT] - pairs[:, 0, _ROOT] for pairs in (lifted_m, truth_m))
    return {
        "lifted_pair_error": np.linalg.norm(centred - centred_truth, axis=-1).mean(axis=-1),
        "lifted_person_error": np.linalg.norm(about_root - own_truth, axis=-1).mean(axis=(-1, -2)),
        "lifted_D_C": cartesian_dissimilarity(flat, true),
        "person_distance_error": np.abs(np.linalg.norm(between, axis=-1) - np.linalg.norm(between_truth, axis=-1)),
        "relative_depth_error": np.abs(between[:, 2] - between_truth[:, 2]),
    }


def completion_errors(
    generator: np.random.Generator, truth_m: Array, draws_m: npt.NDArray[np.floating]
) -> dict[str, dict[str, Array]]:
    """Hide limbs of one person of real pairs (n, 2, 17, 3), metres; return errors (n,) by hidden limb and method.

    `median` and `blended` are the published steps over the 100 draws nearest in D_I, `fitted` adds exact bones,
    `blended_10` takes 10 draws; the mean of all draws and the nearest draw, moved onto the visible joints, are the
    baselines.
    """
    mean = np.asarray(draws_m.mean(axis=0), dtype=np.float64)
    by_part: dict[str, dict[str, Array]] = {}
    for part, choices in HIDDEN.items():
        errors: dict[str, list[float]] = {}
        for truth in truth_m:
            joints = list(choices[generator.integers(len(choices))])
            person = int(generator.integers(2))
            seen = truth.copy()
            seen[person, joints] = np.nan
            done = complete_pair(seen, draws_m, num_ranked=NUM_NEAREST + 20)
            near = done.neighbours.pairs_m[:10]
            is_seen = np.isfinite(seen).all(axis=-1).ravel()
            flat = mean.reshape(-1, 3)
            moved = align_rigid(flat[is_seen], truth.reshape(-1, 3)[is_seen]).apply(flat).reshape(truth.shape)
            for method, pair in (
                ("median", done.median_m),
                ("blended", done.pair_m),
                ("fitted", done.fitted_m),
                ("blended_10", blend_onto(np.median(near, axis=0), seen)),
                ("nearest_draw", nearest_rigid(draws_m, seen, count=1).pairs_m[0]),
                ("mean_pair", moved),
            ):
                error = np.linalg.norm(pair[person, joints] - truth[person, joints], axis=-1).mean()
                errors.setdefault(method, []).append(float(error))
        by_part[part] = {method: np.array(values) for method, values in errors.items()}
    return by_part


def in_between_errors(spans_m: Sequence[Array], draws_m: npt.NDArray[np.floating]) -> dict[str, list[Array]]:
    """Return errors (frame,), metres, between the ends of real spans (frame, 2, 17, 3), by method and span."""
    errors: dict[str, list[Array]] = {"draws": [], "straight": []}
    for span in spans_m:
        for method, between in (
            ("draws", fill_between(span[0], span[-1], len(span) - 2, draws_m)),
            ("straight", straight_between(span[0], span[-1], len(span) - 2)),
        ):
            errors[method].append(np.linalg.norm(between - span[1:-1], axis=-1).mean(axis=(1, 2)))
    return errors
