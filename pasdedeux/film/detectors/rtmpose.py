"""RTMPose: keypoints of one person in a box, as two distributions over x and over y (SimCC, Li et al. 2022)."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.film.detectors.detector import Detector, DetectorKind, Network, output
from pasdedeux.film.tracking import Image

_MEAN, _DEVIATION = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])
"""Mean and deviation of ImageNet's images, RGB, with which the network was trained."""
_PADDING = 1.25
"""Size of a box relative to the person."""
_BINS_PER_PX = 2.0
_MIN_SEEN = 0.3
"""Minimum confidence of keypoints from which the next box is made, without a network of boxes."""


class RtmPose:
    """The adapter; without boxes it follows one person, first in the whole image, then near the last place."""

    def __init__(self, network: Network, boxes: Detector | None) -> None:
        self._network, self._boxes = network, boxes
        self._last: Array | None = None

    def detect(self, image: Image) -> list[Array]:
        """Return the people in the boxes of an image."""
        if self._boxes is not None:
            return [self._in_box(image, box[:, :2]) for box in self._boxes.detect(image)]
        whole = np.array([[0.0, 0.0], image.shape[1::-1]])
        people = self._in_box(image, whole if self._last is None else self._last)
        seen = people[people[:, 2] > _MIN_SEEN, :2]
        self._last = np.array([seen.min(axis=0), seen.max(axis=0)]) if len(seen) > 3 else None
        return [people] if len(seen) else []

    def _in_box(self, image: Image, corners: Array) -> Array:
        import cv2  # here: a quarter of a second that others need not wait for

        assert self._network.input_px is not None
        width, height = self._network.input_px
        sides = _PADDING * np.maximum(corners[1] - corners[0], 1.0)
        scale = min(width / sides[0], height / sides[1])
        start = corners.mean(axis=0) - 0.5 * np.array([width, height]) / scale
        model_from_image = np.array([[scale, 0.0, -scale * start[0]], [0.0, scale, -scale * start[1]]])
        crop = cv2.warpAffine(image, model_from_image, (width, height), flags=cv2.INTER_LINEAR)
        tensor = ((crop[..., ::-1] - _MEAN) / _DEVIATION).transpose(2, 0, 1)[None]
        outputs = self._network.run(tensor)
        x, y = output(outputs, "simcc_x", 3)[0], output(outputs, "simcc_y", 3)[0]
        place = np.stack([x.argmax(axis=-1), y.argmax(axis=-1)], axis=-1) / _BINS_PER_PX
        sure = np.clip(np.minimum(x.max(axis=-1), y.max(axis=-1)), 0.0, None)
        return np.concatenate([start + place / scale, sure[:, None]], axis=-1).astype(np.float64)


RTMPOSE = DetectorKind(name="rtmpose", outputs=frozenset({"simcc_x", "simcc_y"}), make=RtmPose, usual_px=(192, 256))
