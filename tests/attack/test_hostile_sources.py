"""Every hostile file as a source of a harmless VRT, as a layer of a mosaic, and as a scene of `ortho run`."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal, osr

from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc_files import write_rpc_txt
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.warp.mosaic import Ortho, lay_out, write_cog, write_vrt

sys.path.insert(0, str(Path(__file__).parent))
import hostile
from traps import Trap, trapped

UTM = osr.SpatialReference()
UTM.ImportFromEPSG(32734)
PLACE = (5e5, 1.0, 0.0, 4e6, 0.0, -1.0)


@pytest.fixture(scope="module")
def trap(tmp_path_factory) -> Iterator[Trap]:
    yield from trapped(tmp_path_factory)


def view(path: Path | str) -> Path:
    """Write a harmless VRT with a place in a map, next to the folder of a hostile file, which is its only source."""
    name = os.fspath(path)
    folder = next(parent for parent in Path(name.removeprefix("/vsizip/")).parents if parent.name == "files")
    made = folder / f"view-{abs(hash(name))}.vrt"
    relative = 0 if name.startswith("/vsi") else 1
    source = hostile.source(name if not relative else os.path.relpath(name, folder), relative=relative)
    place = f"<SRS>EPSG:32734</SRS><GeoTransform>{', '.join(map(str, PLACE))}</GeoTransform>"
    head = f'<VRTDataset rasterXSize="{hostile.SIDE}" rasterYSize="{hostile.SIDE}">{place}'
    return hostile.vrt(made, source, head)


def honest(path: Path) -> Path:
    """Write an ortho on the grid of the views."""
    made = gdal.Open(str(hostile.raster(path)), gdal.GA_Update)
    made.SetGeoTransform(PLACE)
    made.SetSpatialRef(UTM)
    made = None
    return path


def kept_out(values: np.ndarray) -> bool:
    return not (values == hostile.SECRET).any()


def test_views_of_hostile_files_bite(trap):
    """Without the gate many of them lead GDAL on to the secret, or to the server."""
    bitten = 0
    with contextlib.redirect_stderr(None):
        for path in trap.rasters.values():
            before = len(trap.asked)
            try:
                seen = not kept_out(hostile.pixels(gdal.OpenEx(str(view(path)), gdal.OF_RASTER)))
            except RuntimeError:
                seen = False
            bitten += bool(seen or len(trap.asked) > before)
    trap.asked.clear()
    gdal.VSICurlClearCache()
    assert bitten >= 30


@pytest.mark.parametrize("name", hostile.RECIPES)
def test_a_hostile_file_behind_a_view_and_in_a_mosaic(trap, tmp_path, name):
    if name not in trap.rasters:
        pytest.skip("this GDAL cannot write such a file")
    other = Ortho("honest", honest(tmp_path / "honest.tif"))
    for path in (trap.rasters[name], trap.pipes[name]):
        with contextlib.suppress(InputError):
            assert kept_out(hostile.pixels(open_dataset(view(path))))
        for layer in (view(path), Path(path)):
            try:
                layout = lay_out([other, Ortho("hostile", layer)], "first-on-top")
                write_cog(layout, tmp_path / "mosaic.tif")
                write_vrt(layout, tmp_path / "mosaic.vrt")
            except InputError as error:
                refused = error
            else:
                refused = None
            assert refused is None or (refused.file and refused.remedy)
            for made in tmp_path.glob("mosaic.*"):
                with contextlib.suppress(InputError):
                    assert kept_out(hostile.pixels(open_dataset(made, roots=[layer.parent])))
                made.unlink()
    assert not trap.asked
    assert not trap.readers


def test_a_layer_of_a_mosaic_that_is_no_ortho_is_named(tmp_path):
    other = Ortho("honest", honest(tmp_path / "honest.tif"))
    without, turned = hostile.raster(tmp_path / "without.tif"), honest(tmp_path / "turned.tif")
    made = gdal.Open(str(turned), gdal.GA_Update)
    made.SetGeoTransform((5e5, 1.0, 0.1, 4e6, 0.1, -1.0))
    made = None
    for path in (without, turned):
        with pytest.raises(InputError) as caught:
            lay_out([other, Ortho("one", path)], "first-on-top")
        assert caught.value.file == str(path)
        assert caught.value.remedy


@pytest.mark.parametrize("kind", ["VRT", pytest.param("COG", marks=pytest.mark.slow)])
def test_a_run_of_hostile_scenes_and_its_mosaic(trap, tiny, kind):
    """Scenes whose images are hostile, all with a sound RPC: neither their orthos nor the mosaic hold it."""
    files = next(parent for parent in Path(trap.rasters["vrt-absolute"]).parents if parent.name == "files")
    write_rpc_txt(tiny.model, files / "sound_RPC.TXT")
    scenes = [
        f"  - {{image: '{os.path.relpath(path, files)}', name: '{number}'}}\n"
        for number, path in enumerate(trap.rasters.values())
        if not os.fspath(path).startswith("/vsi") and Path(path).is_file()
    ]
    # One that is honest, so that there is a mosaic whatever a GDAL refuses of the others.
    hostile.raster(files / "honest.tif")
    scenes.append("  - {image: honest.tif}\n")
    (files / "run.yaml").write_text(
        "defaults:\n  scene: {rpc: sound_RPC.TXT}\n  surface: {height: 500}\n"
        f"  output: {{crs: 'EPSG:32734', resolution: 20}}\noutput: out{kind}\n"
        f"mosaic: {{format: {kind}, seams: false}}\n"
        f"scenes:\n{''.join(scenes)}"
    )
    done = CliRunner().invoke(cli, ["run", str(files / "run.yaml"), "--executor", "sequential"])
    assert done.exit_code == 3, done.output[-2000:]
    assert "bug in ortho-pipeline" not in done.output
    made = [*(files / f"out{kind}").rglob("*_ortho.tif"), *(files / f"out{kind}").glob("mosaic.*")]
    assert {"honest_ortho.tif", f"mosaic.{'vrt' if kind == 'VRT' else 'tif'}"} <= {path.name for path in made}
    for path in made:
        if path.suffix in (".tif", ".vrt"):
            assert kept_out(hostile.pixels(open_dataset(path)))
    assert not trap.asked
    assert not trap.readers
