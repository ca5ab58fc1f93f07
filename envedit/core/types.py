"""Names of the types that signatures share.

Dr.Jit's own stubs do not type its operators (``Color3f * Float`` is an error to them), so that its arrays are
unchecked (``[tool.mypy]`` in ``pyproject.toml``): the names say what is expected. The others are checked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["ArrayLike", "DrArray", "FilePath", "Info", "Params", "Progress", "Shape", "Tensor", "Views"]

DrArray = Any
"""A flat Dr.Jit array: ``mi.Float``, ``mi.UInt32``, of any precision."""
Tensor = Any
"""A Dr.Jit tensor of any precision: ``mi.TensorXf``."""
Params = dict[str, Tensor]
"""What the optimiser owns: tensors by name."""
FilePath = str | PathLike[str]
"""The path of a file."""
Shape = tuple[int, ...]
"""Rows and columns; of some arrays, channels too."""
Views = Sequence[slice]
"""The rows of each view in a picture that stacks several; empty where there is but one."""
Progress = Callable[[int, int], None]
"""Receives the steps done, and all of them."""
Info = dict[str, Any]
"""Facts by name: scores, what a file says of itself, the state of a checkpoint."""
Arrays = dict[str, np.ndarray]
"""What a checkpoint holds: arrays by name."""
