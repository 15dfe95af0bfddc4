"""Augmentation of a take: variants solved in bulk, every one measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.augmentation.exact_bones import project_to_bones
from pasdedeux.augmentation.quality import FRAME_LIMITS, FrameQuality, Quality, QualityMeter
from pasdedeux.augmentation.settings import AugmentationSettings
from pasdedeux.augmentation.source import Source, complete_scales, points_of, reference_motion, scaled_lengths
from pasdedeux.augmentation.variations import Variation
from pasdedeux.augmentation.window_solver import SOLVERS, WindowSolver
from pasdedeux.augmentation.windows import LONGEST_S, OVERLAP_S, blend_weights, plan_windows
from pasdedeux.figure import Limits
from pasdedeux.interaction.known_contacts import UserContact, check_contacts
from pasdedeux.verdict import Level, Verdict

MODEL = "model"
"""Solver of a variant that a trained model made."""
FAR_APART_M = 1.0
"""People whose joints never come closer than this do not interact; their variants are solved nevertheless."""
_FAILED = 2
"""Verdict of a frame that failed."""
_LONGEST_FRAMES = 1200
"""Windows of a fast take are shorter."""
_FRAME_BYTES = 200_000
"""Memory per frame of a prepared window of two people: terms, mesh, factors of both rates."""
_KEPT_BYTES = 300_000_000
"""Most memory for prepared windows of a take."""


@dataclass(frozen=True)
class Variant:
    """One solved variant.

    Args:
        variation: Its name and the requested scales.
        bone_scale: The scales used (P, 22): as requested, the root's following the legs.
        positions_m: Motion of all people (T, P, 22, 3), metres; always finite.
        quality: Its figures.
        frames: Its figures frame by frame.
        frame_verdicts: Verdict of each frame (T,): 0 pass, 1 warn, 2 fail.
        energy: Energy of the motion; NaN where a model made it.
        energy_fk: Energy of plain forward kinematics, which is never lower.
        estimated_gap_m: Estimate of the mean joint distance from the optimum, metres; None unless `solver` is `bulk`.
        solver: `bulk`, `polished`, `plain_fk` when bulk failed, or `model`.
        num_iterations: Iterations of the solver.
        verdict: Its verdict with reasons.
    """

    variation: Variation
    bone_scale: Array
    positions_m: Array
    quality: Quality
    frames: FrameQuality
    frame_verdicts: Integers
    energy: float
    energy_fk: float
    estimated_gap_m: float | None
    solver: str
    num_iterations: int
    verdict: Verdict


class Augmenter:
    """A take prepared for any number of variants: mesh, terms and factor are computed once.

    A long take is solved in windows, of which only the last few stay in memory.
    """

    def __init__(
        self,
        source: Source,
        settings: AugmentationSettings | None = None,
        *,
        user_contacts: Sequence[UserContact] = (),
        frame_limits: Limits | None = None,
    ) -> None:
        self.settings = settings or AugmentationSettings()
        if self.settings.floor_m is not None:
            source = replace(source, ground_m=self.settings.floor_m)
        self.source = source
        longest_s = min(LONGEST_S, max(_LONGEST_FRAMES / source.rate_hz, 2.0 * OVERLAP_S))
        self._windows = plan_windows(source.num_frames, source.rate_hz, longest_s)
        check_contacts(
            user_contacts,
            name=source.name,
            num_frames=source.num_frames,
            num_people=source.num_people,
            objects=source.objects,
        )
        self._user_contacts = user_contacts
        self._frame_limits = FRAME_LIMITS if frame_limits is None else frame_limits
        self.meter = QualityMeter(source, user_contacts)
        self._ready: dict[int, WindowSolver] = {}

    def solve(self, variations: Sequence[Variation]) -> list[Variant]:
        """Solve a batch of variations; a few dozen at a time are fastest."""
        if not variations:
            return []
        bone_scale = complete_scales(self.source, np.stack([variation.bone_scale for variation in variations]))
        parts = [self._solver(number).solve(bone_scale) for number in range(len(self._windows))]
        lengths = scaled_lengths(self.source, bone_scale)
        shares = blend_weights(self._windows)
        variants = []
        for index, variation in enumerate(variations):
            points = parts[0].positions[index]
            laplacian = parts[0].squared_residual[index]
            if len(parts) > 1:
                points = np.zeros((self.source.num_frames, self.source.num_points, 3))
                laplacian = np.zeros(self.source.num_frames)
                for window, part, share in zip(self._windows, parts, shares, strict=True):
                    points[window] += share[:, None, None] * part.positions[index]
                    laplacian[window] += share * part.squared_residual[index]
                points = project_to_bones(points[None], lengths[index : index + 1])[0]
            solver = max((part.solvers[index] for part in parts), key=SOLVERS.index)
            variants.append(
                self.assess(
                    variation,
                    points.reshape(self.source.positions_m.shape),
                    squared_residual=laplacian,
                    energy=float(sum(part.energy[index] for part in parts)),
                    energy_fk=float(sum(part.energy_fk[index] for part in parts)),
                    estimated_gap_m=(
                        max(float(part.estimated_gap_m[index]) for part in parts) if solver == "bulk" else None
                    ),
                    solver=solver,
                    num_iterations=max(part.num_iterations[index] for part in parts),
                )
            )
        return variants

    def assess(
        self, variation: Variation, positions_m: Array, *, squared_residual: Array | None = None, **solved: Any
    ) -> Variant:
        """Measure and judge a motion, of the solver or of a model.

        Args:
            variation: The variation that it realises.
            positions_m: The motion (T, P, 22, 3), metres.
            squared_residual: Mean squared Laplacian residual of each frame (T,), square metres; 0 where not given.
            solved: Fields of `Variant` that say how it was solved; without them it counts as made by a model.
        """
        bone_scale = complete_scales(self.source, variation.bone_scale[None])
        quality, frames = self.meter.measure(
            points_of(positions_m),
            reference=points_of(reference_motion(self.source, bone_scale))[0],
            bone_scale=bone_scale[0],
            lengths_m=scaled_lengths(self.source, bone_scale)[0],
            squared_residual=np.zeros(self.source.num_frames) if squared_residual is None else squared_residual,
        )
        frame_verdicts = frames.judge(self._frame_limits)
        values: dict[str, Any] = {
            "energy": np.nan,
            "energy_fk": np.nan,
            "estimated_gap_m": None,
            "solver": MODEL,
            "num_iterations": 0,
        }
        values |= solved
        return Variant(
            variation=variation,
            bone_scale=bone_scale[0],
            positions_m=positions_m,
            quality=quality,
            frames=frames,
            frame_verdicts=frame_verdicts,
            verdict=self._judge(quality, frame_verdicts, values["solver"]),
            **values,
        )

    def _solver(self, number: int) -> WindowSolver:
        if number not in self._ready:
            window = self._windows[number]
            each = _FRAME_BYTES * (self.source.num_people / 2) ** 2 * (window.stop - window.start)
            while self._ready and (len(self._ready) + 1) * each > _KEPT_BYTES:
                self._ready.pop(next(iter(self._ready)))
            source, contacts = self.source.window(window, self._user_contacts)
            self._ready[number] = WindowSolver(source, self.settings, contacts)
        return self._ready[number]

    def _judge(self, quality: Quality, frame_verdicts: Integers, solver: str) -> Verdict:
        verdict = quality.judge(self.settings.limits, is_alone=self.source.num_people == 1)
        level, reasons = verdict.level, [verdict.reason] if verdict.reason else []
        if solver == "plain_fk":
            level = Level.FAIL
            reasons.insert(0, "the solver gave nothing finite that is better: this is plain forward kinematics")
        failed = np.flatnonzero(frame_verdicts == _FAILED)
        if level is not Level.PASS and len(failed):
            reasons.append(f"{len(failed)} of {len(frame_verdicts)} frames fail, the first is {failed[0]}")
        if self.source.ground_m is None and not self.meter.has_stances:
            level = Level.WARN if level is Level.PASS else level
            reasons.insert(0, "nobody ever stands: the floor is taken to be where the lowest feet are; say floor_m")
        closest_m = self.source.closest_m
        if closest_m is not None and closest_m > FAR_APART_M:
            level = Level.WARN if level is Level.PASS else level
            who = "the two" if self.source.num_people == 2 else "people"
            reasons.insert(0, f"{who} never come closer than {closest_m:.2f} m: nothing to keep")
        return replace(verdict, level=level, reason="; ".join(reasons))
