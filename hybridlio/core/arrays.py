"""Array types for signatures; docstrings give the shapes."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]  # poses, covariances and everything else that is estimated
Floats: TypeAlias = NDArray[np.float32]  # points and maps, in the precision of sensors and networks
Mask: TypeAlias = NDArray[np.bool_]
Index: TypeAlias = NDArray[np.int64]  # positions in another array
Stamps: TypeAlias = NDArray[np.int64]  # times in nanoseconds

NS_PER_S = 1_000_000_000
