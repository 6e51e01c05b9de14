"""Arrays of tiles and windows in memory that is used again: it is neither asked for anew nor left in pieces."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Reused:
    """Memory of arrays that are needed one after the other, shared by threads.

    Without it the allocator of the system keeps large pieces that fit nothing, nearly as many as are in use where
    tiles have many bands.
    """

    def __init__(self) -> None:
        self._free: deque[NDArray[np.uint8]] = deque()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """Return an array with whatever is in it, as `np.empty`; `give_back` lets another have its memory."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(size, dtype=np.uint8)
        if memory.size < size:
            # The old piece first goes back to the system.
            del memory
            memory = np.empty(size, dtype=np.uint8)
        return np.ndarray(shape, dtype, buffer=memory)

    def give_back(self, array: NDArray[Any]) -> None:
        """Take the memory of an array of `empty` that nobody looks at any more."""
        memory = array.base
        assert isinstance(memory, np.ndarray)
        self._free.append(memory)
