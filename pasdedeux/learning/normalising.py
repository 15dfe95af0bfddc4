"""Normalisation of positions: mean zero and deviation one, joint by joint and axis by axis."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError


@dataclass(frozen=True)
class Normaliser:
    """Mean and standard deviation (joint, 3) of positions, metres; coordinates that never change are divided by one.

    Raises:
        InputError: They are not finite, or not of one shape.
    """

    mean: npt.NDArray[np.float32]
    deviation: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        mean, deviation = (np.asarray(values, dtype=np.float32) for values in (self.mean, self.deviation))
        if mean.shape != deviation.shape or not (np.isfinite(mean).all() and np.isfinite(deviation).all()):
            raise InputError(f"mean {mean.shape} and deviation {deviation.shape} must be finite, and of one shape")
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "deviation", np.where(deviation > 0, deviation, np.float32(1.0)))

    @classmethod
    def of(cls, chunks: Iterable[npt.NDArray[Any]]) -> Normaliser:
        """Return that of rows (n, joint, 3), reading a chunk at a time; values that are not finite do not count.

        Sums are of float64.

        Raises:
            InputError: There is no row, or a joint is in none.
        """
        count, total, squares = np.zeros(()), np.zeros(()), np.zeros(())
        for rows in chunks:
            is_there = np.isfinite(rows)
            values = np.where(is_there, rows, 0.0).astype(np.float64)
            count, total, squares = count + is_there.sum(0), total + values.sum(0), squares + np.square(values).sum(0)
        if not np.all(count):
            raise InputError("there are no positions to normalise by, or a joint is never there")
        mean = total / count
        deviation = np.sqrt(np.maximum(squares / count - mean**2, 0.0))
        return cls(mean.astype(np.float32), deviation.astype(np.float32))

    def apply(self, positions_m: npt.NDArray[np.float32]) -> None:
        """Normalise positions (*batch, joint, 3), metres, in place."""
        positions_m -= self.mean
        positions_m /= self.deviation

    def undo(self, values: Any) -> Any:
        """Return the positions (*batch, joint, 3), metres, of normalised ones: an array, or a tensor on the CPU."""
        return values * self.deviation + self.mean
