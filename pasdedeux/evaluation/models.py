"""Augmentation models over test variants: E_r, E_b, JPD and PWD (Li et al. 2024, section 5.1) as scores and curves.

The paper gives them in words: l2 distances, per joint, averaged over both people.  Here E_r is the mean distance
between predicted and true joints in the world (nothing is aligned or centred), E_b the mean difference of bone lengths,
and JPD the mean difference of the distance of key pairs, "the body parts in continuous contact", which the paper names
by hand per take, as joints; here they are points of bones, those known of the take (the built-in duets state theirs),
otherwise those found that last longest.  JPD is leaked by construction, as the solver pins those pairs.  PWD (ours) is
the mean difference of the distances between all joints of one and of the other, each weighted by 1 / d^2 of the true
distance, which is taken for 10 cm where it is less.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation.quality import FIGURES
from pasdedeux.errors import InputError
from pasdedeux.evaluation.figures import Curve, curve_figure
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.scores import Score, bootstrap_interval
from pasdedeux.interaction.contacts import Contacts
from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import BODY22, Skeleton

Errors = Mapping[str, float]

_CM = 100.0
_MM = 1000.0
SHARE = "E_r_of_best_baseline"
OF_QUALITY = tuple(FIGURES[name] for name in ("stance_excursion_m", "penetration_m", "jerk_ratio"))
"""Figures of a variant's quality that a model has too, lengths in millimetres."""
UNITS: Mapping[str, str] = {
    **{"E_r": "cm", "E_b": "mm", "JPD": "cm", "PWD": "cm"},
    **{"contact_error": "mm", "contact_error_p95": "mm", "energy_gap": "%"},
    **{one.metric: one.unit.replace("m", "mm") for one in OF_QUALITY},
    SHARE: "%",
}
"""Every figure of a model with its unit.  Beside the paper's distances: mean and 95th percentile of how far contacts
come from the distance they should have; energy over that of the converged variant, both on exact bones; those of its
quality.  And E_r in percent of the best baseline's."""
GENERATED = "generated"
"""Item of figures of motions for scales that a model drew itself, and of baselines at these scales."""
_NEAREST_M = 0.1
"""Distances below this weigh alike."""
_SCALE_STEP = 0.05


def key_contacts(contacts: Contacts, *, max_pairs: int = 3) -> Contacts:
    """Return the contacts of people that last longest, at the mean of their places, as those of a single frame.

    Args:
        contacts: The contacts of a take.
        max_pairs: How many pairs of bones are given at most; none that is never in contact.
    """
    held = contacts.is_held & (contacts.objects < 0)
    bones, which, count = np.unique(contacts.points[held], axis=0, return_inverse=True, return_counts=True)
    shares, hand = np.zeros((len(bones), 4)), np.zeros((len(bones), 2))
    np.add.at(shares, which.ravel(), contacts.shares[held])
    np.add.at(hand, which.ravel(), contacts.hand[held])
    order = np.argsort(-count, kind="stable")[:max_pairs]
    mean = 1.0 / count[order, None]
    return Contacts(
        points=bones[None, order],
        shares=mean * shares[None, order],
        weights=np.ones((1, len(order))),
        hand=mean * hand[None, order],
        objects=np.full((1, len(order)), -1),
        places_m=np.zeros((1, len(order), 3)),
    )


def model_errors(
    predicted_m: Array, true_m: Array, keys: Contacts | None = None, skeleton: Skeleton = BODY22
) -> dict[str, float]:
    """Return E_r, JPD and PWD in cm and E_b in mm of a predicted variant; JPD is NaN where a take has no key pair.

    Args:
        predicted_m: (T, 2, 22, 3), metres.
        true_m: (T, 2, 22, 3), metres.
        keys: Key contacts of the take, on `body22`; without them JPD is NaN.
        skeleton: Skeleton of both, whose joints stand for the 22.

    Raises:
        InputError: Shapes differ, or a value is not finite.
    """
    if predicted_m.shape != true_m.shape or predicted_m.shape[-3:] != (2, skeleton.num_joints, 3):
        raise InputError(
            f"predicted motion {predicted_m.shape} and true motion {true_m.shape} must be "
            f"(T, 2, {skeleton.num_joints}, 3)"
        )
    if not (np.isfinite(predicted_m).all() and np.isfinite(true_m).all()):
        raise InputError("a predicted or true motion is not finite")
    return {
        "E_r": float(frame_errors_cm(predicted_m, true_m).mean()),
        "E_b": _length_error_mm(predicted_m, bone_lengths(skeleton, true_m), skeleton),
        "JPD": _key_error_cm(predicted_m, true_m, keys),
        "PWD": _CM * _weighted_distance_error(predicted_m, true_m),
    }


def frame_errors_cm(predicted_m: Array, true_m: Array) -> Array:
    """Return the mean distance of joints in each frame (T,), cm, of motions (T, person, joint, 3); its mean is E_r."""
    return np.asarray(_CM * np.linalg.norm(predicted_m - true_m, axis=-1).mean(axis=(1, 2)))


def generated_errors(
    motion_m: Array, bone_scale: Array, source_m: Array, keys: Contacts | None = None, skeleton: Skeleton = BODY22
) -> dict[str, float]:
    """Return E_b and JPD of a motion for scales (2, 22) that have no true motion.

    Bones are beside the source's times their scales, distances of key pairs beside those of the source (T, 2, 22, 3).
    """
    return {
        "E_b": _length_error_mm(motion_m, bone_scale * bone_lengths(skeleton, source_m), skeleton),
        "JPD": _key_error_cm(motion_m, source_m, keys),
    }


def _length_error_mm(motion_m: Array, lengths_m: Array, skeleton: Skeleton) -> float:
    bones = [child for _, child in skeleton.bones]
    return _MM * float(np.abs(bone_lengths(skeleton, motion_m) - lengths_m)[..., bones].mean())


def _key_error_cm(motion_m: Array, other_m: Array, keys: Contacts | None) -> float:
    if keys is None or not keys.weights.size:
        return float("nan")
    points = [motion.reshape(-1, 1, 2 * BODY22.num_joints, 3) for motion in (motion_m, other_m)]
    apart = [np.linalg.norm(keys.vectors(joints), axis=-1) for joints in points]
    return _CM * float(np.abs(apart[0] - apart[1]).mean())


def _weighted_distance_error(predicted_m: Array, true_m: Array) -> float:
    predicted, true = (
        np.linalg.norm(motion[:, 0, :, None] - motion[:, 1, None, :], axis=-1) for motion in (predicted_m, true_m)
    )
    weights = np.maximum(true, _NEAREST_M) ** -2
    return float((weights * np.abs(predicted - true)).sum() / weights.sum())


def model_scores(
    errors: Mapping[str, Sequence[Errors]],
    *,
    baselines: Sequence[str],
    split: str,
    item: str,
    takes: Sequence[str] | None = None,
) -> list[Score]:
    """Return the mean of each figure of each model over test variants, with its bootstrap interval over these.

    Figures that are NaN everywhere are left out.  Where the takes of the variants are told, the interval is over takes.
    """
    scores = []
    for model, found in errors.items():
        for metric in {name: None for error in found for name in error}:
            values = np.array([error.get(metric, np.nan) for error in found])
            rows = np.flatnonzero(np.isfinite(values))
            values = values[rows]
            if len(values):
                low, high = bootstrap_interval(
                    values, units=None if takes is None else [takes[row] for row in rows.tolist()]
                )
                scores.append(
                    Score(
                        metric=metric,
                        method=model,
                        value=float(values.mean()),
                        unit=UNITS[metric],
                        is_baseline=model in baselines,
                        split=split,
                        item=item,
                        count=len(values),
                        low=low,
                        high=high,
                    )
                )
    return scores


def share_scores(
    errors: Mapping[str, Sequence[Errors]],
    *,
    baselines: Sequence[str],
    split: str,
    takes: Sequence[str] | None = None,
) -> list[Score]:
    """Return E_r of each model in percent of that of the best baseline, with the interval as `model_scores` has it."""
    values = {name: np.array([error["E_r"] for error in found]) for name, found in errors.items() if found}
    rivals = {name: found for name, found in values.items() if name in baselines}
    if not rivals:
        return []
    best = min(rivals.values(), key=lambda found: float(found.mean()))
    scores = []
    for model, found in values.items():
        if model not in rivals:
            low, high = (100.0 * end for end in bootstrap_interval(found, best, units=takes))
            share = 100.0 * float(found.mean() / max(best.mean(), 1e-12))
            scores.append(Score(SHARE, model, share, UNITS[SHARE], split=split, count=len(found), low=low, high=high))
    return scores


def model_figure(
    scales: Sequence[float],
    errors: Mapping[str, Sequence[Errors]],
    *,
    baselines: Sequence[str],
    split: str,
) -> bytes:
    """Draw E_r of each model against the test variants' scale furthest from 1 (means of steps of 0.05); SVG bytes."""
    at = np.round(np.array(scales) / _SCALE_STEP) * _SCALE_STEP
    known = np.unique(np.round(at, 6))
    curves = []
    for model, found in errors.items():
        values = np.array([error["E_r"] for error in found])
        means = np.array([values[np.isclose(at, scale)].mean() for scale in known])
        curves.append(Curve(in_words(model), known, means, is_baseline=model in baselines))
    return curve_figure(
        curves,
        title=f"models on {split.replace('_', ' ')} test variants",
        x_label="scale furthest from 1, of anybody's bones",
        y_label="mean joint error E_r (cm)",
    )
