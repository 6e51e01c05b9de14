"""One raster of many orthos that share a grid: which lies on top, where seams run, how bright each is, and how well
they agree.

Nothing is resampled: orthos that are not on one grid are refused.
"""

from ortho_pipeline.warp.mosaic.balance import Balance, balanced
from ortho_pipeline.warp.mosaic.layout import Mosaic, Ortho, PlacedOrtho, lay_out
from ortho_pipeline.warp.mosaic.overlaps import Overlap, measure_seam, overlaps
from ortho_pipeline.warp.mosaic.seamlines import Owners, owners_of
from ortho_pipeline.warp.mosaic.seams import along_seams
from ortho_pipeline.warp.mosaic.writing import write_cog, write_vrt

__all__ = [
    "Balance",
    "Mosaic",
    "Ortho",
    "Overlap",
    "Owners",
    "PlacedOrtho",
    "along_seams",
    "balanced",
    "lay_out",
    "measure_seam",
    "overlaps",
    "owners_of",
    "write_cog",
    "write_vrt",
]
