"""Radar images on a plane: relief against ranges that are solved in space, and what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal, osr
from products import capella_text
from used import pixels, used

from ortho_pipeline.commands.orthos.opening import open_ortho
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef, geocentric, geodetic
from ortho_pipeline.host import open_scene
from ortho_pipeline.models import MapGrid
from ortho_pipeline.options import SceneOptions

SIZE, CRS = (60, 50), "EPSG:32633"
STEM = "CAPELLA_C02_SM_GEC_HH_20210101000000_20210101000003"


@pytest.fixture
def image(tmp_path: Path) -> Path:
    folder = tmp_path / "scene"
    folder.mkdir()
    path = pixels(folder / f"{STEM}.tif", SIZE)
    dataset = gdal.Open(str(path), gdal.GA_Update)
    system = osr.SpatialReference()
    system.ImportFromEPSG(32633)
    dataset.SetProjection(system.ExportToWkt())
    dataset.SetGeoTransform((500000.0, 5.0, 0.0, 4430000.0, 0.0, -5.0))
    dataset = None
    (folder / f"{STEM}_extended.json").write_text(capella_text())
    return path


def drawn_at(point: np.ndarray, target: np.ndarray, satellite: np.ndarray, track: np.ndarray) -> np.ndarray:
    """Return the place on the plane of `target` (ECEF) with a point's range, and square to the track with it."""
    ground = geodetic(target[None])[0]
    east, north, _ = enu_from_ecef(ground[None])[0]

    def at(place: np.ndarray) -> np.ndarray:
        lon, lat = geodetic((target + place[0] * east + place[1] * north)[None])[0, :2]
        return geocentric(np.array([[lon, lat, ground[2]]]))[0]

    def miss(place: np.ndarray) -> np.ndarray:
        q = at(place)
        return np.array([np.linalg.norm(satellite - q) - np.linalg.norm(satellite - point), (q - point) @ track])

    place = np.zeros(2)
    for _ in range(20):
        slopes = np.column_stack([miss(place + step) - miss(place - step) for step in np.eye(2)]) / 2
        place -= np.linalg.solve(slopes, miss(place))
    return at(place)


def test_relief_is_that_of_equal_ranges(image: Path) -> None:
    """A point and its image on the plane are equally far from the satellite, and next to it, square to its track."""
    model = open_scene(image).model
    document = json.loads(capella_text())
    vectors = document["collect"]["state"]["state_vectors"]
    satellite, velocity = (np.array(vectors[len(vectors) // 2][name]) for name in ("position", "velocity"))
    target = np.array(document["collect"]["image"]["center_pixel"]["target_position"])
    ground, onto = geodetic(target[None])[0], ground_transform("EPSG:4979", CRS)
    for above in (-300.0, 400.0, 800.0):
        raised = np.array([[*ground[:2], ground[2] + above]])
        drawn = drawn_at(geocentric(raised)[0], target, satellite, velocity / np.linalg.norm(velocity))
        relief = np.linalg.norm(drawn - target)
        apart = model.ground_to_image(onto(raised)) - model.ground_to_image(onto(geodetic(drawn[None])))
        # Lines of equal range are round, and the model's are straight: 1 % of the relief.
        assert np.linalg.norm(apart) < 0.012 * relief / 5.0
        assert relief == pytest.approx(abs(above) / math.tan(math.radians(35.0)), rel=0.03)


def test_every_command(image: Path) -> None:
    class Geographic:
        """The model over longitude and latitude, as points are written."""

        def image_to_ground(self, at: np.ndarray, height: object) -> np.ndarray:
            return ground_transform(CRS, "EPSG:4979")(model.image_to_ground(at, height))

    model = open_scene(image).model
    info = used(image, Geographic(), SIZE, sensor="sar", height=float(model.plane), correction="shift")  # type: ignore
    assert [notice["code"] for notice in info["notices"]] == ["radar-on-a-plane", "unchecked-product"]
    assert info["facts"]["incidence_deg"] == pytest.approx(35.0, abs=0.01)


def test_angles_as_options_without_metadata(image: Path) -> None:
    (image.parent / f"{STEM}_extended.json").unlink()
    options = {"incidence": "35", "azimuth": "80", "plane": "100"}
    scene = open_scene(image, "sar", options)
    # It leans towards the radar, which is in the east.
    relief = scene.model.relief
    assert relief[0] == pytest.approx(math.sin(math.radians(80)) / math.tan(math.radians(35)), rel=0.02)
    assert [notice.code for notice in scene.notices] == ["radar-on-a-plane"]
    del options["azimuth"]
    with pytest.raises(InputError, match="unknown for this image: azimuth"):
        open_scene(image, "sar", options)


def test_slant_range_is_refused(image: Path) -> None:
    metadata = image.parent / f"{STEM}_extended.json"
    metadata.write_text(capella_text().replace('"GEC"', '"SLC"'))
    with pytest.raises(InputError, match="slant or ground range") as caught:
        open_scene(image)
    assert "GEC" in caught.value.remedy
    metadata.write_text(capella_text())
    bare = pixels(image.parent / "bare.tif", SIZE)
    with pytest.raises(InputError, match="no map geometry"):
        open_scene(bare, "sar", {"incidence": "35", "azimuth": "80", "plane": "100"})


def test_an_image_on_terrain_is_a_finished_ortho(image: Path) -> None:
    """Capella's GEO; the model of a plane would displace it a second time."""
    (image.parent / f"{STEM}_extended.json").write_text(capella_text().replace('"GEC"', '"GEO"'))
    with pytest.raises(InputError, match=r"no sensor recognises this image.*as a finished ortho is"):
        open_scene(image)
    with pytest.raises(InputError, match="a GEO product is a finished ortho") as caught:
        open_scene(image, "sar")
    assert "use it as it is" in caught.value.remedy
    assert isinstance(open_ortho(image, SceneOptions()).model, MapGrid)


def test_damaged_metadata_are_told_and_not_passed_over(image: Path) -> None:
    metadata = image.parent / f"{STEM}_extended.json"
    metadata.write_text(capella_text()[:-20])
    with pytest.raises(InputError) as caught:
        open_scene(image)
    assert (caught.value.file, "download the metadata again" in caught.value.remedy) == (str(metadata), True)


def test_complex_values_are_slant_range(tmp_path: Path) -> None:
    """SLC and SICD of any vendor, which nothing else knows."""
    gdal.GetDriverByName("GTiff").Create(str(tmp_path / "slc.tif"), *SIZE, 1, gdal.GDT_CFloat32).FlushCache()
    with pytest.raises(InputError, match="this image is in slant range") as caught:
        open_scene(tmp_path / "slc.tif")
    assert "GEC" in caught.value.remedy
