"""Settings of the stage `chains`, and which of them enter the key of a segment."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, ValidationError, model_validator

from pasdedeux.sampling import MoveKind
from tasks.densities import IMAGE_DENSITIES, DensityName
from tasks.stage import Parameters

__all__ = ["LIKELIHOOD_PARAMETERS", "ChainsParameters", "segment_parameters"]

KernelName = Literal["unbiased", "velocity"]

_PRIOR_PARAMETERS = ("sigma_p_m", "alpha", "most_invalid_angles", "joint_limits", "length_tolerance", "truncation")
_STEP_PARAMETERS = (
    "segment_draws",
    "thin",
    "root_rotation_rad",
    "root_position_m",
    "joint_rotation_rad",
    "length_change",
    "most_blocks",
    "moves",
    "num_warm_up",
    "target_acceptance",
)

LIKELIHOOD_PARAMETERS = (
    "num_views",
    "num_candidates",
    "num_hypotheses",
    "num_ranked",
    "sigma_l",
    "sigma_v_rad",
    "beta_m",
    "kernel",
    "reference",
    "left_out_quantile",
    "guided_share",
    "guided_stretch",
    "guided_width_m",
)


def segment_parameters(parameters: ChainsParameters, density: str) -> dict[str, Any]:
    """Return the settings that decide the draws of a density: only these enter a segment's key."""
    names = _PRIOR_PARAMETERS + _STEP_PARAMETERS + (LIKELIHOOD_PARAMETERS if density in IMAGE_DENSITIES else ())
    asked = parameters.model_dump(mode="json")
    return {"density": density, **{name: asked[name] for name in names}}


class ChainsParameters(Parameters):
    """What is sampled, how much, and with which steps."""

    densities: tuple[DensityName, ...] = Field(
        ("ic", "prior_only"),
        min_length=1,
        description="Densities: ic (interaction coordinates), cartesian, shape_context, prior_only, "
        "agreement (with grown seeds)",
    )
    starts: Literal["all", "seeds", "grown"] = Field(
        "all",
        description="Where chains start: the seeds and chosen grown ones, or only either of them",
    )
    num_chains: int = Field(2, ge=1, le=1000, description="Chains of each seed and density")
    num_draws: int = Field(500, ge=1, description="Draws kept of each chain; rounded up to whole segments")
    thin: int = Field(10, ge=1, description="Steps per kept draw")
    segment_draws: int = Field(250, ge=4, description="Draws of a segment, the unit that is stored and resumed")
    num_views: int = Field(20, ge=1, le=1000, description="Views of the fixed bank of each seed (m of eq. 6)")
    num_candidates: int = Field(500, ge=1, description="Annotations compared with each view, nearest by view")
    num_hypotheses: int = Field(4, ge=1, description="Likeliest view hypotheses of an annotation that are used")
    num_ranked: int = Field(64, ge=1, description="Shape contexts of a view compared, nearest by rigid residual")
    sigma_l: float = Field(0.01, gt=0, description="Bandwidth of the likelihood; 2 sigma_l^2 is in metres (eq. 9)")
    sigma_v_rad: float = Field(0.5, gt=0, description="Bandwidth of the view density (eq. 5), radians")
    beta_m: float = Field(0.05, gt=0, description="Edge length below which weights stop growing (eq. 8), metres")
    sigma_p_m: float = Field(0.05, gt=0, description="Bandwidth of the prior (eq. 2), metres")
    alpha: float = Field(10.0, ge=0, description="Weight of the squared penetration (eq. 2)")
    most_invalid_angles: int = Field(8, ge=0, description="Invalid joint angles beyond which a pair is impossible")
    joint_limits: Literal["table", "learned"] = Field(
        "table", description="Joint limits: the table's ranges, or also what the prior takes show (see priors)"
    )
    length_tolerance: float = Field(0.05, ge=0, lt=0.5, description="Greatest relative change of a bone's length")
    truncation: float = Field(100.0, gt=1, description="c of eq. 11: the density is cut below f0 / c and above c f0")
    reference: Literal["seed", "left_out"] = Field(
        "seed",
        description="f0 of eq. 11: the seed's density, or the range between it and that of a pair as likely as a real "
        "one that is not annotated",
    )
    left_out_quantile: float = Field(
        0.5, ge=0, le=1, description="How well that pair is annotated, as a quantile over left-out annotations"
    )
    root_rotation_rad: float = Field(0.02, ge=0, description="Step of a root's rotation, radians")
    root_position_m: float = Field(0.005, ge=0, description="Step of a root's position, metres")
    joint_rotation_rad: float = Field(0.04, ge=0, description="Step of a bone's rotation, radians")
    length_change: float = Field(0.005, ge=0, description="Step of a bone's relative length")
    most_blocks: int = Field(4, ge=1, le=34, description="Roots and bones moved by one step of `few`, at most")
    kernel: KernelName = Field(
        "unbiased", description="Steps: unbiased, or velocity, wider where nearby annotations move (eq. 12); ic only"
    )
    moves: dict[MoveKind, Annotated[float, Field(ge=0)]] = Field(
        {MoveKind.FEW: 1.0},
        min_length=1,
        description="How often steps move what together, as weights: few (bones or roots), limb, person, roots (both)",
    )
    guided_share: float = Field(
        0.0, ge=0, le=1, description="Share of steps towards or away from what a near annotation shows; 0: none"
    )
    guided_stretch: float = Field(
        0.3,
        gt=0,
        le=3,
        description="Guided steps change the distance to an annotation by a factor of at most its exp",
    )
    guided_width_m: float = Field(
        0.03, gt=0, description="Width of the preference for near annotations as guides, metres in the image"
    )
    num_warm_up: int = Field(
        50, ge=0, description="Draws before the first kept one, in which step sizes are learned; they are dropped"
    )
    target_acceptance: float = Field(0.234, gt=0, lt=1, description="Accepted share that step sizes are learned for")

    @model_validator(mode="after")
    def _something_moves(self) -> ChainsParameters:
        if not sum(self.moves.values()) > 0.0:
            raise ValueError("chains.moves gives every kind of move the weight 0; one must be drawn")
        scales = (self.root_rotation_rad, self.root_position_m, self.joint_rotation_rad)
        if (self.kernel == "velocity" or self.guided_share > 0.0) and not min(scales) > 0.0:
            wanted = "kernel = 'velocity'" if self.kernel == "velocity" else "guided_share"
            raise ValueError(
                f"chains.{wanted} needs positive root_rotation_rad, root_position_m and joint_rotation_rad"
            )
        return self

    @model_validator(mode="after")
    def _densities_are_named_once(self) -> ChainsParameters:
        if len(set(self.densities)) != len(self.densities):
            raise ValueError("chains.densities names a density twice")
        return self

    variants: dict[str, dict[str, Any]] = Field(
        {},
        description="Chains with other settings beside those of `densities`, by name: each has a `density` (default: "
        "the first) and any other setting of this section",
    )

    @model_validator(mode="after")
    def _variants_are_settings(self) -> ChainsParameters:
        for name in self.variants:
            if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or name in get_args(DensityName):
                raise ValueError(f"chains.variants: '{name}' is no name for a variant: small letters, and no density")
            self.variant(name)
        return self

    def variant(self, name: str) -> ChainsParameters:
        """Return the settings of a variant, with its one density.

        Raises:
            ValueError: One of its settings cannot be.
        """
        own = dict(self.variants[name])
        unknown = sorted(set(own) - set(type(self).model_fields) - {"density"} | set(own) & {"variants", "densities"})
        if unknown:
            raise ValueError(f"chains.variants.{name}: there is no setting '{unknown[0]}' of a variant")
        density = own.pop("density", self.densities[0])
        given = self.model_dump(exclude={"variants", "densities"})
        try:
            return type(self).model_validate({**given, "densities": (density,), **own})
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"])
            raise ValueError(f"chains.variants.{name}: {place}: {first['msg']}".replace(": : ", ": ")) from None
