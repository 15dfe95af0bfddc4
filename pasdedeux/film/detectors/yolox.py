"""YOLOX with suppression inside: boxes of people for networks of one person, such as RTMPose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.film.detectors.detector import Detector, DetectorKind, Network, letterbox, output
from pasdedeux.film.tracking import Image

MIN_SCORE = 0.3
_PERSON = 0
"""Class of people in COCO's numbering."""


@dataclass(frozen=True)
class Yolox:
    """The adapter; images are BGR from 0 to 255."""

    network: Network

    def detect(self, image: Image) -> list[Array]:
        """Return the boxes of people as two corners (2, 3) with the score."""
        assert self.network.input_px is not None
        tensor, scale = letterbox(image, self.network.input_px)
        outputs = self.network.run(tensor)
        dets, labels = output(outputs, "dets", 3, 5)[0], output(outputs, "labels", 2)[0]
        people = dets[(labels == _PERSON) & (dets[:, 4] > MIN_SCORE)].astype(np.float64)
        return [np.array([[*(box[:2] / scale), box[4]], [*(box[2:4] / scale), box[4]]]) for box in people]


def _make(network: Network, boxes: Detector | None) -> Detector:
    return Yolox(network)


YOLOX = DetectorKind(
    name="yolox", outputs=frozenset({"dets", "labels"}), make=_make, is_boxes=True, usual_px=(640, 640)
)
