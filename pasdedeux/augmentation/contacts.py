"""Contacts, stance feet and joints near the floor, found in the source; every weight fades, nothing switches."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator, model_validator
from scipy.ndimage import gaussian_filter1d

from pasdedeux.augmentation.source import Source
from pasdedeux.errors import InputError
from pasdedeux.interaction.contacts import joint_pair_distances
from pasdedeux.plausibility import body_height_m, capsule_model
from pasdedeux.settings import Settings
from pasdedeux.skeletons import BODY22

__all__ = [
    "FEET",
    "BodyPart",
    "UserContact",
    "added_by_girth",
    "body_parts",
    "check_contacts",
    "contact_class",
    "contact_weights",
    "fade",
    "floor_weights",
    "joint_radii_m",
    "stance_weights",
]

Array = npt.NDArray[np.float64]

FEET = BODY22.indices(["left_ankle", "left_toe", "right_ankle", "right_toe"])
"""Joints of the feet of one person."""


class BodyPart(IntEnum):
    """How exactly a joint's contacts are felt: hands and feet most, the torso least."""

    TORSO = 0
    LIMB = 1
    EXTREMITY = 2


_EXTREMITIES = BODY22.indices(["left_wrist", "right_wrist", *(BODY22.joint_names[i] for i in FEET)])
_LIMBS = [limb[1] for limb in BODY22.limbs]


_STANCE_SPEED_M_S = (0.15, 0.45)
_STANCE_HEIGHT_M = (0.05, 0.12)
_FLOOR_HEIGHT_M = (0.04, 0.15)
"""Fades: a foot slower and lower than the first stands, one beyond the second does not; likewise for the floor."""
_SMOOTHING_S = 0.3
"""Standard deviation of the averaging of all weights over time."""


class UserContact(Settings):
    """A contact stated by the user, which replaces what is found."""

    joint_a: str = Field(description="Joint of person A, by its name in body22")
    joint_b: str = Field(description="Joint of person B")
    start_frame: int = Field(0, ge=0, description="First frame")
    stop_frame: int = Field(description="Frame after the last")
    weight: float = Field(1.0, ge=0, le=10, description="1 in contact, 0 not in contact whatever the distance")

    @field_validator("joint_a", "joint_b")
    @classmethod
    def _is_a_joint(cls, joint: str) -> str:
        if joint not in BODY22.joint_names:
            raise ValueError(f"joint '{joint}' is not in body22: {', '.join(BODY22.joint_names)}")
        return joint

    @model_validator(mode="after")
    def _has_frames(self) -> UserContact:
        if self.stop_frame <= self.start_frame:
            raise ValueError(f"frames {self.start_frame} to {self.stop_frame} are none")
        return self

    def within(self, start: int, stop: int) -> UserContact | None:
        """Return the part of it in frames `start` to `stop`, counted from `start`; None where there is none."""
        first, last = max(self.start_frame, start), min(self.stop_frame, stop)
        changed = {"start_frame": first - start, "stop_frame": last - start}
        return self.model_copy(update=changed) if first < last else None


def fade(value: Array, full: float, none: float) -> Array:
    """Return 1 up to `full`, 0 from `none` on, and a smooth step (3t^2 - 2t^3) between."""
    t = np.clip((none - value) / (none - full), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def body_parts() -> npt.NDArray[np.int64]:
    """Return the body part (22,) of each joint of body22."""
    parts = np.full(BODY22.num_joints, int(BodyPart.TORSO))
    parts[_LIMBS] = int(BodyPart.LIMB)
    parts[_EXTREMITIES] = int(BodyPart.EXTREMITY)
    return parts


def contact_class() -> npt.NDArray[np.int64]:
    """Return the class of each joint pair (22, 22): 2 both are hands or feet, 1 one of them is, 0 body on body."""
    is_extremity = body_parts() == BodyPart.EXTREMITY
    return np.asarray(is_extremity[:, None].astype(np.int64) + is_extremity[None, :])


def check_contacts(source: Source, user: Sequence[UserContact]) -> None:
    """Refuse contacts stated by the user for frames that the take does not have.

    Raises:
        InputError: A contact lasts longer than the take.
    """
    for contact in user:
        if contact.stop_frame > source.num_frames:
            raise InputError(
                f"{source.name}: contact {contact.joint_a}-{contact.joint_b} over frames {contact.start_frame} to "
                f"{contact.stop_frame}; allowed are frames within 0 to {source.num_frames}"
            )


def contact_weights(source: Source, contact_m: tuple[float, float], user: Sequence[UserContact] = ()) -> Array:
    """Return how much each pair of joints is in contact (frame, 22 of A, 22 of B), from 0 to 1 before grading.

    Args:
        source: The template.
        contact_m: Distance of joints: full weight up to the first, none from the second on, metres.
        user: Contacts that replace what is found.
    """
    weights = fade(joint_pair_distances(source.positions_m), *contact_m)
    for contact in user:
        at = (BODY22.index(contact.joint_a), BODY22.index(contact.joint_b))
        weights[contact.start_frame : contact.stop_frame, *at] = contact.weight
    return _smooth(weights, source)


def joint_radii_m(source: Source) -> Array:
    """Return how thick each person is at each joint (2, 22), metres: radius of the thickest capsule that ends there."""
    model = capsule_model(BODY22)
    bones = model.radii_m(body_height_m(BODY22, source.lengths_m))
    radii = np.array(bones)
    for parent, child in BODY22.bones:
        radii[:, parent] = np.maximum(radii[:, parent], bones[:, child])
    return radii


def added_by_girth(source: Source, girth: tuple[float, float]) -> Array:
    """Return what the new girth adds to the distance of each joint pair (22, 22), metres."""
    radii = joint_radii_m(source) * (np.array(girth)[:, None] - 1.0)
    return np.asarray(radii[0, :, None] + radii[1, None, :])


def stance_weights(source: Source) -> Array:
    """Return how much each joint of the feet stands (frame, 2, 4), 1 standing: slow and low in the source."""
    feet = source.positions_m[:, :, FEET]
    velocity = np.gradient(feet, axis=0) * source.rate_hz if source.num_frames > 1 else np.zeros(feet.shape)
    speed = np.linalg.norm(velocity[..., [0, 2]], axis=-1)
    standing = fade(speed, *_STANCE_SPEED_M_S) * fade(_height(source)[:, :, FEET], *_STANCE_HEIGHT_M)
    return _smooth(standing, source)


def floor_weights(source: Source) -> Array:
    """Return how near the floor each joint is in the source (frame, 2, 22), 1 on it."""
    return _smooth(fade(_height(source), *_FLOOR_HEIGHT_M), source)


def _height(source: Source) -> Array:
    """Height above the floor (frame, 2, 22); an ankle's is taken above its own height when standing flat."""
    height = source.positions_m[..., 1] - source.floor_m[:, None]
    ankles = BODY22.indices(["left_ankle", "right_ankle"])
    height[:, :, ankles] -= source.flat_ankle_m[:, None]
    return np.asarray(height)


def _smooth(weights: Array, source: Source) -> Array:
    if source.num_frames < 2:
        return weights
    sigma = _SMOOTHING_S * source.rate_hz
    return np.asarray(gaussian_filter1d(weights, sigma, axis=0, mode="nearest", truncate=3.0))
