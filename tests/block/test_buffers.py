"""Memory of a block's largest arrays: never given to two at a time, and to the next when nobody holds it."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.block.projection.buffers import _LARGE, Buffers

SHAPE = (_LARGE, 2, 3)


def address(array: np.ndarray) -> int:
    return int(array.__array_interface__["data"][0])


def test_memory_is_given_again_when_the_last_view_of_it_is_gone() -> None:
    buffers = Buffers()
    first = buffers.zeros(SHAPE)
    first += 7.0
    where, view = address(first), first[5:, 1].T
    del first
    second = buffers.zeros(SHAPE)
    assert address(second) != where
    assert (view == 7.0).all()
    del view
    third = buffers.zeros((2, _LARGE, 3))
    assert address(third) == where
    assert third.shape == (2, _LARGE, 3)
    assert not third.any()
    assert not np.shares_memory(second, third)


def test_arrays_outlive_what_made_them() -> None:
    buffers = Buffers()
    found = buffers.zeros(SHAPE)
    found[...] = 3.0
    del buffers
    assert (found == 3.0).all()


def test_little_is_numpys() -> None:
    assert Buffers().zeros((3, 2)).base is None
