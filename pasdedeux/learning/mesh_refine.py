"""`mesh_refine`: a few iterations of the interaction mesh's guaranteed descent, from where another model puts the pair.

With enough iterations it is the solver itself; a start is worth as much as the iterations it saves.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.augmentation.energy import descend, fit_terms
from pasdedeux.augmentation.problem import Problem
from pasdedeux.augmentation.source import complete_scales, points_of
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.windows import LONGEST_S, blend_weights, plan_windows
from pasdedeux.errors import InputError
from pasdedeux.fitting.levenberg import FitSettings
from pasdedeux.learning.model import Arrays, Config, Trained, Training, VariantModel, VariantRequest
from pasdedeux.settings import Settings


class MeshRefineSettings(Settings):
    """From where, and how far."""

    start: str = Field("naive_fk", description="Model, or form of one, that gives the start")
    num_iterations: int = Field(4, ge=0, le=1000, description="Iterations, whether accepted or refused")


@dataclass
class MeshRefineModel(VariantModel):
    """A start, and how many iterations follow.

    Args:
        first: The model that gives the start.
        num_iterations: Iterations.
    """

    name = "mesh_refine"
    settings = MeshRefineSettings
    is_trained = False
    has_exact_bones = True

    first: VariantModel
    num_iterations: int
    _ready: tuple[VariantRequest, list[slice], list[Problem]] | None = field(default=None, repr=False)

    @property
    def built_on(self) -> VariantModel:
        """The model that gives the start."""
        return self.first

    @classmethod
    def start(cls, settings: MeshRefineSettings) -> str:
        """Return the model that gives the start."""
        return settings.start

    @classmethod
    def train(cls, training: Training) -> Trained:
        """Learn nothing beside what the start learned."""
        assert training.start is not None
        return Trained(cls(training.start, training.options(MeshRefineSettings).num_iterations))

    def config(self) -> Config:
        """Return the number of iterations."""
        return {"num_iterations": self.num_iterations}

    @classmethod
    def restore(cls, config: Config, arrays: Arrays, built_on: VariantModel | None = None) -> VariantModel:
        """Make the model from its number of iterations and its start."""
        if built_on is None:
            raise InputError("mesh_refine: the model it starts from is missing")
        return cls(built_on, MeshRefineSettings.model_validate(config).num_iterations)

    def predict(self, request: VariantRequest) -> Array:
        """Return where descent comes to; a long take is refined in the solver's windows."""
        source = request.source
        windows, problems = self._problems(request)
        scales = complete_scales(source, request.bone_scale[None])
        start = points_of(request.with_exact_bones(self.first.predict(request)))
        settings = FitSettings(max_iterations=self.num_iterations, tolerance=0.0)
        points = np.zeros_like(start)
        for window, problem, share in zip(windows, problems, blend_weights(windows), strict=True):
            targets = build_targets(problem, scales)
            found = descend(targets, 0, fit_terms(problem, targets, 0), start[window], settings)
            points[window] += share[:, None, None] * found.positions_m
        motion = points.reshape(source.positions_m.shape)
        return motion if len(windows) == 1 else request.with_exact_bones(motion)

    def _problems(self, request: VariantRequest) -> tuple[list[slice], list[Problem]]:
        """Return the windows of a take and their problems; those of the last take are kept."""
        source, last = request.source, self._ready
        if last is not None and last[0].source is source and last[0].solving == request.solving:
            return last[1:]
        self._ready = (request, *window_problems(request))
        return self._ready[1:]


def window_problems(request: VariantRequest) -> tuple[list[slice], list[Problem]]:
    """Return the windows in which the solver solves a take, and the problem of each."""
    source = request.source
    windows = plan_windows(source.num_frames, source.rate_hz, LONGEST_S)
    parts = [source.window(window, request.contacts) for window in windows]
    return windows, [build_problem(part, request.solving, user_contacts=contacts) for part, contacts in parts]
