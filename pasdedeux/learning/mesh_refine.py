"""`mesh_refine`: a few iterations of the interaction mesh's guaranteed descent, from where another model puts the pair.

With enough iterations it equals the solver; a start is worth the iterations that it saves.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.augmentation.energy import descend, fit_terms, laplacian_residual
from pasdedeux.augmentation.problem import MeshProblem
from pasdedeux.augmentation.source import complete_scales, points_of
from pasdedeux.augmentation.terms import build_problem, build_targets
from pasdedeux.augmentation.weights import FIXED
from pasdedeux.augmentation.windows import LONGEST_S, blend_weights, plan_windows
from pasdedeux.errors import InputError
from pasdedeux.fitting.levenberg import FitSettings
from pasdedeux.fitting.terms import PointTerm
from pasdedeux.learning.key_frames import KeyFrames
from pasdedeux.learning.model import Arrays, Config, Trained, Training, VariantModel, VariantRequest
from pasdedeux.settings import Settings

WindowProblems = tuple[list[slice], list[MeshProblem]]
"""Windows of a take, and the problem of each."""


class MeshRefineSettings(Settings):
    """Settings of the refinement: its start, and the number of iterations."""

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
    _ready: tuple[VariantRequest, WindowProblems] | None = field(default=None, repr=False)

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
        """Learn nothing; only the start learns."""
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
        """Return the motion after descent; a long take is refined in the solver's windows."""
        start_m = self.first.predict(request)
        return refine(request, self._problems(request), start_m, self.num_iterations).motion_m

    def _problems(self, request: VariantRequest) -> WindowProblems:
        """Return the windows of a take and their problems; those of the last take are kept."""
        source, last = request.source, self._ready
        if last is not None and last[0].source is source and last[0].solving == request.solving:
            return last[1]
        self._ready = (request, window_problems(request))
        return self._ready[1]


def window_problems(request: VariantRequest) -> WindowProblems:
    """Return the windows in which the solver solves a take, and the problem of each."""
    source = request.source
    windows = plan_windows(source.num_frames, source.rate_hz, LONGEST_S)
    parts = [source.window(window, request.contacts) for window in windows]
    return windows, [build_problem(part, request.solving, user_contacts=contacts) for part, contacts in parts]


@dataclass(frozen=True)
class Refined:
    """A motion after some steps of the mesh.

    Args:
        motion_m: (T, 2, 22, 3), metres, with exactly the requested bones.
        squared_residual: Mean squared Laplacian residual of each frame (T,), square metres.
    """

    motion_m: Array
    squared_residual: Array


def refine(
    request: VariantRequest,
    parts: WindowProblems,
    start_m: Array,
    num_iterations: int,
    key_frames: KeyFrames | None = None,
) -> Refined:
    """Make bones exact, and descend towards the interaction mesh of a take.

    Args:
        request: The take and the scales.
        parts: Windows of the take and their problems, see `window_problems`.
        start_m: A motion of both (T, 2, 22, 3), metres, with any bones.
        num_iterations: Steps, whether accepted or refused.
        key_frames: Poses that B is held at, within the limits of its bones.
    """
    source = request.source
    scales = complete_scales(source, request.bone_scale[None])
    start = points_of(request.with_exact_bones(start_m))
    settings = FitSettings(max_iterations=num_iterations, tolerance=0.0)
    held = np.full(source.positions_m.shape, np.nan)
    if key_frames is not None:
        held[key_frames.frames, 1] = key_frames.positions_m
    points, residual = np.zeros_like(start), np.zeros(source.num_frames)
    windows = parts[0]
    for window, problem, share in zip(*parts, blend_weights(windows), strict=True):
        targets = build_targets(problem, scales)
        terms = fit_terms(problem, targets, 0)
        if key_frames is not None:
            terms.append(PointTerm(points_of(held[window]), np.array(FIXED)))
        polished = descend(targets, 0, terms, start[window], settings).positions_m
        missed = laplacian_residual(problem, targets, polished[None] - targets.reference)[0]
        points[window] += share[:, None, None] * polished
        residual[window] += share * (missed**2).sum(axis=-1).mean(axis=-1)
    motion = points.reshape(source.positions_m.shape)
    return Refined(motion if len(windows) == 1 else request.with_exact_bones(motion), residual)
