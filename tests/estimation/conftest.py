"""A model that several tests of estimation share."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.models import RPC


@pytest.fixture(scope="session")
def level() -> RPC:
    """A hundredth of a degree a thousand pixels, straight down."""
    one = np.eye(20)
    return RPC(1000.0, 1000.0, 20.0, -30.0, 500.0, 1000.0, 1000.0, 0.01, 0.01, 500.0, one[1], one[0], one[2], one[0])
