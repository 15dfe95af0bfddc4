"""Settings of the stage `augmentation`: which variants are made, and how."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from pasdedeux.augmentation import (
    LIMB_GROUPS,
    PAPER_SCALES,
    POLISH,
    AugmentationSettings,
    BulkSettings,
    ContactSettings,
    FrameLimits,
    Limit,
    QualityLimits,
    UserContact,
    Variation,
    Weights,
    WindowSettings,
    bone_variations,
    drawn_variations,
    group_variations,
    population_variations,
    scale_grid,
    uniform_variations,
)
from pasdedeux.plausibility import JointLimits
from pasdedeux.skeletons import BODY22
from tasks.stage import Parameters, stream

__all__ = ["AugmentationParameters", "settings_of", "variations_of"]

Scale = Annotated[float, Field(ge=0.05, le=20.0)]
Girth = Annotated[float, Field(ge=0.2, le=5.0)]
PersonName = Literal["A", "B", "AB"]
KindName = Literal["uniform", "groups", "bones", "drawn", "population"]


class ScaleGrid(Parameters):
    """Scales from start to stop by step, without 1."""

    start: Scale = Field(0.75, description="Smallest scale")
    stop: Scale = Field(1.25, description="Greatest scale")
    step: float = Field(0.05, gt=0, description="Distance of neighbouring scales")

    @model_validator(mode="after")
    def _rises(self) -> ScaleGrid:
        if self.stop < self.start:
            raise ValueError("augmentation.grid.stop is below its start")
        return self


class DrawnScales(Parameters):
    """Scales drawn per bone, left and right alike."""

    count: int = Field(20, ge=0, le=100_000, description="Variants drawn per entry of persons")
    low: Scale = Field(0.75, description="Smallest scale of a bone")
    high: Scale = Field(1.25, description="Greatest scale of a bone")


class DrawnBodies(Parameters):
    """Bodies drawn as adults differ, overall size and proportions."""

    count: int = Field(20, ge=0, le=100_000, description="Variants drawn per entry of persons")
    correlation: float = Field(0.8, ge=0, le=1, description="Correlation of a bone's length with overall size")
    spread: float = Field(1.0, ge=0, le=3, description="Deviations over those of the published survey")


class StatedContact(Parameters):
    """A contact stated by the user, in place of what is found."""

    joint_a: str = Field(description="Joint of person A, by its name in body22")
    joint_b: str = Field(description="Joint of person B")
    start_frame: int = Field(0, ge=0, description="First frame")
    stop_frame: int = Field(description="Frame after the last")
    weight: float = Field(1.0, ge=0, le=10, description="1 in contact, 0 not in contact whatever the distance")

    @field_validator("joint_a", "joint_b")
    @classmethod
    def _is_a_joint(cls, joint: str) -> str:
        if joint not in BODY22.joint_names:
            raise ValueError(
                f"augmentation.contacts: joint '{joint}' is not in body22: {', '.join(BODY22.joint_names)}"
            )
        return joint

    @model_validator(mode="after")
    def _has_frames(self) -> StatedContact:
        if self.stop_frame <= self.start_frame:
            raise ValueError(f"augmentation.contacts: frames {self.start_frame} to {self.stop_frame} are none")
        return self


class VariationSet(Parameters):
    """One set of variations; the scales are those of the stage."""

    kinds: tuple[KindName, ...] = Field(
        ("uniform",), min_length=1, description="uniform, groups, bones, drawn, population"
    )
    persons: tuple[PersonName, ...] = Field(("A",), min_length=1, description="Who is scaled: A, B, AB (both alike)")
    groups: tuple[str, ...] = Field(tuple(LIMB_GROUPS), description="Limb groups of kind groups")

    @field_validator("groups")
    @classmethod
    def _groups_are_known(cls, groups: tuple[str, ...]) -> tuple[str, ...]:
        for group in groups:
            if group not in LIMB_GROUPS:
                raise ValueError(f"augmentation.groups: '{group}' is not known; known groups: {', '.join(LIMB_GROUPS)}")
        return groups


class WeightParameters(Parameters):
    """Weights of the terms; one set serves all takes."""

    laplacian: float = Field(Weights.laplacian, ge=0, description="Interaction mesh")
    smoothness: float = Field(Weights.smoothness, ge=0, description="Acceleration of the change against plain FK")
    reference: float = Field(Weights.reference, gt=0, description="Pull towards plain forward kinematics")
    contact_extremity: float = Field(Weights.contact_extremity, ge=0, description="Contacts of two hands or feet")
    contact_mixed: float = Field(Weights.contact_mixed, ge=0, description="Contacts of a hand or foot with the body")
    contact_limb: float = Field(Weights.contact_limb, ge=0, description="Contacts of an elbow or knee with the body")
    contact_torso: float = Field(Weights.contact_torso, ge=0, description="Contacts of two torsos")
    contact_direction: float = Field(
        Weights.contact_direction,
        ge=0,
        le=1,
        description="Share of body contacts that keeps direction, not only distance",
    )
    stance: float = Field(Weights.stance, ge=0, description="Horizontal velocity of stance feet")
    floor: float = Field(Weights.floor, ge=0, description="Height of joints near the floor")
    bending: float = Field(Weights.bending, ge=0, description="Bending of the spine")
    girdle: float = Field(Weights.girdle, ge=0, description="Rigidity of girdle and hips")
    clearance: float = Field(Weights.clearance, ge=0, description="Penetration of the partner beyond the source's")
    clearance_self: float = Field(
        Weights.clearance_self, ge=0, description="Penetration of one's own body beyond the source's and plain FK's"
    )
    fixed: float = Field(Weights.fixed, ge=0, description="Pull of a person held fixed towards the source")


class LimitParameters(Parameters):
    """From where on a figure is a warning, and from where on a failure: (warn, fail)."""

    bone_error_m: tuple[float, float] = Field((1e-6, 1e-4), description="Greatest bone length error, metres")
    contact_drift_extremity_m: tuple[float, float] = Field((0.005, 0.02), description="Hands and feet, metres")
    contact_drift_body_m: tuple[float, float] = Field((0.02, 0.06), description="Body on body, metres")
    foot_slide_m: tuple[float, float] = Field((0.001, 0.005), description="Sliding in stance per frame, metres")
    floor_penetration_m: tuple[float, float] = Field((0.02, 0.06), description="Depth under the floor, metres")
    penetration_m: tuple[float, float] = Field((0.01, 0.1), description="Depth in the partner, metres")
    spine_bend_rad: tuple[float, float] = Field((0.6, 1.2), description="Change of the spine's bends, radians")
    jerk_ratio: tuple[float, float] = Field((1.2, 2.0), description="Jerk over the source's")
    invalid_angles: tuple[float, float] = Field((0.2, 2.0), description="Joint angles out of range in a frame, mean")


class FrameLimitParameters(Parameters):
    """The same for the figures of one frame, of which those of a variant are means and percentiles: (warn, fail)."""

    bone_error_m: tuple[float, float] = Field((1e-6, 1e-4), description="Greatest bone length error, metres")
    contact_drift_m: tuple[float, float] = Field((0.03, 0.1), description="Mean over the frame's contacts, metres")
    foot_slide_m: tuple[float, float] = Field((0.01, 0.03), description="Sliding in stance, metres")
    floor_penetration_m: tuple[float, float] = Field((0.02, 0.06), description="Depth under the floor, metres")
    penetration_m: tuple[float, float] = Field((0.02, 0.12), description="Depth in the partner, metres")
    self_penetration_m: tuple[float, float] = Field((0.05, 0.2), description="Depth in oneself, metres")
    spine_bend_rad: tuple[float, float] = Field((0.8, 1.4), description="Change of the spine's bends, radians")
    jerk_ratio: tuple[float, float] = Field(
        (2.0, 5.0), description="Jerk over the greater of the source's, there or over the take"
    )


class AugmentationParameters(VariationSet):
    """Which variants are made, and how."""

    scales: tuple[Scale, ...] = Field(PAPER_SCALES, min_length=1, description="Scales of the variants")
    grid: ScaleGrid | None = Field(None, description="Scales as a grid, in place of the list")
    sets: tuple[VariationSet, ...] = Field((), description="Several sets in place of the one of kinds, persons, groups")
    drawn: DrawnScales = Field(
        default_factory=lambda: DrawnScales.model_validate({}), description="Scales of kind drawn"
    )
    population: DrawnBodies = Field(
        default_factory=lambda: DrawnBodies.model_validate({}), description="Bodies of kind population"
    )
    fixed_person: Literal["A", "B"] | None = Field(None, description="Person who keeps the source's motion")
    weights: WeightParameters = Field(
        default_factory=lambda: WeightParameters.model_validate({}), description="Weights of the terms"
    )
    limits: LimitParameters = Field(
        default_factory=lambda: LimitParameters.model_validate({}), description="Limits of pass, warn and fail"
    )
    frame_limits: FrameLimitParameters = Field(
        default_factory=lambda: FrameLimitParameters.model_validate({}), description="The same for single frames"
    )
    girth: tuple[Girth, Girth] = Field((1.0, 1.0), description="Thickness of A's and B's body over the source's")
    is_joint_limited: bool = Field(False, description="Check joint angles against the published ranges")
    contacts: dict[str, tuple[StatedContact, ...]] = Field(
        {}, description="Contacts stated by the user, by take, in place of what is found"
    )
    contact_m: tuple[float, float] = Field((0.2, 0.3), description="Contact distance: full weight up to, none from")
    mesh_smoothing_s: float = Field(0.25, ge=0, description="Averaging of the mesh over time; 0 as published")
    solver: Literal["bulk", "polished", "descent"] = Field(
        "bulk",
        description="bulk (with descent as fallback), polished (every variant ends with descent) or descent alone",
    )
    num_iterations: int = Field(24, ge=1, description="Iterations of the bulk solver")
    window_s: float = Field(30.0, ge=10, description="Longer takes are solved in overlapping windows of this length")
    variants_per_shard: int = Field(32, ge=1, le=1000, description="Variants of a take in one unit of work")


def variations_of(parameters: AugmentationParameters, seed: int, take_id: str) -> list[Variation]:
    """Return the variations asked for, each once; those drawn come from the take's own stream."""
    grid = parameters.grid
    scales: Sequence[float] = scale_grid(grid.start, grid.stop, grid.step) if grid else parameters.scales
    found: list[Variation] = []
    for chosen in parameters.sets or (parameters,):
        for kind in chosen.kinds:
            if kind == "uniform":
                found += uniform_variations(scales, chosen.persons)
            elif kind == "groups":
                found += group_variations(scales, chosen.persons, chosen.groups)
            elif kind == "bones":
                found += bone_variations(scales, chosen.persons)
            elif kind == "population":
                for persons in chosen.persons:
                    bodies = parameters.population
                    generator = stream(seed, "augmentation", take_id, "population", persons)
                    found += population_variations(
                        generator,
                        bodies.count,
                        correlation=bodies.correlation,
                        spread=bodies.spread,
                        persons=persons,
                    )
            else:
                for persons in chosen.persons:
                    drawn = parameters.drawn
                    generator = stream(seed, "augmentation", take_id, persons)
                    found += drawn_variations(generator, drawn.count, low=drawn.low, high=drawn.high, persons=persons)
    return list({variation.variant_id: variation for variation in found}.values())


def settings_of(parameters: AugmentationParameters, take_id: str) -> AugmentationSettings:
    """Return the settings of the numerics for a take."""
    limits, frame_limits = parameters.limits.model_dump(), parameters.frame_limits.model_dump()
    settings = AugmentationSettings(
        weights=Weights(**parameters.weights.model_dump()),
        contacts=ContactSettings(contact_m=parameters.contact_m),
        limits=QualityLimits(**{name: Limit(*pair) for name, pair in limits.items()}),
        frame_limits=FrameLimits(**{name: Limit(*pair) for name, pair in frame_limits.items()}),
        girth=parameters.girth,
        joint_limits=JointLimits.published() if parameters.is_joint_limited else None,
        user_contacts=tuple(UserContact(**stated.model_dump()) for stated in parameters.contacts.get(take_id, ())),
        bulk=BulkSettings(num_iterations=parameters.num_iterations, is_single_precision=True),
        is_bulk=parameters.solver != "descent",
        mesh_smoothing_s=parameters.mesh_smoothing_s,
        windows=WindowSettings(longest_s=parameters.window_s),
        fixed_person=None if parameters.fixed_person is None else "AB".index(parameters.fixed_person),
    )
    return replace(settings, descent=POLISH, fallback_residual_m=0.0) if parameters.solver == "polished" else settings
