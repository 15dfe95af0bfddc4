"""Settings of the stage `training`, and the parameters of its shards."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import Field, SerializeAsAny, model_validator

from pasdedeux.errors import InputError
from pasdedeux.learning.registry import DEFAULT_MODELS, MODELS, model_class
from pasdedeux.learning.splits import SPLIT_NAMES, SplitName
from pasdedeux.settings import Settings
from pasdedeux.skeletons import BODY22
from tasks.files.curation import CurationSettings
from tasks.stage import Parameters, with_fields
from tasks.stage.sweep import SweptParameters

SkeletonName = Literal["body22", "expi18"]
DeviceName = Literal["auto", "cpu", "cuda"]


_SETTINGS_OF_MODELS = {
    name: (model.settings, Field(model.settings(), description=f"Settings of {name}"))
    for name, model in MODELS.items()
    if model.settings.model_fields
}


class NamedModel(NamedTuple):
    """A model to train: its class, its settings, the name of the model that it starts from, the section, the seed."""

    kind: str
    settings: Settings
    start: str | None
    section: TrainingParameters
    seed: int


@with_fields(_SETTINGS_OF_MODELS)
class TrainingParameters(CurationSettings, SweptParameters):
    """Which models are trained on which splits, and how."""

    splits: tuple[SplitName, ...] = Field(("cross_scale",), description=f"Splits: {', '.join(SPLIT_NAMES)}")
    models: tuple[str, ...] = Field(
        DEFAULT_MODELS,
        min_length=1,
        description=f"Models: {', '.join(MODELS)}",
    )
    skeleton: SkeletonName = Field(
        "body22", description="Skeleton of the models: body22, or 18 joints as in ExPI, which follow from it (expi18)"
    )
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        (0,),
        min_length=1,
        description="Each network is trained with each of these, which change first parameters and batches (0: those "
        "of the study's seed); models of all but the first are kept as NAME_seedN",
    )
    device: DeviceName = Field(
        "auto",
        description="Where networks are trained: auto is a GPU where there is one; what that computes is not the same "
        "to the last bit",
    )
    test_takes: tuple[str, ...] = Field(
        (),
        description="Takes the splits across interactions test on, with all of their interactions, beside held-out; "
        "swapped ones learn from them",
    )

    @model_validator(mode="after")
    def _models_are_known(self) -> TrainingParameters:
        for name in self.models:
            if name not in MODELS:
                raise ValueError(f"training.models: '{name}' is not known; known models: {', '.join(MODELS)}")
        if taken := sorted(MODELS.keys() & self.sweep):
            raise ValueError(f"training.sweep: '{taken[0]}' is the name of a model")
        return self

    def named(self) -> dict[str, NamedModel]:
        """Return the requested models and those they start from, by the names they are stored under, starts first.

        Raises:
            InputError: What a model starts from is not known or not trained on its splits, models start from each
                other, or a model is not of the skeleton.
        """
        wanted = {seeded: model for name in self.models for seeded, model in self._models(name, name).items()}
        for name, section in self.swept().items():
            for kind in section.models:
                wanted |= section._models(kind, name if len(section.models) == 1 else f"{kind}_{name}")
        known = {seeded: model for name in MODELS for seeded, model in self._models(name, name).items()} | wanted
        models: dict[str, NamedModel] = {}
        for name in sorted(wanted):
            chain = [name]
            while (start := known[chain[-1]].start) is not None:
                if start in chain:
                    raise InputError(f"training: {' -> '.join([*chain, start])} start from each other in a circle")
                if start not in known:
                    raise InputError(f"training: '{chain[-1]}' starts from '{start}', which is not known")
                if missing := set(known[chain[-1]].section.splits).difference(known[start].section.splits):
                    raise InputError(
                        f"training: '{chain[-1]}' starts from '{start}', which is not trained on {min(missing)}"
                    )
                chain.append(start)
            models |= {name: known[name] for name in reversed(chain) if name not in models}
        free = [name for name, model in MODELS.items() if model.is_of_any_skeleton]
        for name, model in models.items():
            if (skeleton := model.section.skeleton) != BODY22.name and model.kind not in free:
                raise InputError(
                    f"training.models: '{name}' is of {BODY22.name} alone; of {skeleton} can be {', '.join(free)}"
                )
        return models

    def _models(self, kind: str, name: str) -> dict[str, NamedModel]:
        """Return a model with each seed, by name; one that is no network has one."""
        settings: Settings = getattr(self, kind) if kind in type(self).model_fields else model_class(kind).settings()
        start, seeds = model_class(kind).start(settings), self.seeds if model_class(kind).needs_torch else (0,)
        names = [name, *(f"{name}_seed{seed}" for seed in seeds[1:])]
        return {name: NamedModel(kind, settings, start, self, seed) for name, seed in zip(names, seeds, strict=True)}


class TrainingSegmentParameters(Parameters):
    """Parameters that determine one segment of a model's training on a split."""

    split: SplitName
    test_takes: tuple[str, ...]
    name: str = Field(description="Name that the model is kept under: its own, or that of its sweep")
    model: str
    settings: SerializeAsAny[Settings]
    segment: int
    # Not in the key for `body22`, so that models trained before there were other skeletons keep their keys.
    skeleton: SkeletonName = Field("body22", exclude_if=lambda name: name == BODY22.name)
    seed: int = Field(0, exclude_if=lambda seed: seed == 0)
    rejected: dict[str, str] = Field({}, exclude_if=lambda rejected: not rejected)
    device: DeviceName = Field("auto", exclude_if=lambda name: name == "auto")
