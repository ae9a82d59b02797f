"""Types that several modules share."""

from __future__ import annotations

from typing import Any, TypeAlias

import jax
import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
"""Numbers of a recording or a model, f64."""

Integers: TypeAlias = NDArray[np.int64]
"""Sequence numbers, or times in nanoseconds."""

Bytes: TypeAlias = NDArray[np.uint8]
"""Data of a message, such as a picture's."""

Scalar: TypeAlias = Any
"""A Python float, or a JAX number (traced or not)."""

Tree: TypeAlias = Any
"""A pytree of JAX arrays."""

Array: TypeAlias = jax.Array

__all__ = ["Array", "Bytes", "Floats", "Integers", "Scalar", "Tree"]
