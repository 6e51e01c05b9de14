"""Pairs that several tests share, made once."""

from __future__ import annotations

from pathlib import Path

import pytest
from pairs import BENT, SHIFTED


@pytest.fixture(scope="session")
def bent(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return BENT.write(tmp_path_factory.mktemp("bent"))


@pytest.fixture(scope="session")
def shifted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return SHIFTED.write(tmp_path_factory.mktemp("shifted"))
