"""Three simulated photos of the place of the scene, as a drone with a poor receiver writes them, into ``photos/``.

python sample_data/photos.py
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
from make import CENTRE, LAKE_LEVEL, MAP_CRS, RELIEF, SEEDS
from ortho_studies.simulation.scanner import render
from ortho_studies.simulation.terrain import Landscape, Terrain
from osgeo import gdal

gdal.UseExceptions()
WIDTH, HEIGHT, FOCAL, PIXEL = 480, 320, 320.0, 2.5
ABOVE, BASE = 800.0, 420.0
#: Errors of the tags: metres, degrees.
POSITION, ANGLE = 3.0, 1.0
_PACKET = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
 xmlns:Camera="http://pix4d.com/camera/1.0/" {values}/></rdf:RDF></x:xmpmeta>"""
_TO_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


@dataclass(frozen=True)
class Pinhole:
    """A camera that looks down from lon, lat, height; its top is at the heading, degrees."""

    place: np.ndarray
    turn: np.ndarray
    width: int = WIDTH
    height: int = HEIGHT
    heights: tuple[float, float] = (600.0, 1200.0)

    def rays(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the origin and the directions of rays, ECEF."""
        tangents = (np.asarray(image) - (WIDTH / 2, HEIGHT / 2)) / FOCAL
        lines = np.column_stack([tangents, np.ones(len(tangents))]) @ self.turn
        origin = np.array(_TO_ECEF.transform(*self.place))
        return np.broadcast_to(origin, lines.shape), lines / np.linalg.norm(lines, axis=1)[:, None]

    def image_to_ground(self, image: np.ndarray, height: float) -> np.ndarray:
        """Return about where rays meet a height: the start of an iteration."""
        origin, lines = self.rays(image)
        up = origin[0] / np.linalg.norm(origin[0])
        ecef = origin - lines * ((self.place[2] - height) / (lines @ up))[:, None]
        return np.stack(_TO_ECEF.transform(*ecef.T, direction="INVERSE"), axis=1)


def turn_of(place: np.ndarray, yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Return the rotation from ECEF to x right, y down, z forward of a gimbal, whose angles (degrees) are DJI's."""
    sy, cy, sp, cp, sr, cr = (f(math.radians(a)) for a in (yaw, pitch, roll) for f in (math.sin, math.cos))
    ned_from_body = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    sl, cl, sp, cp = (f(math.radians(a)) for a in place[:2] for f in (math.sin, math.cos))
    ned_from_ecef = np.array([[-sp * cl, -sp * sl, cp], [-sl, cl, 0.0], [-cp * cl, -cp * sl, -sp]])
    return np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]) @ ned_from_body.T @ ned_from_ecef


def write(path: Path, pixels: np.ndarray, place: np.ndarray, angles: np.ndarray) -> None:
    """Write a photo as JPEG, with its tags in XMP as cameras do."""
    made = gdal.GetDriverByName("MEM").Create("", WIDTH, HEIGHT, 1)
    made.WriteArray(np.clip(pixels / 8.0, 0, 255).astype(np.uint8))
    made.SetMetadata(
        {"EXIF_Make": "Simulated", "EXIF_Model": "Pinhole", "EXIF_DateTimeOriginal": "2026:11:25 10:00:00"}
    )
    gdal.GetDriverByName("JPEG").CreateCopy(str(path), made, options=["QUALITY=85", "WRITE_EXIF_METADATA=YES"])
    lon, lat, height = place
    tags = {"GpsLatitude": f"{lat:.8f}", "GpsLongitude": f"{lon:.8f}", "AbsoluteAltitude": f"{height:.2f}",
            "RelativeAltitude": f"{ABOVE:.2f}", "CalibratedFocalLength": f"{FOCAL:.3f}",
            "GimbalYawDegree": f"{angles[0]:.2f}", "GimbalPitchDegree": f"{angles[1]:.2f}",
            "GimbalRollDegree": f"{angles[2]:.2f}"}  # fmt: skip
    values = " ".join(f'drone-dji:{name}="{value}"' for name, value in tags.items())
    values += f' Camera:GPSXYAccuracy="{POSITION}" Camera:GPSZAccuracy="{POSITION}" Camera:VertCS="ellipsoidal"'
    body = b"http://ns.adobe.com/xap/1.0/\0" + _PACKET.format(values=values).encode()
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:])
    path.with_name(path.name + ".aux.xml").unlink(missing_ok=True)


def main(folder: Path) -> None:
    """Write the photos and their truth."""
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(3)
    lon, lat, _ = CENTRE
    x, y = pyproj.Transformer.from_crs("EPSG:4326", MAP_CRS, always_xy=True).transform(lon, lat)
    terrain = Terrain(MAP_CRS, round(x, -2), round(y, -2), LAKE_LEVEL, RELIEF, SEEDS["terrain"])
    landscape = Landscape(terrain, PIXEL, seed=SEEDS["landscape"])
    truth = {}
    for number in range(3):
        place = np.array([lon + (number - 1) * BASE / 88_800.0, lat, 850.0 + ABOVE])
        angles = np.add([90.0, -90.0, 0.0], random.normal(0, 1.5, 3))
        pixels = render(Pinhole(place, turn_of(place, *angles)), terrain, landscape, seed=20 + number)
        name = f"photo{number + 1}.jpg"
        stated = place + random.normal(0, POSITION, 3) / (88_800.0, 111_000.0, 1.0)
        write(folder / name, pixels, stated, angles + random.normal(0, ANGLE, 3))
        truth[name] = {"lon_lat_height": place.round(9).tolist(), "yaw_pitch_roll_deg": angles.round(6).tolist()}
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "photos")
