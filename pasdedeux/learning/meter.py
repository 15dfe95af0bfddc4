"""Figures of augmentation models on test variants: E_r, E_b, JPD and PWD (Li et al. 2024, section 5.1), and quality.

The paper gives them in words: l2 distances, per joint, averaged over both people.  Here E_r is the mean distance
between predicted and true joints in the world (nothing is aligned or centred), E_b the mean difference of bone lengths,
and JPD the mean difference of the distance of key pairs, "the body parts in continuous contact", which the paper names
by hand per take, as joints; here they are points of bones, those known of the take (the built-in duets state theirs),
otherwise those found that last longest.  JPD is leaked by construction, as the solver pins those pairs.  PWD (ours) is
the mean difference of the distances between all joints of one and of the other, each weighted by 1 / d^2 of the true
distance, which is taken for 10 cm where it is less.

These are distances from the solver's own answer.  Visible quality is measured as that of variants is
(`augmentation.quality`), against the source and without that answer, which therefore has figures of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation.energy import fit_terms
from pasdedeux.augmentation.problem import MeshProblem
from pasdedeux.augmentation.quality import FIGURES, QualityMeter
from pasdedeux.augmentation.source import complete_scales, points_of, reference_motion, scaled_lengths
from pasdedeux.augmentation.terms import build_targets
from pasdedeux.errors import InputError
from pasdedeux.fitting.terms import total_energy
from pasdedeux.interaction.contacts import Contacts, stated_contacts
from pasdedeux.kinematics import bone_lengths
from pasdedeux.learning.mesh_refine import window_problems
from pasdedeux.learning.model import VariantModel, VariantRequest
from pasdedeux.learning.registry import DEFAULT_MODELS
from pasdedeux.skeletons import BODY22, Skeleton

Errors = Mapping[str, float]

_CM = 100.0
_MM = 1000.0
SHARE = "E_r_of_best_baseline"
OF_QUALITY = tuple(FIGURES[name] for name in ("stance_excursion_m", "penetration_m", "jerk_ratio"))
"""Figures of a variant's quality that models have too, lengths in millimetres."""
UNITS: Mapping[str, str] = {
    **{"E_r": "cm", "E_b": "mm", "JPD": "cm", "PWD": "cm"},
    **{"contact_error": "mm", "contact_error_p95": "mm", "energy_gap": "%"},
    **{quantity.metric: quantity.unit.replace("m", "mm") for quantity in OF_QUALITY},
    SHARE: "%",
}
"""Every figure of a model with its unit.  Beside the paper's distances: mean and 95th percentile of how far contacts
come from the distance they should have; energy over that of the converged variant, both on exact bones; those of its
quality.  And E_r in percent of the best baseline's."""
SOLVER = "solver"
"""Name under which the converged variant has its own figures."""
GENERATED = "generated"
"""Item of figures of motions for scales that a model drew itself, and of baselines at these scales."""
_NEAREST_M = 0.1
"""Distances below this have the same weight."""


def key_contacts(contacts: Contacts, *, max_pairs: int = 3) -> Contacts:
    """Return the longest-lasting contacts of people, at the mean of their places, as contacts of a single frame.

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
        keys: Key contacts of the take, on the same skeleton; without them JPD is NaN.
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

    Bones are compared with the source's times their scales, distances of key pairs with those of the source (T, 2, 22,
    3).
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
    points = [motion.reshape(-1, 1, 2 * motion.shape[-2], 3) for motion in (motion_m, other_m)]
    apart = [np.linalg.norm(keys.vectors(joints), axis=-1) for joints in points]
    return _CM * float(np.abs(apart[0] - apart[1]).mean())


def _weighted_distance_error(predicted_m: Array, true_m: Array) -> float:
    predicted, true = (
        np.linalg.norm(motion[:, 0, :, None] - motion[:, 1, None, :], axis=-1) for motion in (predicted_m, true_m)
    )
    weights = np.maximum(true, _NEAREST_M) ** -2
    return float((weights * np.abs(predicted - true)).sum() / weights.sum())


def generated(
    models: Mapping[str, VariantModel], request: VariantRequest, streams: Callable[[str], np.random.Generator]
) -> dict[str, list[tuple[Array, Array]]]:
    """Return scales (2, 22) and a motion (T, 2, 22, 3), metres, that each model draws for a take.

    Each draws from its own stream, by its name, so that it does not depend on the other models.  Baselines and closed
    forms have a motion at the scales of each of them. Other models that draw nothing have none; without a model that
    draws, nobody has any.
    """
    drawn = {name: model.generate(request.source, streams(name)) for name, model in models.items()}
    drawings = {name: [drawing] for name, drawing in drawn.items() if drawing is not None}
    scales = [scale for drawing in drawings.values() for scale, _ in drawing]
    beside = [name for name, model in models.items() if scales and model.name in DEFAULT_MODELS]
    return drawings | {
        name: [(scale, models[name].predict(replace(request, bone_scale=scale))) for scale in scales] for name in beside
    }


class ModelMeter:
    """Measures predictions for one take; data of the take are computed once.

    Args:
        request: Any request for the take: its source, how it is solved, its known contacts.

    On another skeleton than `body22` contacts are found, and the solver's surfaces and energy are not measured.
    """

    def __init__(self, request: VariantRequest) -> None:
        self._request = request
        self._is_body22 = request.source.skeleton == BODY22

    @cached_property
    def _quality(self) -> QualityMeter:
        return QualityMeter(self._request.source, user_contacts=self._request.contacts)

    @cached_property
    def contacts(self) -> Contacts:
        """Contacts of the take: the stated ones if there are any, otherwise those found."""
        source, request = self._request.source, self._request
        known = [contact for contact in request.contacts if contact.weight > 0.0 and not contact.is_of_floor]
        if known:
            return stated_contacts(known, source.num_frames, BODY22, source.objects)
        return source.contacts()

    @cached_property
    def keys(self) -> Contacts:
        """Key contacts of the take: the longest-lasting ones."""
        return key_contacts(self.contacts)

    def key_names(self) -> str:
        """Return the key pairs of bones in words; empty where nothing is ever in contact."""
        joints = self._request.source.skeleton.joint_names
        names = [
            " and ".join(f"{'AB'[at // len(joints)]}'s {joints[at % len(joints)].replace('_', ' ')}" for at in pair)
            for pair in self.keys.bones()[0].tolist()
        ]
        return ", ".join(names)

    def measure(
        self, bone_scale: Array, predicted_m: Mapping[str, Array], true_m: Array
    ) -> dict[str, dict[str, float]]:
        """Return the figures of predictions by their names, and those of the converged variant itself as `solver`.

        Args:
            bone_scale: Scales of the variant (2, 22).
            predicted_m: Motions (T, 2, 22, 3), metres, by model.
            true_m: The converged variant (T, 2, 22, 3), metres.

        Returns:
            Figures in `UNITS` by name; the solver has no distances to itself.
        """
        source = self._request.source
        if not self._is_body22:
            return {
                name: self._contact_errors(motion)
                | ({} if name == SOLVER else model_errors(motion, true_m, self.keys, source.skeleton))
                for name, motion in {**predicted_m, SOLVER: true_m}.items()
            }
        scales = complete_scales(source, bone_scale[None])
        lengths = scaled_lengths(source, scales)[0]
        reference = points_of(reference_motion(source, scales)[0])
        asked = VariantRequest(self._request.take_id, source, bone_scale, self._request.solving, self._request.contacts)
        windows, problems = self.problems
        terms = [fit_terms(problem, build_targets(problem, scales), 0) for problem in problems]

        def energy(motion_m: Array) -> float:
            points = points_of(asked.with_exact_bones(motion_m))
            return sum(total_energy(term, points[window]) for window, term in zip(windows, terms, strict=True))

        least = energy(true_m)
        measured: dict[str, dict[str, float]] = {}
        for name, motion in {**predicted_m, SOLVER: true_m}.items():
            points = points_of(motion)
            quality, _ = self._quality.measure(
                points,
                reference=reference,
                bone_scale=scales[0],
                lengths_m=lengths,
                squared_residual=np.zeros(len(points)),
            )
            errors = {} if name == SOLVER else model_errors(motion, true_m, self.keys)
            measured[name] = errors | {
                **self._contact_errors(motion),
                "energy_gap": 100.0 * (energy(motion) / max(least, 1e-12) - 1.0),
                **{
                    quantity.metric: (_MM if quantity.unit else 1.0) * getattr(quality, quantity.name)
                    for quantity in OF_QUALITY
                },
            }
        return measured

    def measure_generated(
        self, models: Mapping[str, VariantModel], streams: Callable[[str], np.random.Generator]
    ) -> dict[str, dict[str, float]]:
        """Return E_b and JPD of `generated`, means where there are several; see `generated_errors`."""
        source, measured = self._request.source, {}
        for name, motions in generated(models, self._request, streams).items():
            template = (source.positions_m, self.keys, source.skeleton)
            rows = [generated_errors(motion, scale, *template) for scale, motion in motions]
            measured[name] = {metric: float(np.mean([row[metric] for row in rows])) for metric in rows[0]}
        return measured

    def _contact_errors(self, motion_m: Array) -> dict[str, float]:
        """Return how far a motion's contacts are from their distance in the source; NaN where nothing is in contact."""
        drift = np.abs(self.contacts.held_distances(points_of(motion_m)) - self._own_distances)
        figures = (drift.mean(), np.percentile(drift, 95.0)) if len(drift) else (np.nan, np.nan)
        return dict(zip(("contact_error", "contact_error_p95"), _MM * np.array(figures), strict=True))

    @cached_property
    def _own_distances(self) -> Array:
        return self.contacts.held_distances(points_of(self._request.source.positions_m))

    @cached_property
    def problems(self) -> tuple[list[slice], list[MeshProblem]]:
        """Windows of the take and their problems, for the solver's energy and its steps."""
        return window_problems(self._request)
