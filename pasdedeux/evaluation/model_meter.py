"""What predictions of a variant are worth: joints beside the converged one, and contacts, energy, feet, jerk alone.

The distances of Li et al. (2024) say how near a prediction is to the solver's own answer.  What an eye would say is
measured as the quality of variants is (`augmentation.quality`), against the source and without looking at that answer,
which therefore has figures of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.energy import fit_terms, total_energy
from pasdedeux.augmentation.problem import Problem
from pasdedeux.augmentation.quality import QualityMeter
from pasdedeux.augmentation.source import complete_scales, points_of, reference_motion, scaled_lengths, widened_m
from pasdedeux.augmentation.terms import build_targets
from pasdedeux.evaluation.models import generated_errors, key_contacts, model_errors
from pasdedeux.interaction.contacts import Contacts, stated_contacts
from pasdedeux.learning import BASELINES, VariantModel, VariantRequest
from pasdedeux.learning.mesh_refine import window_problems
from pasdedeux.skeletons import BODY22

__all__ = ["SOLVER", "ModelMeter"]

Array = npt.NDArray[np.float64]

SOLVER = "solver"
"""Name under which the converged variant has its own figures."""

_MM = 1000.0


class ModelMeter:
    """Measures predictions for one take; what belongs to the take is made once.

    Args:
        request: Any request for the take: its source, how it is solved, its known contacts.
    """

    def __init__(self, request: VariantRequest) -> None:
        self._request = request
        self._quality = QualityMeter(
            request.source,
            girth=request.solving.girth,
            touch_m=request.solving.touch_m,
            user_contacts=request.contacts,
        )

    @cached_property
    def contacts(self) -> Contacts:
        """Contacts of the take: those known of it where some are, otherwise those found."""
        source, request = self._request.source, self._request
        known = [one for one in request.contacts if one.weight > 0.0 and not one.is_of_floor]
        if known:
            return stated_contacts(known, source.num_frames, BODY22, source.objects)
        return source.contacts(request.solving.touch_m)

    @cached_property
    def keys(self) -> Contacts:
        """Key contacts of the take, those that last longest."""
        return key_contacts(self.contacts)

    def key_names(self) -> str:
        """Return the key pairs of bones in words; empty where nothing is ever in contact."""
        names = [
            " and ".join(f"{'AB'[bone // 22]}'s {BODY22.joint_names[bone % 22].replace('_', ' ')}" for bone in pair)
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
        scales = complete_scales(source, bone_scale[None])
        lengths = scaled_lengths(source, scales)[0]
        reference = points_of(reference_motion(source, scales)[0])
        asked = VariantRequest(self._request.take_id, source, bone_scale, self._request.solving, self._request.contacts)
        windows, problems = self._problems
        terms = [fit_terms(problem, build_targets(problem, scales), 0) for problem in problems]

        def energy(motion_m: Array) -> float:
            points = points_of(asked.with_exact_bones(motion_m))
            return sum(total_energy(one, points[window]) for window, one in zip(windows, terms, strict=True))

        bones = self.contacts.bones()[self.contacts.is_held]
        before = self._distances(points_of(source.positions_m))
        wanted = widened_m(before, bones, source, self._request.solving.girth, scales)[0]
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
            drift = np.abs(self._distances(points) - wanted)
            found[name] = errors | {
                "contact_error": _MM * float(drift.mean()) if len(drift) else np.nan,
                "contact_error_p95": _MM * float(np.percentile(drift, 95.0)) if len(drift) else np.nan,
                "energy_gap": 100.0 * (energy(motion) / max(least, 1e-12) - 1.0),
                "foot_slide": _MM * quality.stance_excursion_m,
                "penetration": _MM * quality.penetration_m,
                "jerk_ratio": quality.jerk_ratio,
            }
        return found

    def measure_generated(
        self, models: Mapping[str, VariantModel], generator: np.random.Generator
    ) -> dict[str, dict[str, float]]:
        """Return E_b and JPD of a motion that each model draws with its scales, and of baselines at these; see there.

        Models that draw nothing are left out; nothing is returned where none draws.
        """
        asked = self._request
        drawn = {name: model.generate(asked.source, generator) for name, model in models.items()}
        made = {name: found for name, found in drawn.items() if found is not None}

        def errors(motion_m: Array, bone_scale: Array) -> dict[str, float]:
            return generated_errors(motion_m, asked.source.positions_m, bone_scale, self.keys)

        found = {name: errors(motion, scale) for name, (scale, motion) in made.items()}
        for name in [name for name in BASELINES if made and name in models]:
            requests = [replace(asked, bone_scale=scale) for scale, _ in made.values()]
            rows = [errors(models[name].predict(request), request.bone_scale) for request in requests]
            found[name] = {metric: float(np.mean([row[metric] for row in rows])) for metric in rows[0]}
        return found

    def _distances(self, points: Array) -> Array:
        return np.asarray(np.linalg.norm(self.contacts.vectors(points)[self.contacts.is_held], axis=-1))

    @cached_property
    def _problems(self) -> tuple[list[slice], list[Problem]]:
        return window_problems(self._request)
