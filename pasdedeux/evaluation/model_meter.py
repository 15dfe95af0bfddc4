"""What predictions of a variant are worth: joints beside the converged one, and contacts, energy, feet, jerk alone.

The distances of Li et al. (2024) say how near a prediction is to the solver's own answer.  What an eye would say is
measured as the quality of variants is (`augmentation.quality`), against the source and without looking at that answer,
which therefore has figures of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation.energy import fit_terms, total_energy
from pasdedeux.augmentation.problem import Problem
from pasdedeux.augmentation.quality import QualityMeter
from pasdedeux.augmentation.source import complete_scales, points_of, reference_motion, scaled_lengths
from pasdedeux.augmentation.terms import build_targets
from pasdedeux.evaluation.models import OF_QUALITY, generated_errors, key_contacts, model_errors
from pasdedeux.interaction.contacts import Contacts, stated_contacts
from pasdedeux.learning import DEFAULT_MODELS, VariantModel, VariantRequest
from pasdedeux.learning.mesh_refine import window_problems
from pasdedeux.skeletons import BODY22

SOLVER = "solver"
"""Name under which the converged variant has its own figures."""

_MM = 1000.0


def generated(
    models: Mapping[str, VariantModel], request: VariantRequest, streams: Callable[[str], np.random.Generator]
) -> dict[str, list[tuple[Array, Array]]]:
    """Return scales (2, 22) and a motion (T, 2, 22, 3), metres, that each model draws for a take.

    Each draws from a stream of its own, by its name, so that none changes with which others there are.  What is trivial
    or closed has a motion at the scales of each of them; models that draw nothing are left out, all where none draws.
    """
    drawn = {name: model.generate(request.source, streams(name)) for name, model in models.items()}
    made = {name: [found] for name, found in drawn.items() if found is not None}
    scales = [scale for found in made.values() for scale, _ in found]
    beside = [name for name in DEFAULT_MODELS if scales and name in models]
    return made | {
        name: [(scale, models[name].predict(replace(request, bone_scale=scale))) for scale in scales] for name in beside
    }


class ModelMeter:
    """Measures predictions for one take; what belongs to the take is made once.

    Args:
        request: Any request for the take: its source, how it is solved, its known contacts.

    On another skeleton than `body22` there are neither contacts nor surfaces: figures are E_r, E_b and PWD alone.
    """

    def __init__(self, request: VariantRequest) -> None:
        self._request = request
        self._is_body22 = request.source.skeleton == BODY22

    @cached_property
    def _quality(self) -> QualityMeter:
        return QualityMeter(self._request.source, user_contacts=self._request.contacts)

    @cached_property
    def contacts(self) -> Contacts:
        """Contacts of the take: those known of it where some are, otherwise those found."""
        source, request = self._request.source, self._request
        known = [one for one in request.contacts if one.weight > 0.0 and not one.is_of_floor]
        if known:
            return stated_contacts(known, source.num_frames, BODY22, source.objects)
        return source.contacts()

    @cached_property
    def keys(self) -> Contacts | None:
        """Key contacts of the take, those that last longest; None on another skeleton."""
        return key_contacts(self.contacts) if self._is_body22 else None

    def key_names(self) -> str:
        """Return the key pairs of bones in words; empty where nothing is ever in contact."""
        names = [
            " and ".join(f"{'AB'[bone // 22]}'s {BODY22.joint_names[bone % 22].replace('_', ' ')}" for bone in pair)
            for pair in (self.keys.bones()[0].tolist() if self.keys else ())
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
                name: {} if name == SOLVER else model_errors(motion, true_m, skeleton=source.skeleton)
                for name, motion in {**predicted_m, SOLVER: true_m}.items()
            }
        scales = complete_scales(source, bone_scale[None])
        lengths = scaled_lengths(source, scales)[0]
        reference = points_of(reference_motion(source, scales)[0])
        asked = VariantRequest(self._request.take_id, source, bone_scale, self._request.solving, self._request.contacts)
        windows, problems = self._problems
        terms = [fit_terms(problem, build_targets(problem, scales), 0) for problem in problems]

        def energy(motion_m: Array) -> float:
            points = points_of(asked.with_exact_bones(motion_m))
            return sum(total_energy(one, points[window]) for window, one in zip(windows, terms, strict=True))

        before = self._distances(points_of(source.positions_m))
        least = energy(true_m)
        found: dict[str, dict[str, float]] = {}
        for name, motion in {**predicted_m, SOLVER: true_m}.items():
            points = points_of(motion)
            quality = self._quality.measure(
                points,
                reference=reference,
                bone_scale=scales[0],
                lengths_m=lengths,
                squared_residual=np.zeros(len(points)),
            ).quality
            errors = {} if name == SOLVER else model_errors(motion, true_m, self.keys)
            drift = np.abs(self._distances(points) - before)
            found[name] = errors | {
                "contact_error": _MM * float(drift.mean()) if len(drift) else np.nan,
                "contact_error_p95": _MM * float(np.percentile(drift, 95.0)) if len(drift) else np.nan,
                "energy_gap": 100.0 * (energy(motion) / max(least, 1e-12) - 1.0),
                **{one.metric: (_MM if one.unit else 1.0) * getattr(quality, one.name) for one in OF_QUALITY},
            }
        return found

    def measure_generated(
        self, models: Mapping[str, VariantModel], streams: Callable[[str], np.random.Generator]
    ) -> dict[str, dict[str, float]]:
        """Return E_b and JPD of `generated`, means where there are several; see `generated_errors`."""
        source, found = self._request.source, {}
        for name, made in generated(models, self._request, streams).items():
            template = (source.positions_m, self.keys, source.skeleton)
            rows = [generated_errors(motion, scale, *template) for scale, motion in made]
            found[name] = {metric: float(np.mean([row[metric] for row in rows])) for metric in rows[0]}
        return found

    def _distances(self, points: Array) -> Array:
        return np.asarray(np.linalg.norm(self.contacts.vectors(points)[self.contacts.is_held], axis=-1))

    @cached_property
    def _problems(self) -> tuple[list[slice], list[Problem]]:
        return window_problems(self._request)
