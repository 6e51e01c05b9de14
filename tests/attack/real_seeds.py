"""Real metadata as further seeds of the mutators, where they are present; only read, never copied."""

from __future__ import annotations

from pathlib import Path

from real_data import data_folder

REAL = data_folder()
#: Reader -> real files that it reads, below `REAL`.
FILES: dict[str, tuple[str, ...]] = {
    "rpc-text": ("gdal/gcore/data/test_rpc.txt", "gdal/gcore/data/md_ov_rpc.txt",
                 "gdal/gcore/data/md_ge_rgb_0010000_rpc.txt", "rpcm/rpc_IKONOS.txt", "rpcm/rpc_PLANET_L1A.txt"),
    "rpb": ("gdal/gcore/data/md_dg.RPB",),
    "otb-geom": ("otb/ikonos/ikonos-1.geom", "otb/QB/qb-1.geom", "otb/geoeye1/geoeye1-1.geom",
                 "otb/pleiades/pleiades-1.geom", "shareloc/rpc/phr_ventoux/left_image.geom"),
    "dimap-rpc": ("rpcm/rpc_SPOT6.xml", "rpcm/rpc_PLEIADES.xml", "gdal/gdrivers/data/jpeg2000/RPC_md_ple.XML",
                  "shareloc/rpc/RPC_PHR1B_P_201709281038045_SEN_PRG_FC_178608-001.XML"),
    "dimap-polynomials": ("sensors/pleiades/DIM_PHR1A_P_201303310839568_SEN_620285101-001.XML",),
    "orbview3-label": ("gdal/gcore/data/md_ov.pvl",),
    "ikonos-metadata": ("gdal/gcore/data/md_ge_metadata.txt",),
    "points-geojson": ("orthority/rpc/gcps.geojson",),
}  # fmt: skip


def real_seeds() -> list[tuple[str, Path]]:
    """Return every reader with each of its real files that is here."""
    return [(name, REAL / path) for name, paths in FILES.items() for path in paths if (REAL / path).is_file()]
