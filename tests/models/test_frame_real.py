"""Real aerial and drone frames: our projection compared with the given orientations, and orthos that have to agree."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from ortho_frame import open_scene
from orthos import rectify
from scipy.spatial.transform import Rotation
from skimage.registration import phase_cross_correlation

from ortho_pipeline import commands, load_model
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.geodesy.ellipsoid import angles_of_rotation
from ortho_pipeline.models.frame.camera import MAP, TOPOCENTRIC, FrameCamera
from ortho_pipeline.options import OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.raster.source import Grid, RasterSource, open_dataset
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.rays import meet_surface

pytestmark = pytest.mark.realdata
NGI = ("05_0182", "05_0184", "06_0251", "06_0253")


def ngi_camera(folder: Path, strip: str, tmp_path: Path, frame: str = TOPOCENTRIC) -> FrameCamera:
    camera = tmp_path / "dmc.json"
    camera.write_text('{"width": 640, "height": 1152, "focal_length_mm": 120, "sensor_mm": [92.16, 165.888]}')
    rows = [line.split() for line in (folder / "ngi" / "camera_pos_ori.txt").read_text().splitlines()]
    table = tmp_path / "ngi.csv"
    table.write_text("\n".join(["filename,x,y,z,omega,phi,kappa", *(",".join(row) for row in rows)]))
    scene = open_scene(
        open_dataset(folder / "ngi" / f"3324c_2015_1004_{strip}_RGB.tif"),
        camera=str(camera), exterior=str(table), crs=(folder / "io" / "ngi_xyz_opk.prj").read_text().strip(),
        vertical="egm96", frame=frame, heights="100,1200",
    )  # fmt: skip
    return scene.model


def ortho(model: FrameCamera, image: Path, surface: Surface, grid: Grid, path: Path, tolerance: float) -> np.ndarray:
    rectify(model, RasterSource(image), surface, grid, path, resampling="cubic", driver="GTiff", tolerance=tolerance)
    return open_dataset(path).ReadAsArray()[1].astype(float)


def shifts(first: np.ndarray, second: np.ndarray, patch: int = 64, step: int = 48) -> np.ndarray:
    """Return the shifts (columns, rows) of the patches that both orthos have."""
    window, found = np.outer(np.hanning(patch), np.hanning(patch)), []
    for row in range(0, first.shape[0] - patch, step):
        for col in range(0, first.shape[1] - patch, step):
            a, b = (image[row : row + patch, col : col + patch] for image in (first, second))
            if (a == 0).any() or (b == 0).any() or a.std() < 8:
                continue
            shift, *_ = phase_cross_correlation(
                (a - a.mean()) * window, (b - b.mean()) * window, upsample_factor=50, normalization=None
            )
            found.append(shift[::-1])
    return np.array(found)


@pytest.mark.parametrize("strip", NGI)
def test_ngi_camera_stands_where_it_is_said_to(real, tmp_path, strip):
    folder = real / "orthority"
    given = json.loads((folder / "io" / "ngi_ext_param.geojson").read_text())["features"]
    wanted = next(f for f in given if strip in f["properties"]["filename"])
    lon, lat, height = wanted["geometry"]["coordinates"]
    undulation = Vertical.parse("egm96").undulation([lon], [lat])[0]
    centre = ngi_camera(folder, strip, tmp_path).perspective_centre
    np.testing.assert_allclose(centre[:2], (lon, lat), atol=1e-9)
    assert centre[2] == pytest.approx(height + undulation, abs=1e-4)
    in_map = ngi_camera(folder, strip, tmp_path, MAP)
    np.testing.assert_allclose(in_map.exterior[3:], wanted["properties"]["opk"], atol=1e-8)
    # Topocentric and map frame differ by the curvature of the Earth, at most 1.1 m at the corners (0.2 px).
    topocentric = ngi_camera(folder, strip, tmp_path)
    image = np.array([[0, 0], [640, 0], [320, 576], [640, 1152], [0, 1152.0]])
    ground = topocentric.image_to_ground(image, 600.0)
    other = in_map.ground_to_image(ground_transform("EPSG:4979", in_map.crs)(ground))
    assert np.abs(other - image).max() < 0.35
    assert np.abs(other - image)[2].max() < 0.02


@pytest.mark.slow
def test_ngi_orthos_of_side_lapping_frames_agree(real, tmp_path):
    folder = real / "orthority"
    surface = open_dem(folder / "ngi" / "dem.tif", "egm96", override=True)
    crs = parse_crs((folder / "io" / "ngi_xyz_opk.prj").read_text().strip())
    grid = Grid.of_extent(crs, (-60000, -3735000, -53000, -3724000), (5, 5))
    orthos = {
        strip: ortho(
            ngi_camera(folder, strip, tmp_path), folder / "ngi" / f"3324c_2015_1004_{strip}_RGB.tif",
            surface, grid, tmp_path / f"{strip}.tif", 0.02,
        )
        for strip in NGI
    }  # fmt: skip
    for first, second in (("05_0182", "05_0184"), ("06_0251", "06_0253")):
        found = 5.0 * shifts(orthos[first], orthos[second])
        assert len(found) > 50
        assert np.hypot(*np.median(found, axis=0)) < 0.3
    for first, second in (("05_0182", "06_0253"), ("05_0184", "06_0251")):
        # Across the strips, 4 km apart and of opposite headings, the orientations given differ by up to 0.7 m.
        assert np.hypot(*np.median(5.0 * shifts(orthos[first], orthos[second]), axis=0)) < 1.0


def odm_cameras(folder: Path) -> dict[str, tuple[FrameCamera, FrameCamera]]:
    """Return each shot in the reconstruction's own topocentric frame, and as OpenDroneMap uses it in UTM."""
    path = folder / "odm" / "opensfm" / "reconstruction.json"
    first = json.loads(path.read_text())[0]
    from ortho_frame.tables import read_camera

    interior = read_camera(path, 1368, 912)
    place = first["reference_lla"]
    origin = (place["longitude"], place["latitude"], place["altitude"])
    corner = ground_transform("EPSG:4979", "EPSG:32651")([origin])[0]
    cameras = {}
    for name, shot in first["shots"].items():
        turn = Rotation.from_rotvec(shot["rotation"]).as_matrix()
        centre = -turn.T @ shot["translation"]
        # Its camera has y down and z forward.
        exterior = np.array([*centre, *angles_of_rotation(np.diag([1.0, -1.0, -1.0]) @ turn)])
        in_map = exterior + np.array([*corner[:2], 0, 0, 0, 0])
        cameras[name] = (
            FrameCamera(interior, exterior, origin=origin, heights=(55.0, 115.0)),
            FrameCamera.from_map(interior, "EPSG:32651", in_map, frame=MAP, heights=(55.0, 115.0)),
        )
    return cameras


def test_odm_orientations_are_those_given_and_project_as_opensfm_does(real):
    folder = real / "orthority"
    rows = [line.replace("'", "").split() for line in (folder / "io" / "odm_xyz_opk.csv").read_text().splitlines()[1:]]
    document = json.loads((folder / "odm" / "opensfm" / "reconstruction.json").read_text())[0]
    lens = next(iter(document["cameras"].values()))
    for name, (topocentric, in_map) in odm_cameras(folder).items():
        given = np.array(next(row for row in rows if row[0] == name)[1:7], dtype=float)
        np.testing.assert_allclose(in_map.exterior[:3], given[:3], atol=1e-3)
        np.testing.assert_allclose(np.degrees(in_map.exterior[3:]), given[3:], atol=1e-3)
        # OpenSfM's own formulas, in its coordinates, written out.
        shot = document["shots"][name]
        image = np.random.default_rng(0).uniform(0, 1, (100, 2)) * (1368, 912)
        ground = topocentric.image_to_ground(image, 80.0)
        local = topocentric.working_frame.from_ground(ground)
        x, y, z = Rotation.from_rotvec(shot["rotation"]).apply(local).T + np.array(shot["translation"])[:, None]
        x, y = x / z, y / z
        r2 = x**2 + y**2
        radial = 1 + r2 * (lens["k1"] + r2 * (lens["k2"] + r2 * lens["k3"]))
        u = x * radial + 2 * lens["p1"] * x * y + lens["p2"] * (r2 + 2 * x**2)
        v = y * radial + 2 * lens["p2"] * x * y + lens["p1"] * (r2 + 2 * y**2)
        seen = np.stack([lens["focal_x"] * u + lens["c_x"], lens["focal_y"] * v + lens["c_y"]], axis=1) * 1368
        np.testing.assert_allclose(seen + np.array([684, 456]), image, atol=1e-7)


def test_odm_orthos_agree(real, tmp_path):
    folder = real / "orthority"
    surface = open_dem(folder / "odm" / "odm_dem" / "dsm.tif", "ellipsoid")
    grid = Grid.of_extent(parse_crs("EPSG:32651"), (292600, 2730920, 292880, 2731180), (0.2, 0.2))
    # Cameras 80 m above trees: the heights of a block are more than its lattice's polynomial follows to 0.1 px.
    orthos = {
        name: ortho(in_map, folder / "odm" / "images" / f"{name}.tif", surface, grid, tmp_path / f"{name}.tif", 0.15)
        for name, (_, in_map) in odm_cameras(folder).items()
    }
    medians = []
    for first, second in combinations(orthos.values(), 2):
        found = 0.2 * shifts(first, second)
        if len(found) > 10:
            medians.append(float(np.hypot(*np.median(found, axis=0))))
    assert len(medians) >= 4
    assert max(medians) < 0.1


def test_opensfm_poses_open_by_the_option_exterior(real):
    folder = real / "orthority"
    path = folder / "odm" / "opensfm" / "reconstruction.json"
    for name, (topocentric, in_map) in odm_cameras(folder).items():
        dataset = open_dataset(folder / "odm" / "images" / f"{name}.tif")
        # Truth: OpenSfM's own formulas, by which the test above holds these cameras.
        local = open_scene(dataset, exterior=str(path), vertical="ellipsoid", heights="55,115").model
        mapped = open_scene(
            dataset, exterior=str(path), vertical="ellipsoid", heights="55,115", frame=MAP, crs="EPSG:32651"
        ).model
        image = np.random.default_rng(1).uniform(0, 1, (50, 2)) * (1368, 912)
        for found, truth in ((local, topocentric), (mapped, in_map)):
            ground = truth.image_to_ground(image, 80.0)
            np.testing.assert_allclose(found.ground_to_image(ground), image, atol=1e-6)


@pytest.mark.slow
def test_a_drone_scene_is_usable_by_default(real, tmp_path):
    folder = real / "orthority" / "odm"
    name = "100_0005_0142"
    options = {"exterior": str(folder / "opensfm" / "reconstruction.json"), "vertical": "ellipsoid"}
    result = commands.rectify(
        folder / "images" / f"{name}.tif", tmp_path,
        scene=SceneOptions(sensor="frame", sensor_options={**options, "frame": "map", "crs": "EPSG:32651"}),
        surface=SurfaceOptions(dem=folder / "odm_dem" / "dsm.tif", vertical="ellipsoid", fill="mask"),
        output=OutputOptions(format="GTiff"),
    )  # fmt: skip
    report = result.document["report"]
    saved = load_model(result.files["model"])
    # The DSM lies between 57 and 113 m; the camera, 187 m high, sees down to it at 30 degrees: 0.11 to 0.18 m.
    low, high = saved.height_range
    assert 40 < low < 80 < high < 125
    step, _ = report["ortho"]["resolution"]
    assert 0.11 <= step <= 0.18
    surface = open_dem(folder / "odm_dem" / "dsm.tif", "ellipsoid")
    rays = np.random.default_rng(2).uniform(0, 1, (4000, 2)) * (1368, 912)
    met = np.isfinite(meet_surface(saved, rays, surface)).all(axis=1).mean()
    assert report["surface"]["coverage"] == pytest.approx(met, abs=0.03)
    percent = int(report["surface"]["coverage"] * 1000) / 10
    said = [text for text in (*report["warnings"], result.summary) if "covers" in text]
    assert said
    assert all(f"covers {percent} %" in text or "covers 100 %" in text for text in said)
    assert report["ortho"]["valid_share"] > 0.2
