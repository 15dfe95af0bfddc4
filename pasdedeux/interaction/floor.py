"""Standing feet: one floor under all people, and the feet that stand on it.

A foot stands if it is slow, no higher than the other foot, and near the floor.  The floor is that of the lowest feet of
*all* people about that time, so a person held up in the air stands on nothing, however still the feet hang.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.settings import Settings

Booleans = npt.NDArray[np.bool_]

_UP, _AWAY = 1, 2
_NEAR_PERCENT = 20.0
"""Percentile of the lowest foot around a frame that is taken for the floor: feet jump and step, and noise goes
below."""
_FLOOR_QUANTILE = 0.1
"""The same for a whole motion, over the lower foot of all standing people."""


class StandingSettings(Settings):
    """Criteria of a standing foot."""

    contact_speed_m_s: float = Field(0.3, gt=0, description="Feet slower than this may be planted")
    away_share: float = Field(
        0.5, ge=0, description="Part of the speed along z, away from the camera, that counts: one camera sees it badly"
    )
    contact_height_m: float = Field(
        0.05,
        gt=0,
        description="Feet lower than this over the lower foot and, twice this, over the floor may be planted",
    )
    floor_s: float = Field(
        1.5, gt=0, description="The floor that contacts are judged by is that of this time: a wrong pitch tilts it"
    )


def find_standing(
    feet_m: Array, *, rate_hz: float, settings: StandingSettings, is_present: Booleans | None = None
) -> Booleans:
    """Return which feet stand (frame, person, foot).

    Args:
        feet_m: Ankles (frame, person, foot=2, 3), upright axes (y up, z towards the camera), metres; of absent people,
            any finite values.
        rate_hz: Frames per second.
        settings: What counts.
        is_present: Whether each person is present (frame, person); all when not given.

    Motions of fewer than 3 frames have no speed, and no foot stands.
    """
    from scipy.ndimage import percentile_filter  # here: 0.3 s that planning does not need

    if len(feet_m) < 3:
        return np.zeros(feet_m.shape[:3], dtype=bool)
    present = np.ones(feet_m.shape[:2], dtype=bool) if is_present is None else is_present
    velocity = np.gradient(feet_m, axis=0) * rate_hz
    velocity[..., _AWAY] *= settings.away_share
    height = feet_m[..., _UP]
    is_low = height < height.min(axis=2, keepdims=True) + settings.contact_height_m
    lowest = np.where(present, height.min(axis=2), np.inf).min(axis=1)
    seen = np.flatnonzero(np.isfinite(lowest))
    if not len(seen):
        return np.zeros(feet_m.shape[:3], dtype=bool)
    lowest = np.interp(np.arange(len(lowest)), seen, lowest[seen])
    floor = percentile_filter(lowest, _NEAR_PERCENT, max(1, round(settings.floor_s * rate_hz)) | 1)
    is_near = height < floor[:, None, None] + 2.0 * settings.contact_height_m
    is_slow = np.linalg.norm(velocity, axis=-1) < settings.contact_speed_m_s
    return np.asarray(is_slow & is_low & is_near & present[..., None])


def floor_under(feet_m: Array, is_standing: Booleans, is_present: Booleans | None = None) -> float:
    """Return the height of standing ankles over all standing people, or over all people if none stands.

    Args:
        feet_m: Ankles (frame, person, foot=2, 3), upright axes, metres.
        is_standing: (frame, person, foot).
        is_present: Whether each person is present (frame, person); all when not given.
    """
    lowest = feet_m[..., _UP].min(axis=2)
    counted = is_standing.any(axis=2)
    if not counted.any():
        counted = np.ones(lowest.shape, dtype=bool) if is_present is None else is_present
    return float(np.quantile(lowest[counted], _FLOOR_QUANTILE))
