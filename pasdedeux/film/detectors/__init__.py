"""Detectors of people: the registry of kinds of networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pasdedeux.errors import InputError
from pasdedeux.film.detectors.detector import Detector, DetectorKind, Network, load_onnx
from pasdedeux.film.detectors.movenet import MOVENET
from pasdedeux.film.detectors.rtmo import RTMO
from pasdedeux.film.detectors.rtmpose import RTMPOSE
from pasdedeux.film.detectors.yolox import YOLOX
from pasdedeux.plain_text import counted

__all__ = ["DETECTORS", "Detector", "DetectorKind", "load_detector"]

DETECTORS: tuple[DetectorKind, ...] = (RTMO, YOLOX, RTMPOSE, MOVENET)


def load_detector(files: Sequence[bytes]) -> Detector:
    """Return the detector that ONNX files are: one network, or one of boxes and one of the person in a box.

    Raises:
        InputError: A file is not a network of a known kind, or the files do not belong together.
    """
    boxes: Detector | None = None
    chosen: list[tuple[DetectorKind, Network]] = []
    for data in files:
        network = load_onnx(data)
        kind = next((detector for detector in DETECTORS if detector.outputs <= set(network.outputs)), None)
        if kind is None:
            known = "; ".join(f"{detector.name} ({', '.join(sorted(detector.outputs))})" for detector in DETECTORS)
            raise InputError(f"the network's outputs {', '.join(network.outputs)} are of no known kind: {known}")
        network = replace(network, input_px=network.input_px or kind.usual_px)
        if kind.is_boxes:
            boxes = kind.make(network, None)
        else:
            chosen.append((kind, network))
    if len(chosen) != 1:
        raise InputError(
            f"{counted(len(chosen), 'network')} of keypoints; one is needed, and perhaps one of boxes beside it"
        )
    ((kind, network),) = chosen
    return kind.make(network, boxes)
