"""Cameras of Ames Stereo Pipeline beside images: states, pinholes, ASTER's lattice, adjustments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ortho_asp.cameras import adjusted, read_adjust, read_aster, read_tsai
from ortho_csm.files import read_csm, write_csm
from ortho_maxar.isd import read_isd_pushbroom
from products import aster_text, isd_text, tsai_text
from used import pixels, ran, used

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.ellipsoid import geocentric, geodetic, meet_height
from ortho_pipeline.host import open_scene
from ortho_pipeline.models import Pushbroom

ASP = Path("sensors", "asp_plot")
SIZE = (60, 50)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scene").mkdir()
    return tmp_path / "scene"


@pytest.fixture
def model(tmp_path: Path) -> Pushbroom:
    (tmp_path / "one.XML").write_text(isd_text(size=SIZE))
    return read_isd_pushbroom(tmp_path / "one.XML").with_heights(150.0, 350.0)


@pytest.mark.realdata
def test_an_adjustment_makes_the_adjusted_state(real: Path) -> None:
    name = str(real / ASP / "ba_cams" / "1040010074793300")
    state, wanted = read_csm(f"{name}.json"), read_csm(f"{name}.adjusted_state.json")
    found = adjusted(state, *read_adjust(Path(f"{name}.adjust")))
    image = np.random.default_rng(0).uniform(0, 38000, (30, 2))
    ground = wanted.image_to_ground(image, 7.0)
    assert np.abs(found.ground_to_image(ground) - image).max() < 1e-6
    assert np.abs(state.ground_to_image(ground) - image).max() > 1.0


@pytest.mark.realdata
@pytest.mark.parametrize("band", ["N", "B"])
def test_aster_looks_along_its_lattice(real: Path, band: str) -> None:
    """Within the six digits of its directions: the printed rays meet the ground where the model sees them."""
    from xml.etree import ElementTree

    path = real / ASP / "no_mapproj" / f"out-Band3{band}.xml"
    model, root = read_aster(path), ElementTree.parse(path).getroot()
    lattice, world, places = (
        np.array(root.findtext(name).split(), dtype=float).reshape(-1, width)
        for name, width in (("LATTICE_POINT", 2), ("WORLD_SIGHT_VECTOR", 3), ("SAT_POS", 3))
    )
    place = np.repeat(places, len(lattice) // len(places), axis=0)
    ground = meet_height(place, world / np.linalg.norm(world, axis=1)[:, None], np.full(len(place), 500.0))
    assert np.abs(model.ground_to_image(ground) - lattice - 0.5).max() < 0.05


def test_every_command_with_a_state(folder: Path, model: Pushbroom) -> None:
    image = pixels(folder / "one.tif", SIZE)
    write_csm(model, folder / "one.json")
    info = used(image, read_csm(folder / "one.json"), SIZE, sensor="asp", height=200.0, correction="model")
    assert info["models"] == {"pushbroom": "pushbroom"}
    found = ran("export", image, "--format", "csm", "-o", folder / "again")
    assert found["csm"]["max_error_px"] < 1e-6
    (again,) = (folder / "again").iterdir()
    assert again.name == "one_csm.json"
    # Adjusted by points that are 3 px to the right and 2 px above, in its own parameters.
    points = ("--gcps", folder / "used" / "p.csv", "--points-crs", "EPSG:4326", "--points-vertical", "ellipsoid")
    ran("export", image, *points, "--correction", "model", "--format", "csm", "-o", folder / "adjusted")
    inner = np.random.default_rng(1).uniform(0.1, 0.9, (10, 2)) * SIZE
    seen = read_csm(folder / "adjusted" / "one_csm.json").ground_to_image(model.image_to_ground(inner, 240.0))
    assert np.abs(seen - inner - (3.0, -2.0)).max() < 0.1
    # An adjusted state of the same image goes before it.
    write_csm(model, folder / "one.adjusted_state.json")
    assert Path(open_scene(image).model_source).name == "one.adjusted_state.json"


def test_an_adjustment_is_applied(folder: Path, model: Pushbroom) -> None:
    image = pixels(folder / "one.tif", SIZE)
    write_csm(model, folder / "one.json")
    lon = np.radians(model.image_to_ground([[30.0, 25.0]], 200.0)[0, 0])
    (folder / "one.adjust").write_text(f"{-10 * np.sin(lon)} {10 * np.cos(lon)} 0\n1 0 0 0\n")  # to the east
    plain, moved = (open_scene(image, None, options).model
                    for options in ({}, {"adjust": str(folder / "one.adjust")}))  # fmt: skip
    first, second = (geocentric(one.image_to_ground([[30.0, 25.0]], 200.0)) for one in (plain, moved))
    assert np.linalg.norm(second - first) == pytest.approx(10.0, abs=0.01)


def test_a_pinhole(folder: Path) -> None:
    image = pixels(folder / "one.tif", SIZE)
    (folder / "one.tsai").write_text(tsai_text())
    model = read_tsai(folder / "one.tsai", SIZE)
    # The formulas of its description, for a point 4 km before the camera.
    fields = dict(line.split(" = ") for line in tsai_text().splitlines() if " = " in line)
    turn, centre = (np.array(fields[name].split(), dtype=float) for name in ("R", "C"))
    ray = np.array([12.0, -7.0, 4000.0])
    ground = turn.reshape(3, 3) @ ray + centre
    seen = [(float(fields[f"f{a}"]) * ray[k] / ray[2] + float(fields[f"c{a}"])) / float(fields["pitch"]) + 0.5
            for k, a in enumerate("uv")]  # fmt: skip
    assert np.abs(model.ground_to_image(geodetic(ground[None])) - seen).max() < 1e-5
    assert open_scene(image).sensor == "asp"
    (folder / "one.tsai").write_text(tsai_text().replace("NULL", "TSAI\nk1 = 0.1"))
    with pytest.raises(InputError, match="distortion TSAI"):
        open_scene(image)


@pytest.mark.parametrize("kind", ["tsai", "aster"])
def test_every_command_with_a_pinhole_or_a_lattice(folder: Path, kind: str) -> None:
    image = pixels(folder / "one.tif", SIZE)
    if kind == "tsai":
        (folder / "one.tsai").write_text(tsai_text())
        truth, height = read_tsai(folder / "one.tsai", SIZE), 200.0
    else:
        (folder / "one.xml").write_text(aster_text(SIZE))
        truth, height = read_aster(folder / "one.xml"), 500.0
    used(image, truth, SIZE, sensor="asp", height=height,
         correction="shift" if kind == "tsai" else "model")  # fmt: skip


def test_an_adjustment_of_a_pinhole(folder: Path) -> None:
    """Its centre moves by the translation, and it turns about itself."""
    (folder / "one.tsai").write_text(tsai_text())
    (folder / "one.adjust").write_text("3.0 -4.0 12.0\n0.9999995 0.0006 -0.0008 0\n")
    scene = open_scene(pixels(folder / "one.tif", SIZE), None, {"adjust": str(folder / "one.adjust")})
    translation, turn = read_adjust(folder / "one.adjust")
    plain, fields = read_tsai(folder / "one.tsai", SIZE), tsai_text().partition("C = ")[2]
    centre = np.array(fields.partition("\n")[0].split(), dtype=float)
    image = np.array([[10.0, 40.0], [55.0, 3.0]])
    ground = geocentric(plain.image_to_ground(image, 100.0))
    moved = (ground - centre) @ turn.T + centre + translation
    assert np.abs(scene.model.ground_to_image(geodetic(moved)) - image).max() < 1e-6


def test_aster_beside_an_image(folder: Path) -> None:
    image = pixels(folder / "one.tif", SIZE)
    (folder / "one.xml").write_text(aster_text(SIZE))
    scene = open_scene(image)
    assert list(scene.models) == ["pushbroom", "rpc"]
    assert scene.model.camera.size == SIZE


def test_an_image_of_another_size_may_be_a_crop(folder: Path, model: Pushbroom) -> None:
    write_csm(model, folder / "one.json")
    image = pixels(folder / "one.tif", (30, 20))
    (notice,) = open_scene(image).notices
    assert notice.code == "maybe-a-crop"
    ground = model.image_to_ground([[22.0, 31.0]], 200.0)
    assert np.abs(open_scene(image, crop_offset=(10, 20)).model.ground_to_image(ground) - (12.0, 11.0)).max() < 0.1
