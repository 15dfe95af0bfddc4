"""Settings of the stage `training`, and what its shards are told."""

from __future__ import annotations

import re
from typing import Any, Literal

from pydantic import Field, SerializeAsAny, ValidationError, create_model, model_validator

from pasdedeux.learning import DEFAULT_MODELS, MODELS, SPLIT_NAMES, SplitName, model_class
from pasdedeux.settings import Settings
from pasdedeux.skeletons import BODY22
from tasks.stage import Parameters

SkeletonName = Literal["body22", "expi18"]


def _with_settings_of_models(section: type[Parameters]) -> Any:
    """Return a section with the settings of every model that has some, under its name."""
    fields: dict[str, Any] = {
        name: (model.settings, Field(model.settings(), description=f"Settings of {name}"))
        for name, model in MODELS.items()
        if model.settings.model_fields
    }
    made = create_model(section.__name__, __base__=section, __module__=section.__module__, **fields)
    made.__doc__ = section.__doc__
    return made


@_with_settings_of_models
class TrainingParameters(Parameters):
    """Which models are trained on which splits, and how."""

    splits: tuple[SplitName, ...] = Field(("cross_scale",), description=f"Splits: {', '.join(SPLIT_NAMES)}")
    models: tuple[str, ...] = Field(
        DEFAULT_MODELS,
        min_length=1,
        description=f"Models, or names of `forms`: {', '.join(MODELS)}",
    )
    networks: bool = Field(
        True,
        description="Train the models that need torch; false leaves them out, with what builds on them, and says so",
    )
    skeleton: SkeletonName = Field(
        "body22", description="Skeleton of the models: body22, or 18 joints as in ExPI, which follow from it (expi18)"
    )
    test_takes: tuple[str, ...] = Field(
        (),
        description="Takes the splits across interactions test on, with all of their interactions, beside held-out; "
        "swapped ones learn from them",
    )
    forms: dict[str, dict[str, Any]] = Field(
        {},
        description="Models with other settings, by name: each has a `model` and any of that model's settings",
    )

    @model_validator(mode="after")
    def _forms_are_models(self) -> TrainingParameters:
        for name in self.forms:
            if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or name in MODELS:
                raise ValueError(f"training.forms: '{name}' is no name for a form: small letters, and no model's name")
            self.settings_of(name)
        known = (*MODELS, *self.forms)
        for name in self.models:
            if name not in known:
                raise ValueError(f"training.models: '{name}' is not known; known models: {', '.join(known)}")
        for name in known:
            self._with_starts(name, ())
        free = [name for name, model in MODELS.items() if model.is_of_any_skeleton]
        for name in self.in_order() if self.skeleton != BODY22.name else ():
            if self.kind_of(name) not in free:
                raise ValueError(
                    f"training.models: '{name}' is of {BODY22.name} alone; of {self.skeleton} can be {', '.join(free)}"
                )
        return self

    def kind_of(self, name: str) -> str:
        """Return the registered model that a name of `models` stands for."""
        return str(self.forms[name].get("model", "")) if name in self.forms else name

    def settings_of(self, name: str) -> Settings:
        """Return the settings of a model or of one of its forms.

        Raises:
            ValueError: A form names no model, or a setting that its model does not have or cannot have.
        """
        kind = self.kind_of(name)
        if kind not in MODELS:
            raise ValueError(f"training.forms.{name}.model: '{kind}' is not known; known models: {', '.join(MODELS)}")
        base: Settings = getattr(self, kind) if kind in type(self).model_fields else model_class(kind).settings()
        if name not in self.forms:
            return base
        own = {key: value for key, value in self.forms[name].items() if key != "model"}
        try:
            return type(base).model_validate({**base.model_dump(), **own})
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"])
            raise ValueError(f"training.forms.{name}.{place}: {first['msg']}") from None

    def start_of(self, name: str) -> str | None:
        """Return the name of the model that one builds on."""
        return model_class(self.kind_of(name)).start(self.settings_of(name))

    def in_order(self) -> list[str]:
        """Return the models asked for and those they build on, each after what it builds on."""
        found: list[str] = []
        for name in sorted(self.models):
            found += [one for one in self._with_starts(name, ()) if one not in found]
        return found

    def _with_starts(self, name: str, seen: tuple[str, ...]) -> tuple[str, ...]:
        if name in seen:
            raise ValueError(f"training: {' -> '.join((*reversed(seen), name))} build on each other")
        if name not in MODELS and name not in self.forms:
            raise ValueError(f"training: '{seen[0]}' starts from '{name}', which is not known")
        start = self.start_of(name)
        return (name,) if start is None else (*self._with_starts(start, (name, *seen)), name)


class SegmentParameters(Parameters):
    """What decides one segment of a model's training on a split."""

    split: SplitName
    test_takes: tuple[str, ...]
    name: str = Field(description="Name that the model is kept under: its own, or that of its form")
    model: str
    settings: SerializeAsAny[Settings]
    segment: int
    # Left out of the key for `body22`: what was trained before there was another skeleton stays as it is.
    skeleton: SkeletonName = Field("body22", exclude_if=lambda name: name == BODY22.name)


class LeftOutParameters(Parameters):
    """A model that needs torch in a study that goes without networks."""

    name: str
