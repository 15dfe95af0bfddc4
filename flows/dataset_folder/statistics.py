"""Statistics of the positions in a dataset's folder, for normalisation: `stats.json`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics import bone_lengths
from pasdedeux.skeletons import BODY22

Numbers = npt.NDArray[np.float64]
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_MOST_ROWS = 100_000
"""Largest number of rows for quantiles, which are kept in memory."""


@dataclass
class Figures:
    """Sums over rows (row, *shape), and every `step`-th row."""

    step: int
    count: int = 0
    sums: list[Numbers] = field(default_factory=list)
    kept: list[npt.NDArray[np.float32]] = field(default_factory=list)

    def add(self, rows: Numbers) -> None:
        """Add rows, if there are any."""
        if len(rows):
            new = [rows.sum(0), np.square(rows).sum(0), rows.min(0), rows.max(0)]
            both = zip((np.add, np.add, np.minimum, np.maximum), self.sums or new, new, strict=True)
            self.sums = [join(*two) for join, *two in both] if self.sums else new
            self.kept.append(rows[-self.count % self.step :: self.step].astype(np.float32))
            self.count += len(rows)

    def to_json(self) -> dict[str, Any]:
        """Return the figures with six decimals."""
        if not self.count:
            return {"count": 0}
        total, squares, least, greatest = self.sums
        mean = total / self.count
        deviation = np.sqrt(np.maximum(squares / self.count - mean**2, 0.0))
        as_json = {"mean": mean, "std": deviation, "min": least, "max": greatest}
        as_json |= dict(
            zip(QUANTILES, np.quantile(np.concatenate(self.kept), [*QUANTILES.values()], axis=0), strict=True)
        )
        return {"count": self.count} | {name: np.round(values, 6).tolist() for name, values in as_json.items()}


def figures_of_motions(clips: Iterable[tuple[Numbers, float]], num_rows: int) -> dict[str, Any]:
    """Return the figures of clips, by column.

    Args:
        clips: Positions (frame, person, 22, 3), metres, and rate of each, Hz; one at a time is in memory.
        num_rows: Frames times people of all clips.
    """
    step = max(1, -(-num_rows // _MOST_ROWS))
    by_name = {name: Figures(step) for name in ("body22_m", "body22_velocity_m_s", "bone_length_m")}
    for positions, rate_hz in clips:
        by_name["body22_m"].add(positions.reshape(-1, BODY22.num_joints, 3))
        velocity = np.diff(positions, axis=0) * rate_hz
        by_name["body22_velocity_m_s"].add(velocity.reshape(-1, BODY22.num_joints, 3))
        by_name["bone_length_m"].add(bone_lengths(BODY22, positions).reshape(-1, BODY22.num_joints))
    return {name: figures.to_json() for name, figures in by_name.items()}


def contact_figures(held: Mapping[str, Numbers], num_frames: Mapping[str, int]) -> dict[str, Any]:
    """Return the share of frames in which each bone is in contact, over all takes.

    Args:
        held: Number of frames in which each bone (22,) of any person is in contact, by take.
        num_frames: Frames of each take.
    """
    count = sum(num_frames.values())
    total = sum(held.values(), np.zeros(BODY22.num_joints))
    return {"count": count, "mean": np.round(total / max(count, 1), 6).tolist()}
