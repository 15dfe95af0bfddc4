"""The arrays that nearly everything is about."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
"""Double precision; docstrings say the axes."""
