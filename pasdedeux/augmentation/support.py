"""Support by the floor: standing or lying on feet, hands, knees or back; weights fade, nothing switches.

There is one floor a take.  A joint far above it in the source has no weight, so a lifted person is carried by
contacts alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation.source import Source
from pasdedeux.interaction.contacts import averaged
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.interaction.surfaces import fade
from pasdedeux.skeletons import BODY22

_STANCE_SPEED_M_S = (0.15, 0.45)
_STANCE_HEIGHT_M = (0.05, 0.12)
_FLOOR_HEIGHT_M = (0.04, 0.15)
"""Fades: a joint slower and lower than the first stands, one beyond the second does not; likewise for the floor."""
_SMOOTHING_S = 0.1
"""Standard deviation of the averaging of all weights over time."""


def stance_weights(source: Source, stated: Sequence[UserContact] = ()) -> Array:
    """Return the degree to which each joint stands (frame, P, 22), 1 if slow and on the floor in the source.

    Stated contacts with the floor replace detected ones.
    """
    positions = source.positions_m
    velocity = np.gradient(positions, axis=0) * source.rate_hz if source.num_frames > 1 else np.zeros(positions.shape)
    speed = np.linalg.norm(velocity[..., [0, 2]], axis=-1)
    return _smooth(fade(speed, *_STANCE_SPEED_M_S) * fade(_heights(source), *_STANCE_HEIGHT_M), source, stated)


def lasting_s(stands: Array, rate_hz: float) -> Array:
    """Return the duration of the stance around each frame, seconds, from weights (T, n).

    A frame with a weight below 1 ends it in part, one with weight 0 entirely.
    """
    lasting = -stands
    for frames in (range(len(stands)), reversed(range(len(stands)))):
        so_far = np.zeros(stands.shape[1:])
        for frame in frames:
            so_far = stands[frame] * (so_far + 1.0)
            lasting[frame] += so_far
    return np.asarray(lasting / rate_hz)


def floor_weights(source: Source, stated: Sequence[UserContact] = ()) -> Array:
    """Return how near the floor each joint is in the source (frame, P, 22), 1 on it, or stated to be."""
    return _smooth(fade(_heights(source), *_FLOOR_HEIGHT_M), source, stated)


def _heights(source: Source) -> Array:
    """Height of each joint (frame, P, 22) above where it is when it lies on the floor, metres."""
    return np.asarray(source.positions_m[..., 1] - source.floor_m - source.rest_heights_m)


def _smooth(weights: Array, source: Source, stated: Sequence[UserContact]) -> Array:
    for contact in stated:
        if contact.is_of_floor:
            when = slice(contact.start_frame, contact.stop_frame)
            weights[when, contact.persons[0], BODY22.index(contact.joint_a)] = min(contact.weight, 1.0)
    return averaged(weights, _SMOOTHING_S * source.rate_hz)
