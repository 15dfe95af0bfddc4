"""Couples for tests: built-in duets and real salsa."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from pasdedeux.choreography.duets import make_duet
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.kinematics import Motion
from pasdedeux.skeletons.layouts import LAYOUTS

Array = npt.NDArray[np.float64]

SALSA_TAKES = ("01", "02", "03", "04", "05", "06", "07", "09", "10", "11", "12")
SALSA_METRES_PER_UNIT = {"60": 1.263, "61": 1.191}
SALSA_HZ = 60.0  # the headers say 120


def _couple(motions: list[Motion], layout: str, rate_hz: float) -> Array:
    poses = [derive_working_poses(motion.resample(rate_hz), LAYOUTS[layout]).op14_m for motion in motions]
    count = min(map(len, poses))
    return np.stack([pose[:count] for pose in poses], axis=1)


def duet_couple(name: str, *, duration_s: float = 10.0, rate_hz: float = 30.0, variation: int = 0) -> Array:
    """Positions (frame, 2, 14, 3) of a built-in duet."""
    duet = make_duet(name, duration_s=duration_s, rate_hz=rate_hz, variation=variation)
    return _couple(list(duet.motions), "body22", rate_hz)


def salsa_motions(data_dir: Path, take: str) -> list[Motion]:
    """Return the two people of a real salsa take."""
    motions = []
    for subject, unit in SALSA_METRES_PER_UNIT.items():
        source = read_bvh((data_dir / "cmu_salsa_bvh" / f"{subject}_{take}.bvh").read_bytes())
        motions.append(source.to_motion(metres_per_unit=unit, rate_hz=SALSA_HZ))
    return motions


def salsa_couple(data_dir: Path, take: str, *, rate_hz: float = 30.0) -> Array:
    """Positions (frame, 2, 14, 3) of a real salsa take."""
    return _couple(salsa_motions(data_dir, take), "cmu_daz", rate_hz)
