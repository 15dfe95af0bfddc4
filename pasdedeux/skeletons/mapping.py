"""Joint mappings, which derive the joints of one skeleton from those of another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError
from pasdedeux.skeletons.skeleton import Skeleton

Weights = Mapping[str, float]


@dataclass(frozen=True)
class JointMap:
    """Each target joint as a weighted mean of source joints; the weights of a joint sum to 1.

    Args:
        name: Name of the mapping, used in messages.
        target: Target skeleton.
        table: For each target joint the source joints and their weights, or one source joint's name.

    Raises:
        InputError: A target joint is missing or unknown, or its weights do not sum to 1.
    """

    name: str
    target: Skeleton
    table: Mapping[str, str | Weights]

    def __post_init__(self) -> None:
        """Check that all target joints are there and their weights sum to 1."""
        missing = [joint for joint in self.target.joint_names if joint not in self.table]
        if missing:
            raise InputError(f"mapping '{self.name}': no source for {', '.join(missing)} of '{self.target.name}'")
        for joint in self.table:
            self.target.index(joint)
            total = sum(self.weights(joint).values())
            if abs(total - 1.0) > 1e-6:
                raise InputError(f"mapping '{self.name}': the weights of '{joint}' sum to {total:g}, not 1")

    def weights(self, joint: str) -> Weights:
        """Return the source joints of a target joint with their weights."""
        entry = self.table[joint]
        return {entry: 1.0} if isinstance(entry, str) else entry

    def carrier(self, joint: str) -> str:
        """Return the source joint with the largest weight, whose rotation the target joint has."""
        weights = self.weights(joint)
        return max(weights, key=lambda name: weights[name])

    def matrix(self, source_names: Sequence[str]) -> npt.NDArray[np.float64]:
        """Return the weights as a matrix (target joint, source joint)."""
        matrix = np.zeros((self.target.num_joints, len(source_names)))
        for row, joint in enumerate(self.target.joint_names):
            for source, weight in self.weights(joint).items():
                if source not in source_names:
                    raise InputError(
                        f"mapping '{self.name}': joint '{source}' is not in the source; "
                        f"known joints: {', '.join(source_names)}"
                    )
                matrix[row, list(source_names).index(source)] = weight
        return matrix

    def positions(self, positions: npt.NDArray[np.float64], source_names: Sequence[str]) -> npt.NDArray[np.float64]:
        """Derive target positions (*batch, target joint, d) from source positions (*batch, source joint, d)."""
        return weighted_points(self.matrix(source_names), positions)


def weighted_points(weight: npt.NDArray[np.float64], points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return weighted sums (*batch, target, d) of points (*batch, source, d), by weights (target, source).

    Most weights are zero; skipping them takes an eighth of the time of a matrix product.
    """
    summed = np.zeros((*points.shape[:-2], len(weight), points.shape[-1]))
    for target, source in np.argwhere(weight):
        summed[..., target, :] += weight[target, source] * points[..., source, :]
    return summed
