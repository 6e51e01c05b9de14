"""EnMAP level 1B: the RPCs of all bands, their parallax, and the image of a detector in use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from ortho_enmap import parallax, read_enmap
from osgeo import gdal
from products import enmap_text
from seeds import SIZE, rpc
from used import pixels, used

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc_files import rpc_metadata
from ortho_pipeline.host import open_scene
from ortho_pipeline.models import RPC

REAL = Path(
    "sensors", "rpcm", "ENMAP01-____L1B-DT0000001011_20220609T081225Z_001_V010111_20230119T143357Z-METADATA.XML"
)
STEM = "ENMAP01-____L1B-DT0000000001_20220609T081225Z_001_V010111_20230119T143357Z"


def written(entry: ElementTree.Element, lon: float, lat: float, height: float) -> np.ndarray:
    """Return column and row of an entry's RPC, from its terms as they stand there."""

    def of(name: str) -> float:
        return float(entry.findtext(name))

    x, y, z = ((value - of(f"{name}_OFF")) / of(f"{name}_SCALE")
               for value, name in ((lon, "LONG"), (lat, "LAT"), (height, "HEIGHT")))  # fmt: skip
    powers = np.array([1, x, y, z, x * y, x * z, y * z, x * x, y * y, z * z, x * y * z, x**3, x * y * y, x * z * z,
                       x * x * y, y**3, y * z * z, x * x * z, y * y * z, z**3])  # fmt: skip
    found = []
    for axis in ("COL", "ROW"):
        upper, lower = (
            sum(of(f"{axis}_{part}_{k:02d}") * p for k, p in enumerate(powers, 1)) for part in ("NUM", "DEN")
        )
        found.append(upper / lower * of(f"{axis}_SCALE") + of(f"{axis}_OFF"))
    return np.array(found)


@pytest.mark.realdata
def test_rpcs_and_parallax_of_all_bands(real: Path) -> None:
    rpcs, facts = read_enmap(real / REAL)
    assert len(rpcs) == facts["bands_vnir"] + facts["bands_swir"] == 224
    entries = ElementTree.parse(real / REAL).getroot().findall(".//RPC/bandID")
    lon, lat, low, high = 44.2332, 16.1389, 1426.0, 2426.0
    for k in (0, 45, 90, 91, 150, 223):
        for height in (low, high):
            # Its rows and columns count from 0 at the first centre.
            ours = rpcs[k].ground_to_image([[lon, lat, height]])[0] - 0.5
            assert np.abs(ours - written(entries[k], lon, lat, height)).max() < 1e-6
    place = rpcs[45].lon_off, rpcs[45].lat_off
    heights = rpcs[45].h_off - 500.0, rpcs[45].h_off + 500.0
    apart = [written(entries[157], *place, h) - written(entries[45], *place, h) for h in heights]
    assert parallax(rpcs[45], rpcs[157]) == pytest.approx(apart[1] - apart[0], abs=2e-5)
    # Twenty rows of 30 m between the detectors, seen from 650 km: 0.03 px for each kilometre.
    assert parallax(rpcs[45], rpcs[157])[1] == pytest.approx(20.2 / 650, rel=0.15)


@pytest.mark.realdata
def test_corners_are_centres_counted_from_zero(real: Path) -> None:
    """Their heights are not said; along the track, across which relief moves, that is 0.2 px in a kilometre."""
    rpcs, _ = read_enmap(real / REAL)
    root = ElementTree.parse(real / REAL).getroot()
    rows = {"upper_left": 0, "upper_right": 0, "lower_left": 1023, "lower_right": 1023}
    for point in root.findall("base/spatialCoverage/boundingPolygon/point"):
        lon, lat = float(point.findtext("longitude")), float(point.findtext("latitude"))
        if (frame := point.findtext("frame")) in rows:
            assert rpcs[0].ground_to_image([[lon, lat, 1723.0]])[0, 1] == pytest.approx(rows[frame] + 0.5, abs=0.15)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scene").mkdir()
    return tmp_path / "scene"


def bands() -> tuple[RPC, ...]:
    one = rpc()
    infrared = replace(one, row_off=one.row_off + 20.0, h_scale=one.h_scale * 1.01)
    return one, one, replace(one, row_off=one.row_off + 0.3), infrared, infrared


def test_every_command(folder: Path) -> None:
    image = pixels(folder / f"{STEM}-SPECTRAL_IMAGE_VNIR.TIF", SIZE, 3)
    (folder / f"{STEM}-METADATA.XML").write_text(enmap_text(SIZE, bands()))
    height = rpc().h_off
    info = used(image, rpc(), SIZE, sensor="enmap", height=height, correction="shift")
    assert (info["facts"]["detector"], info["facts"]["band"]) == ("VNIR", 2)
    assert [notice["code"] for notice in info["notices"]] == ["bands-differ"]
    other = open_scene(pixels(folder / f"{STEM}-SPECTRAL_IMAGE_SWIR.TIF", SIZE, 2), None, {"band": "1"})
    assert np.abs(other.model.row_off - rpc().row_off) == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [("L1B<", "L2A<", "no RPCs"), ("<channels>2", "<channels>4", "5 RPCs"),
     ("<ROW_SCALE>", "<ROW_SCALE>x", "ROW_SCALE|LINE_SCALE")],
)  # fmt: skip
def test_what_is_refused(folder: Path, old: str, new: str, said: str) -> None:
    image = pixels(folder / f"{STEM}-SPECTRAL_IMAGE_VNIR.TIF", SIZE, 3)
    (folder / f"{STEM}-METADATA.XML").write_text(enmap_text(SIZE, bands()).replace(old, new))
    with pytest.raises(InputError, match=said):
        open_scene(image)


def tagged(image: Path, model: RPC) -> Path:
    gdal.OpenEx(str(image), gdal.OF_UPDATE).SetMetadata(rpc_metadata(model), "RPC")
    return image


def test_a_tag_that_contradicts_the_metadata_is_an_error(folder: Path) -> None:
    image = tagged(pixels(folder / f"{STEM}-SPECTRAL_IMAGE_VNIR.TIF", SIZE, 3), rpc().shifted(0.0, 9.0))
    (folder / f"{STEM}-METADATA.XML").write_text(enmap_text(SIZE, bands()))
    with pytest.raises(InputError, match=r"differ by 9\.0 px") as caught:
        open_scene(image)
    assert caught.value.field == "scene.rpc"
    assert open_scene(image, options={"rpc": "tag"}).model.row_off == pytest.approx(rpc().row_off - 9.0)
    # The metadata have the RPC of each band.
    assert open_scene(tagged(image, bands()[2])).model.row_off == pytest.approx(rpc().row_off)
