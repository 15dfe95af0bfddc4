"""Contacts, stance feet and joints near the floor, found in the source; every weight fades, nothing switches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from pasdedeux.augmentation.source import Source
from pasdedeux.errors import InputError
from pasdedeux.plausibility import body_height_m, capsule_model
from pasdedeux.skeletons import BODY22

__all__ = [
    "FEET",
    "BodyPart",
    "ContactSettings",
    "UserContact",
    "body_parts",
    "check_contacts",
    "contact_class",
    "contact_distances",
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
_LIMBS = BODY22.indices(["left_elbow", "right_elbow", "left_knee", "right_knee"])


@dataclass(frozen=True)
class ContactSettings:
    """What counts as contact, stance and floor; distances in metres, speeds in metres a second, times in seconds.

    Each pair of numbers is a fade: full weight up to the first, none from the second on, smooth between.
    """

    contact_m: tuple[float, float] = (0.2, 0.3)
    stance_speed_m_s: tuple[float, float] = (0.15, 0.45)
    stance_height_m: tuple[float, float] = (0.05, 0.12)
    floor_height_m: tuple[float, float] = (0.04, 0.15)
    smoothing_s: float = 0.3

    def __post_init__(self) -> None:
        """Check that every fade rises."""
        for name in ("contact_m", "stance_speed_m_s", "stance_height_m", "floor_height_m"):
            full, none = getattr(self, name)
            if not 0 <= full < none:
                raise InputError(f"{name} is ({full:g}, {none:g}): the fade must end beyond its start, both from 0")
        if not self.smoothing_s >= 0:
            raise InputError(f"smoothing_s is {self.smoothing_s:g}, allowed is 0 or more")


@dataclass(frozen=True)
class UserContact:
    """A contact stated by the user, which replaces what is found: joints of A and of B over frames, with a weight.

    `weight` 0 says that the two do not touch, whatever their distance.
    """

    joint_a: str
    joint_b: str
    start_frame: int
    stop_frame: int
    weight: float

    def within(self, start: int, stop: int) -> UserContact | None:
        """Return the part of it in frames `start` to `stop`, counted from `start`; None where there is none."""
        first, last = max(self.start_frame, start), min(self.stop_frame, stop)
        return replace(self, start_frame=first - start, stop_frame=last - start) if first < last else None


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


def contact_distances(positions_m: Array) -> Array:
    """Return the distance of every joint of A from every joint of B (*batch, 22, 22) of pairs (*batch, 2, 22, 3)."""
    difference = positions_m[..., 0, :, None, :] - positions_m[..., 1, None, :, :]
    return np.asarray(np.sqrt((difference**2).sum(axis=-1)))


def check_contacts(source: Source, user: Sequence[UserContact]) -> None:
    """Refuse contacts stated by the user that are not of this take.

    Raises:
        InputError: A user's contact names an unknown joint, an empty frame range or a negative weight.
    """
    for contact in user:
        BODY22.index(contact.joint_a), BODY22.index(contact.joint_b)
        if not (0 <= contact.start_frame < contact.stop_frame <= source.num_frames) or not contact.weight >= 0:
            raise InputError(
                f"{source.name}: contact {contact.joint_a}-{contact.joint_b} over frames {contact.start_frame} to "
                f"{contact.stop_frame} with weight {contact.weight:g}; allowed are frames within 0 to "
                f"{source.num_frames} and weights from 0"
            )


def contact_weights(source: Source, settings: ContactSettings, user: Sequence[UserContact] = ()) -> Array:
    """Return how much each pair of joints is in contact (frame, 22 of A, 22 of B), from 0 to 1 before grading.

    Raises:
        InputError: See `check_contacts`.
    """
    check_contacts(source, user)
    weights = fade(contact_distances(source.positions_m), *settings.contact_m)
    for contact in user:
        at = (BODY22.index(contact.joint_a), BODY22.index(contact.joint_b))
        weights[contact.start_frame : contact.stop_frame, *at] = contact.weight
    return _smooth(weights, source, settings)


def joint_radii_m(source: Source) -> Array:
    """Return how thick each person is at each joint (2, 22), metres: radius of the thickest capsule that ends there."""
    model = capsule_model(BODY22)
    bones = model.radii_m(body_height_m(BODY22, source.lengths_m))
    radii = np.array(bones)
    for parent, child in BODY22.bones:
        radii[:, parent] = np.maximum(radii[:, parent], bones[:, child])
    return radii


def stance_weights(source: Source, settings: ContactSettings) -> Array:
    """Return how much each joint of the feet stands (frame, 2, 4), 1 standing: slow and low in the source."""
    feet = source.positions_m[:, :, FEET]
    velocity = np.gradient(feet, axis=0) * source.rate_hz if source.num_frames > 1 else np.zeros(feet.shape)
    speed = np.linalg.norm(velocity[..., [0, 2]], axis=-1)
    standing = fade(speed, *settings.stance_speed_m_s) * fade(_height(source)[:, :, FEET], *settings.stance_height_m)
    return _smooth(standing, source, settings)


def floor_weights(source: Source, settings: ContactSettings) -> Array:
    """Return how near the floor each joint is in the source (frame, 2, 22), 1 on it."""
    return _smooth(fade(_height(source), *settings.floor_height_m), source, settings)


def _height(source: Source) -> Array:
    """Height above the floor (frame, 2, 22); an ankle's is taken above its own height when standing flat."""
    height = source.positions_m[..., 1] - source.floor_m[:, None]
    ankles = BODY22.indices(["left_ankle", "right_ankle"])
    height[:, :, ankles] -= source.flat_ankle_m[:, None]
    return np.asarray(height)


def _smooth(weights: Array, source: Source, settings: ContactSettings) -> Array:
    if settings.smoothing_s <= 0 or source.num_frames < 2:
        return weights
    return np.asarray(
        gaussian_filter1d(weights, settings.smoothing_s * source.rate_hz, axis=0, mode="nearest", truncate=3.0)
    )
