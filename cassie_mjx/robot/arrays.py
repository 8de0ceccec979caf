"""One formula for NumPy and JAX: which library an array belongs to, by the array API's own question."""

from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

Array: TypeAlias = Any
"""A NumPy or a JAX array."""


def namespace(*arrays: Array) -> ModuleType:
    """The functions for these arrays: NumPy's, or, if one of them is of another library such as JAX, that library's."""
    for array in arrays:
        if not isinstance(array, (np.ndarray, np.generic)) and hasattr(array, "__array_namespace__"):
            return array.__array_namespace__()
    return np
