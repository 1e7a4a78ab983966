"""Array types that annotations use."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Numeric = NDArray[Any]
"""float64, or complex128 while a complex step takes a derivative."""
