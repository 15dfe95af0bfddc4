"""RTMO: several people at once, boxes and keypoints from one network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.film.detectors.detector import Detector, DetectorKind, Network, letterbox, output
from pasdedeux.film.tracking import Image

MIN_SCORE = 0.3
"""Minimum score of a person."""


@dataclass(frozen=True)
class Rtmo:
    """The adapter; images are BGR from 0 to 255."""

    network: Network

    def detect(self, image: Image) -> list[Array]:
        """Return the people of an image, the most certain first."""
        assert self.network.input_px is not None
        tensor, scale = letterbox(image, self.network.input_px)
        outputs = self.network.run(tensor)
        scores = output(outputs, "dets", 3, 5)[0, :, 4]
        people = output(outputs, "keypoints", 4, 3)[0].astype(np.float64)
        chosen = [index for index in np.argsort(-scores, kind="stable") if scores[index] > MIN_SCORE]
        return [people[index] / [scale, scale, 1.0] for index in chosen]


def _make(network: Network, boxes: Detector | None) -> Detector:
    return Rtmo(network)


RTMO = DetectorKind(name="rtmo", outputs=frozenset({"dets", "keypoints"}), make=_make, usual_px=(640, 640))
