"""Types of arrays; docstrings give the axes."""

import math
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

_Item = TypeVar("_Item", bound=np.generic)


def plain(array: npt.NDArray[_Item], dtype: type[np.generic] | None = None) -> npt.NDArray[Any]:
    """Return an array as kernels take it, contiguous and writable; it is copied if it is not.

    A kernel compiles again, for about a second, for each layout, and for arrays that are read-only.

    >>> view = np.broadcast_to(np.arange(3.0), (2, 3))
    >>> (plain(view).flags.c_contiguous, plain(view).flags.writeable, plain(plain(view)) is plain(view))
    (True, True, False)
    """
    kept = np.asarray(array, dtype=dtype, order="C")
    return kept if kept.flags.writeable else kept.copy()


def merge_axes(array: npt.NDArray[_Item], start: int, stop: int | None = None) -> npt.NDArray[_Item]:
    """Merge axes `start` to `stop`, exclusive, into one; without `stop` to the last.

    Unlike a reshape to -1, this works if another axis is empty.

    >>> merge_axes(np.zeros((0, 2, 17, 3)), 1, -1).shape
    (0, 34, 3)
    """
    shape = array.shape
    low, high, _ = slice(start, stop).indices(len(shape))
    return array.reshape(*shape[:low], math.prod(shape[low:high]), *shape[high:])


def interpolate(places: npt.NDArray[Any], known: npt.NDArray[Any], values: Array) -> Array:
    """Return values (n, *axes) of rising places (n,) at other places (m,), linearly between; ends repeat.

    >>> interpolate(np.array([0.5, 9.0]), np.array([0.0, 1.0]), np.array([[2.0, 0.0], [4.0, 1.0]])).tolist()
    [[3.0, 0.5], [4.0, 1.0]]
    """
    columns = merge_axes(values, 1).T
    between = np.stack([np.interp(places, known, column) for column in columns], axis=-1)
    return between.reshape(len(places), *values.shape[1:])
