"""Types of NumPy arrays, by what they hold."""

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
