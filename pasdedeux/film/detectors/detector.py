"""The protocol of people detectors: networks in ONNX files, recognised by their outputs, with an adapter per kind."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.film.tracking import Image

_MAX_NETWORK_BYTES = 2_000_000_000
_NUM_COLOURS = 3
_INPUT_TYPES = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(uint8)": np.uint8}


class Detector(Protocol):
    """Finds people in successive images of a film."""

    def detect(self, image: Image) -> list[Array]:
        """Return the people of a BGR image, each a table (K, 3) of x and y in pixels, and confidence."""
        ...


@dataclass(frozen=True)
class Network:
    """A loaded network.

    Args:
        outputs: Names of its outputs.
        input_px: Width and height of its input images; None if they are free.
        run: Maps an image (1, 3, height, width), from 0 to 255 or as scaled by the kind, to outputs by name.
    """

    outputs: tuple[str, ...]
    input_px: tuple[int, int] | None
    run: Callable[[np.ndarray], Mapping[str, np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class DetectorKind:
    """A kind of network; each has a file, and a line in the registry.

    Args:
        name: Its name.
        outputs: Names of outputs by which it is recognised.
        make: Makes the detector from its network and, if given, a detector of boxes.
        is_boxes: Whether it detects boxes, as two corners (2, 3), for a network that needs them.
        usual_px: Width and height of its images if the network leaves them free; None if the adapter chooses.
    """

    name: str
    outputs: frozenset[str]
    make: Callable[[Network, Detector | None], Detector]
    is_boxes: bool = False
    usual_px: tuple[int, int] | None = None


def _unpacked(data: bytes) -> bytes:
    """Return the ONNX file in a ZIP archive of a model zoo.

    Raises:
        InputError: It is damaged, or has no or several ONNX files.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [member for member in archive.infolist() if member.filename.lower().endswith(".onnx")]
            if len(members) != 1 or members[0].file_size > _MAX_NETWORK_BYTES:
                names = ", ".join(member.filename[:60] for member in members[:3]) or "none"
                raise InputError(f"a ZIP archive with one ONNX file of at most 2 GB is needed, found {names}")
            return archive.read(members[0])
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, OSError, EOFError) as error:
        raise InputError(f"this ZIP archive of a network is damaged: {str(error)[:120]}") from None


def load_onnx(data: bytes) -> Network:
    """Load an ONNX file, or the only one in a ZIP archive, to run on one thread, because there are many workers.

    Raises:
        InputError: onnxruntime is not installed, or this is not a network for images.
    """
    try:
        import onnxruntime
    except ImportError:
        raise InputError("a detector needs onnxruntime: pip install 'pasdedeux[detect]'") from None
    if data[:4] == b"PK\x03\x04":
        data = _unpacked(data)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - onnxruntime has a class of its own for each cause
        raise InputError(f"this is no ONNX network that can be loaded: {str(error).splitlines()[0][:200]}") from None
    (first, *_) = session.get_inputs()
    shape: Sequence[Any] = first.shape
    is_last = len(shape) == 4 and shape[3] == _NUM_COLOURS
    if not is_last and (len(shape) != 4 or shape[1] != _NUM_COLOURS):
        raise InputError(
            f"its input has the shape {list(shape)}; an image (1, 3, height, width) or (1, height, width, 3) is needed"
        )
    if first.type not in _INPUT_TYPES:
        raise InputError(
            f"its input is {first.type}; 32-bit floats, 32-bit or 8-bit integers are needed: {', '.join(_INPUT_TYPES)}"
        )
    height, width = shape[1:3] if is_last else shape[2:]
    is_fixed = isinstance(height, int) and isinstance(width, int)
    names = tuple(output.name for output in session.get_outputs())

    def run(tensor: np.ndarray) -> Mapping[str, np.ndarray]:
        image = tensor.transpose(0, 2, 3, 1) if is_last else tensor
        values = np.ascontiguousarray(image, dtype=_INPUT_TYPES[first.type])
        try:
            return dict(zip(names, session.run(names, {first.name: values}), strict=True))
        except Exception as error:  # noqa: BLE001 - onnxruntime has a class of its own for each cause
            reason = str(error).splitlines()[0][:200]
            raise InputError(f"the network cannot be run on an image of {list(values.shape)}: {reason}") from None

    return Network(names, (width, height) if is_fixed else None, run)


def letterbox(image: Image, size_px: tuple[int, int]) -> tuple[np.ndarray, float]:
    """Return an image (1, 3, height, width), scaled to fit at the top left and padded with grey, and the scale."""
    import cv2  # here: a quarter of a second that others need not wait for

    width, height = size_px
    scale = min(width / image.shape[1], height / image.shape[0])
    inside = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    padded = np.full((height, width, 3), 114, dtype=np.uint8)
    padded[: inside[1], : inside[0]] = cv2.resize(image, inside, interpolation=cv2.INTER_LINEAR)
    return padded.transpose(2, 0, 1)[None].astype(np.float32), scale


def output(outputs: Mapping[str, np.ndarray], name: str, num_axes: int, last: int | None = None) -> np.ndarray:
    """Return an output after checking its number of axes and the length of the last one.

    Raises:
        InputError: They differ: the network is not of the kind that its outputs are named after.
    """
    array = np.asarray(outputs[name])
    if array.ndim != num_axes or (last is not None and array.shape[-1] != last):
        wanted = f"{num_axes} axes" + (f", the last of {last}" if last else "")
        raise InputError(f"the network's output '{name}' has the shape {list(array.shape)}; {wanted} are needed")
    return array
