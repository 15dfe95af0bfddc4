"""Settings of the stage `training`, and the parameters of its shards."""

from __future__ import annotations

from typing import Literal, NamedTuple

from pydantic import Field, SerializeAsAny, model_validator

from pasdedeux.errors import InputError
from pasdedeux.learning.registry import DEFAULT_MODELS, MODELS, model_class
from pasdedeux.learning.splits import SPLIT_NAMES, SplitName
from pasdedeux.settings import Settings
from pasdedeux.skeletons import BODY22
from tasks.curation import CurationSettings
from tasks.stage import Parameters, with_fields
from tasks.sweep import SweptParameters

SkeletonName = Literal["body22", "expi18"]
DeviceName = Literal["auto", "cpu", "cuda"]


_SETTINGS_OF_MODELS = {
    name: (model.settings, Field(model.settings(), description=f"Settings of {name}"))
    for name, model in MODELS.items()
    if model.settings.model_fields
}


class NamedModel(NamedTuple):
    """A model to train: which one it is, its settings, the name of the one that it starts from, and the section."""

    kind: str
    settings: Settings
    start: str | None
    section: TrainingParameters


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
    seed: int = Field(0, ge=0, description="Other first parameters and batches; 0: those of the study's seed")
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
        """Return the models asked for and those they start from by the names they are kept under, starts first.

        Raises:
            InputError: What a model starts from is not known or not trained on its splits, models start from each
                other, or a model is not of the skeleton.
        """
        known = {name: self._model(name) for name in MODELS}
        for name, own in self.swept().items():
            known |= {name if len(own.models) == 1 else f"{one}_{name}": own._model(one) for one in own.models}
        found: dict[str, NamedModel] = {}
        for name in sorted({*self.models, *(known.keys() - MODELS.keys())}):
            chain = [name]
            while (start := known[chain[-1]].start) is not None:
                if start in chain:
                    raise InputError(f"training: {' -> '.join([*chain, start])} build on each other")
                if start not in known:
                    raise InputError(f"training: '{chain[-1]}' starts from '{start}', which is not known")
                if missing := set(known[chain[-1]].section.splits).difference(known[start].section.splits):
                    raise InputError(
                        f"training: '{chain[-1]}' starts from '{start}', which is not trained on {min(missing)}"
                    )
                chain.append(start)
            found |= {one: known[one] for one in reversed(chain) if one not in found}
        free = [name for name, model in MODELS.items() if model.is_of_any_skeleton]
        for name, model in found.items():
            if (skeleton := model.section.skeleton) != BODY22.name and model.kind not in free:
                raise InputError(
                    f"training.models: '{name}' is of {BODY22.name} alone; of {skeleton} can be {', '.join(free)}"
                )
        return found

    def _model(self, kind: str) -> NamedModel:
        settings: Settings = getattr(self, kind) if kind in type(self).model_fields else model_class(kind).settings()
        return NamedModel(kind, settings, model_class(kind).start(settings), self)


class SegmentParameters(Parameters):
    """What decides one segment of a model's training on a split."""

    split: SplitName
    test_takes: tuple[str, ...]
    name: str = Field(description="Name that the model is kept under: its own, or that of its sweep")
    model: str
    settings: SerializeAsAny[Settings]
    segment: int
    # Not in the key for `body22`: what was trained before there was another skeleton stays as it is.
    skeleton: SkeletonName = Field("body22", exclude_if=lambda name: name == BODY22.name)
    seed: int = Field(0, exclude_if=lambda seed: seed == 0)
    rejected: dict[str, str] = Field({}, exclude_if=lambda rejected: not rejected)
    device: DeviceName = Field("auto", exclude_if=lambda name: name == "auto")
