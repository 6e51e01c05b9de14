"""Plugin for the stereo programs CARS and s2p: the formats ``cars`` and ``s2p``.

Each gives a program the adjusted models of a block, the pairs, and a coarse DEM. The host writes models and images.
`ortho_asp` has the format of Ames Stereo Pipeline.
"""

from __future__ import annotations

from collections.abc import Iterable

from ortho_pipeline.plugin import BlockFormat, hookimpl
from ortho_stereo.configurations import cars_text, s2p_text


@hookimpl
def ortho_formats() -> Iterable[BlockFormat]:
    """Offer the formats of the two programs."""
    yield BlockFormat("cars", "CARS 1", "cars.json", ("geom",), cars_text, "cars")
    yield BlockFormat("s2p", "s2p", "s2p.json", ("rpc-txt",), s2p_text, "s2p")
