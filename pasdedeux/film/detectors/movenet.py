"""MoveNet MultiPose: up to six people at once, from an image whose sides are free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.film.detectors.detector import Detector, DetectorKind, Network, letterbox, output
from pasdedeux.film.tracking import Image

MIN_SCORE = 0.1
"""Minimum score of a person; with 0.2, a fifth less of dancing pairs in rendered film are found."""
LONGER_PX, _MULTIPLE_PX = 384, 32
"""Longer side of the input image, and the number of which its sides are multiples."""
_NUM_KEYPOINTS = 17


@dataclass(frozen=True)
class MoveNet:
    """The adapter; images are RGB from 0 to 255, keypoints are y, x and score, relative to the image's sides."""

    network: Network

    def detect(self, image: Image) -> list[Array]:
        """Return the people of an image, the most certain first."""
        sides = np.array(image.shape[1::-1]) * LONGER_PX / max(image.shape[:2])
        width, height = (_MULTIPLE_PX * np.ceil(sides / _MULTIPLE_PX - 1e-9)).astype(int).tolist()
        size_px = self.network.input_px or (width, height)
        tensor, scale = letterbox(np.ascontiguousarray(image[..., ::-1]), size_px)
        rows = output(self.network.run(tensor), "output_0", 3, 3 * _NUM_KEYPOINTS + 5)[0].astype(np.float64)
        people = rows[:, : 3 * _NUM_KEYPOINTS].reshape(-1, _NUM_KEYPOINTS, 3)[..., [1, 0, 2]]
        people = people * [size_px[0] / scale, size_px[1] / scale, 1.0]
        return [people[index] for index in np.argsort(-rows[:, -1], kind="stable") if rows[index, -1] > MIN_SCORE]


def _make(network: Network, boxes: Detector | None) -> Detector:
    return MoveNet(network)


MOVENET = DetectorKind(name="movenet", outputs=frozenset({"output_0"}), make=_make)
