"""The torso basis of the built-in duets, for studies that name no prior takes."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from pasdedeux.cameras import TorsoBasis, learn_torso_basis
from pasdedeux.choreography.duets import DUETS, make_duet
from pasdedeux.formats.working_poses import derive_working_poses
from pasdedeux.skeletons.layouts import LAYOUTS

__all__ = ["duet_torso_basis"]

_DURATION_S = 10.0
_RATE_HZ = 6.0


@lru_cache
def duet_torso_basis(*, num_components: int = 4) -> TorsoBasis:
    """Return the torso basis learned from both people of every built-in duet, 10 s each at 6 Hz.

    It has seen those duets: what is evaluated on them takes `proportions_torso_basis` instead.
    """
    motions = [motion for name in DUETS for motion in make_duet(name, duration_s=_DURATION_S, rate_hz=_RATE_HZ).motions]
    poses = [derive_working_poses(motion, LAYOUTS["body22"]).pair17_m for motion in motions]
    return learn_torso_basis(np.concatenate(poses), num_components=num_components)
