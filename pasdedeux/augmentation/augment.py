"""Augmentation of a take: variants solved in bulk, the bad ones again by guaranteed descent, every one measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.bulk import BulkSettings, BulkSolver
from pasdedeux.augmentation.contacts import ContactSettings, UserContact
from pasdedeux.augmentation.descent import descend
from pasdedeux.augmentation.energy import total_energy
from pasdedeux.augmentation.quality import Judge, Quality, QualityLimits, Verdict
from pasdedeux.augmentation.source import Source
from pasdedeux.augmentation.terms import Targets, Weights, build_problem, build_targets
from pasdedeux.augmentation.variations import Variation
from pasdedeux.fitting import FitSettings
from pasdedeux.skeletons import BODY22

__all__ = ["AugmentationSettings", "Augmenter", "Variant"]

Array = npt.NDArray[np.float64]

FAR_APART_M = 1.0
"""People whose joints never come closer than this do not interact; their variants are solved all the same."""


@dataclass(frozen=True)
class AugmentationSettings:
    """Everything that decides a variant.

    Args:
        weights: Weights of the terms.
        contacts: What counts as contact, stance and floor.
        limits: When a figure is a warning or a failure.
        bulk: The bulk solver's settings.
        descent: The guaranteed solver's settings.
        fallback_residual_m: A variant whose bones the bulk solver leaves further than this from their lengths (root
            mean square) goes to the guaranteed solver, started from where bulk ended.
        is_bulk: Use the bulk solver; without it every variant is solved by guaranteed descent.
        mesh_smoothing_s: Averaging of the mesh weights over time.
        fixed_person: Person (0 or 1) who keeps the source's motion, or None.
        user_contacts: Contacts that replace what is found.
    """

    weights: Weights = field(default_factory=Weights)
    contacts: ContactSettings = field(default_factory=ContactSettings)
    limits: QualityLimits = field(default_factory=QualityLimits)
    bulk: BulkSettings = field(default_factory=lambda: BulkSettings(is_single_precision=True))
    descent: FitSettings = field(default_factory=lambda: FitSettings(max_iterations=12, tolerance=5e-3))
    fallback_residual_m: float = 5e-4
    is_bulk: bool = True
    mesh_smoothing_s: float = 0.25
    fixed_person: int | None = None
    user_contacts: tuple[UserContact, ...] = ()


@dataclass(frozen=True)
class Variant:
    """One solved variant.

    Args:
        variation: Its name and the scales asked for.
        bone_scale: The scales used (2, 22): as asked for, the root's following the legs.
        positions_m: Motion of both people (T, 2, 22, 3), metres; always finite.
        quality: Its figures.
        energy: Energy of the motion.
        energy_fk: Energy of plain forward kinematics, which is never lower.
        solver: `bulk`, `descent`, `bulk+descent`, or `plain_fk` when both failed.
        num_iterations: Iterations of the solver.
        verdict: `pass`, `warn` or `fail`.
        reason: What was not passed, in words; empty when passed.
    """

    variation: Variation
    bone_scale: Array
    positions_m: Array
    quality: Quality
    energy: float
    energy_fk: float
    solver: str
    num_iterations: int
    verdict: str
    reason: str


class Augmenter:
    """A take that is ready for any number of variants: mesh, terms and factor are computed once."""

    def __init__(self, source: Source, settings: AugmentationSettings | None = None) -> None:
        self.source = source
        self.settings = settings or AugmentationSettings()
        self.problem = build_problem(
            source,
            self.settings.weights,
            self.settings.contacts,
            user_contacts=self.settings.user_contacts,
            fixed_person=self.settings.fixed_person,
            mesh_smoothing_s=self.settings.mesh_smoothing_s,
        )
        self._bulk = BulkSolver(self.problem, self.settings.bulk) if self.settings.is_bulk else None
        self._judge = Judge(self.problem)

    def solve(self, variations: Sequence[Variation]) -> list[Variant]:
        """Solve a batch of variations; a few dozen at a time are fastest.

        Raises:
            InputError: Scales of the wrong shape, or not positive.
        """
        if not variations:
            return []
        problem, settings = self.problem, self.settings
        targets = build_targets(problem, np.stack([variation.bone_scale for variation in variations]))
        energy_fk = self._energies(targets, targets.reference)
        positions = np.array(targets.reference)
        energy = np.array(energy_fk)
        solvers = ["descent"] * len(variations)
        iterations = [0] * len(variations)
        is_done = np.zeros(len(variations), dtype=bool)
        if self._bulk is not None:
            result = self._bulk.solve(targets)
            with np.errstate(invalid="ignore", over="ignore"):
                bulk_energy = self._energies(targets, result.positions)
            is_better = np.isfinite(bulk_energy) & (bulk_energy <= energy_fk)
            positions[is_better], energy[is_better] = result.positions[is_better], bulk_energy[is_better]
            is_done = is_better & (result.residual_m <= settings.fallback_residual_m)
            solvers = ["bulk" if good else "bulk+descent" for good in is_done]
            iterations = [result.num_iterations] * len(variations)
        for index in np.flatnonzero(~is_done):
            descent = descend(problem, targets, int(index), positions[index], settings.descent)
            if np.isfinite(descent.positions).all():
                positions[index], energy[index] = descent.positions, descent.energies[-1]
                iterations[index] += descent.num_iterations
            elif energy[index] == energy_fk[index]:
                solvers[index] = "plain_fk"
        qualities = self._judge.measure(targets, positions)
        return [
            self._variant(
                variation,
                bone_scale=targets.bone_scale[index],
                points=positions[index],
                quality=qualities[index],
                energy=float(energy[index]),
                energy_fk=float(energy_fk[index]),
                solver=solvers[index],
                num_iterations=iterations[index],
            )
            for index, variation in enumerate(variations)
        ]

    def _energies(self, targets: Targets, positions: Array) -> Array:
        """Give the energy (variant,), one by one, so that sums round the same in every batch."""
        chosen = (targets.select([variant]) for variant in range(targets.num_variants))
        return np.array(
            [
                total_energy(self.problem, one, points[None] - one.reference)[0]
                for one, points in zip(chosen, positions, strict=True)
            ]
        )

    def _variant(
        self,
        variation: Variation,
        *,
        bone_scale: Array,
        points: Array,
        quality: Quality,
        energy: float,
        energy_fk: float,
        solver: str,
        num_iterations: int,
    ) -> Variant:
        verdict, reason = quality.judge(self.settings.limits)
        if solver == "plain_fk":
            verdict = Verdict.FAIL
            reason = "; ".join(
                filter(None, ["neither solver gave a finite motion: this is plain forward kinematics", reason])
            )
        if self.source.closest_m > FAR_APART_M:
            note = f"the two never come closer than {self.source.closest_m:.2f} m: nothing to keep"
            verdict = Verdict.WARN if verdict == Verdict.PASS else verdict
            reason = "; ".join(filter(None, [note, reason]))
        return Variant(
            variation=variation,
            bone_scale=bone_scale,
            positions_m=points.reshape(-1, 2, BODY22.num_joints, 3),
            quality=quality,
            energy=energy,
            energy_fk=energy_fk,
            solver=solver,
            num_iterations=num_iterations,
            verdict=verdict,
            reason=reason,
        )
