"""Which driver a file needs, and which ones a process without the network does without."""

from __future__ import annotations

from pathlib import Path

import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.opening import drivers
from ortho_pipeline.raster.opening.drivers import (
    DRIVERS,
    driver_for,
    identified,
    remove_network_drivers,
    require_driver,
)


@pytest.mark.parametrize("closed", [True, False])
def test_drivers_that_send_requests_are_removed_where_the_network_is_closed(monkeypatch, closed: bool) -> None:
    """Each that this GDAL has is removed once; the others are passed over."""
    removed: list[str] = []

    class Driver:
        def __init__(self, name: str) -> None:
            self.name = name

        def Deregister(self) -> None:  # noqa: N802  # GDAL's name
            removed.append(self.name)

    monkeypatch.setattr(drivers, "network_is_closed", lambda: closed)
    monkeypatch.setattr(drivers.gdal, "GetDriverByName", lambda name: Driver(name) if name in ("WMS", "HTTP") else None)
    remove_network_drivers.__wrapped__()
    assert removed == (["WMS", "HTTP"] if closed else [])


@pytest.mark.parametrize(
    ("name", "content", "driver"),
    [
        ("a.ntf", b"NITF02.10", "NITF"), ("a.img", b"EHFA_HEADER_TAG....", "HFA"), ("a.dt2", b"UHL1 ...", "DTED"),
        ("a.jp2", b"\x00\x00\x00\x0cjP  ", "JP2OpenJPEG"), ("a.asc", b"ncols 3", "AAIGrid"), ("a.TIL", b"x", "TIL"),
        ("a.hgt", b"x", "SRTMHGT"), ("a.pix", b"x", "PCIDSK"), ("a.tif", b"II*", None), ("a.xml", b"x", None),
        ("a.xml", b"<?xml?>" + b" " * 4000 + b"<Dimap_Document>", "DIMAP"),
        ("a.xml", b" " * 4090 + b"<Dimap_Document>", None), ("a.tif", b" NITF", None),
    ],
)  # fmt: skip
def test_a_file_needs_a_driver_by_its_beginning_or_its_name(tmp_path: Path, name, content, driver) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    assert driver_for(path) == driver
    assert driver_for(tmp_path / "absent.hgt") is None


def test_a_driver_that_this_gdal_lacks_is_an_error() -> None:
    require_driver("GTiff", "a.tif")
    with pytest.raises(InputError, match="built without it"):
        require_driver("NoSuchDriver", "a.tif")


def test_a_raster_is_identified_among_the_allowed_drivers(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    gdal.GetDriverByName("GTiff").Create(str(path), 3, 2, 1).FlushCache()
    assert identified(str(path), DRIVERS) == "GTiff"
    assert identified(str(path), None) == "GTiff"
    assert identified(str(path), ("PNG",)) is None
    assert identified(str(tmp_path / "absent.tif"), None) is None
