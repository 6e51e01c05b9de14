"""A pair of images with RPCs, textured or empty, and the points that connect them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from ortho_studies.simulation.scanner import LineScanner
from osgeo import gdal, osr

from ortho_pipeline.exchange.rpc import export_rpc, rpc_metadata
from ortho_pipeline.models import RPC
from ortho_pipeline.surface.writing import write_dem

LON, LAT, SIZE, PIXEL = 20.0, -30.0, 300, 10.0
#: By how many pixels each delivered RPC is wrong.
BIAS = {"aft": np.array([3.0, -2.0]), "fore": np.array([-1.5, 4.0])}


class Pair:
    """Two scenes 28 degrees apart, whose points have control."""

    def __init__(
        self, folder: Path, *, away: float = 0.0, bands: int = 1, turns: dict[str, float] | None = None
    ) -> None:
        """`turns`: degrees by which each image is moved around the Earth."""
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.rpcs: dict[str, RPC] = {}
        for number, (name, angle) in enumerate((("aft", -12.0), ("fore", 16.0))):
            camera = LineScanner.over(
                LON + number * away, LAT, 500.0, off_nadir_deg=angle, image_width=SIZE, image_height=SIZE, gsd=PIXEL,
                heights=(0.0, 1000.0),
            )  # fmt: skip
            rpc = export_rpc(camera).rpc
            self.rpcs[name] = rpc._replace(lon_off=rpc.lon_off + (turns or {}).get(name, 0.0))
            made = gdal.GetDriverByName("GTiff").Create(str(self.image(name)), SIZE, SIZE, bands, gdal.GDT_Byte)
            made.WriteArray(np.full((bands, SIZE, SIZE) if bands > 1 else (SIZE, SIZE), 100, dtype=np.uint8))
            made.SetMetadata(rpc_metadata(self.rpcs[name]), "RPC")
            made = None

    def image(self, name: str) -> Path:
        return self.folder / f"{name}.tif"

    @property
    def images(self) -> list[str]:
        return [str(self.image(name)) for name in self.rpcs]

    def points(self) -> Path:
        """Write control points, each measured where the images see it."""
        random = np.random.default_rng(5)
        lines = ["#CRS: EPSG:4326\n#vertical: ellipsoid\nid,image,col,row,x,y,h,role,sigma_image,sigma_xy,sigma_h"]
        for name, rpc in self.rpcs.items():
            image = random.uniform(20, SIZE - 20, (12, 2))
            ground = rpc.image_to_ground(image, random.uniform(200, 800, 12))
            for number, ((col, row), (x, y, h)) in enumerate(
                zip((image + BIAS[name]).tolist(), ground.tolist(), strict=True)
            ):
                lines.append(f"{name}{number},{name}.tif,{col},{row},{x},{y},{h},control,0.2,0.1,0.1")
        path = self.folder / "points.csv"
        path.write_text("\n".join(lines) + "\n")
        return path

    def dem(self, height: float = 500.0) -> Path:
        """Write a DEM of flat ground with heights above EGM96, as wide as the scenes."""
        path = self.folder / "dem.tif"
        write_dem(path, np.full((120, 120), height), (LON - 0.06, LAT + 0.06), 0.001, "EPSG:4326+5773")
        return path

    def georeference(self) -> None:
        """Give the images a geotransform of a map, as some products have one next to their RPC."""
        reference = osr.SpatialReference()
        reference.ImportFromEPSG(32734)
        for image in self.images:
            made = gdal.Open(image, gdal.GA_Update)
            made.SetGeoTransform((500000.0, PIXEL, 0.0, 6_600_000.0, 0.0, -PIXEL))
            made.SetProjection(reference.ExportToWkt())
            made = None
