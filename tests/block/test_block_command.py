"""`ortho adjust` and `ortho intersect`, from files to files."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from ortho_studies.simulation.scanner import LineScanner
from osgeo import gdal
from servers import moto_server

from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import block
from ortho_pipeline.commands.block_images import labels_of, points_of_images, refuse_copies
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import CrsError, DatumError, InputError
from ortho_pipeline.exchange.model_file import load_model
from ortho_pipeline.exchange.rpc import export_rpc, read_rpc, rpc_metadata
from ortho_pipeline.models import RPC
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.report.block import summary_text
from ortho_pipeline.report.block_records import BlockReport
from ortho_pipeline.report.delivered import accuracy_before
from ortho_pipeline.report.wording import NO_SCALE
from ortho_pipeline.stores.objects import Objects
from ortho_pipeline.surface.writing import write_dem

LON, LAT, SIZE = 24.4, -33.65, 400
#: Height of EGM96 there above the ellipsoid (field notes, trap 1).
UNDULATION = 28.208
BIAS = {"aft": (3.0, -2.0), "fore": (-4.0, 6.0)}


class Stereo:
    """A pair of small images, both called BAND.tif, in folders of their own; points with a bias of some pixels."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rpcs: dict[str, RPC] = {}
        for name, angle in (("aft", -12.0), ("fore", 16.0)):
            camera = LineScanner.over(
                LON,
                LAT,
                500.0,
                off_nadir_deg=angle,
                image_width=SIZE,
                image_height=SIZE,
                gsd=10.0,
                heights=(0.0, 1000.0),
            )
            self.rpcs[name] = export_rpc(camera).rpc
            (folder / name).mkdir(parents=True)
            dataset = gdal.GetDriverByName("GTiff").Create(str(self.image(name)), SIZE, SIZE, 1, gdal.GDT_Byte)
            dataset.SetMetadata(rpc_metadata(self.rpcs[name]), "RPC")
            dataset = None
        random = np.random.default_rng(5)
        plan = np.column_stack([random.uniform(-0.013, 0.013, 30) + LON, random.uniform(-0.011, 0.011, 30) + LAT])
        self.ground = np.column_stack([plan, random.uniform(200, 800, 30)])
        self.seen = {
            name: rpc.ground_to_image(self.ground) + BIAS[name] + random.normal(0, 0.1, (30, 2))
            for name, rpc in self.rpcs.items()
        }

    def image(self, name: str) -> Path:
        return self.folder / name / "BAND.tif"

    @property
    def images(self) -> list[str]:
        return [str(self.image(name)) for name in self.rpcs]

    def write(
        self, control: int = 8, check: int = 12, *, header: str = "", dh: float = 0.0, origin: float = 0.0
    ) -> Path:
        """Write the long table: control and check have ground in their first line only, the others tie."""
        lines = [
            header or "#CRS: EPSG:4326\n#vertical: ellipsoid",
            "id,image,col,row,x,y,h,role,sigma_image,sigma_xy,sigma_h",
        ]
        for name, seen in self.seen.items():
            for k, (col, row) in enumerate(seen.tolist()):
                x, y, h = self.ground[k].tolist()
                role = "control" if k < control else "check"
                known = f"{x},{y},{h + dh},{role},0.2,0.1,0.1" if k < control + check and name == "aft" else ",,,,0.2,,"
                lines.append(f"p{k},{name}/BAND.tif,{col + origin},{row + origin},{known}")
        path = self.folder / "rays.csv"
        path.write_text("\n".join(lines) + "\n")
        return path


@pytest.fixture
def stereo(tmp_path: Path) -> Stereo:
    return Stereo(tmp_path / "stereo")


def run(*args: str | Path, code: int = 0) -> str:
    """Run a command; return what it prints, or with --json its document alone."""
    done = CliRunner().invoke(cli, [str(arg) for arg in args])
    assert done.exit_code == code, done.output + str(done.exception)
    return done.stdout if "--json" in args else done.output


# -- points with covariances -----------------------------------------------------------------------------------------


def test_rays_of_a_file_have_their_covariances(tmp_path: Path) -> None:
    path = tmp_path / "rays.csv"
    path.write_text(
        "id,image,col,row,sigma_image,var_col,var_row,cov_col_row\n"
        "a,one,10,20,,0.04,0.25,0.05\na,two,11,21,0.3,,,\nb,two,50,60,,0.09,0.09,0\n"
    )
    points = read_block_points(path)
    wanted = [[[0.04, 0.05], [0.05, 0.25]], 0.09 * np.eye(2), 0.09 * np.eye(2)]
    np.testing.assert_allclose(points.covariance_image, wanted, rtol=1e-12)
    for part in (points.select([0]), points.of_rays([0, 1])):
        np.testing.assert_allclose(part.covariance_image, wanted[:2], rtol=1e-12)
    np.testing.assert_allclose(points.in_image("one").covariance_image, wanted[:1], rtol=1e-12)
    again = BlockPoints.of({name: points.in_image(name) for name in points.images})
    np.testing.assert_allclose(again.covariance_image, wanted, rtol=1e-12)


# -- ortho adjust ----------------------------------------------------------------------------------------------------


def test_adjust_writes_models_points_rpcs_and_one_report(stereo: Stereo, tmp_path: Path) -> None:
    out = tmp_path / "out"
    document = json.loads(run("adjust", *stereo.images, "--points", stereo.write(), "-o", out, "--json"))
    files = {name: Path(path) for name, path in document["files"].items()}
    assert sorted(path.name for path in out.iterdir()) == sorted(path.name for path in files.values())
    # Two images of one stem do not overwrite each other.
    assert {"aft_BAND_model.json", "fore_BAND_model.json", "aft_BAND_RPC.TXT", "fore_BAND_RPC.TXT"} <= {
        path.name for path in files.values()
    }
    adjustment = document["report"]["adjustment"]
    for name, bias in BIAS.items():
        found = adjustment["images"][f"{name}_BAND"]["parameters"]
        assert found["col_shift"]["value"] == pytest.approx(bias[0], abs=0.15)
        assert found["row_shift"]["value"] == pytest.approx(bias[1], abs=0.15)
        model = load_model(files[f"{name}_BAND model"])
        exported = read_rpc(files[f"{name}_BAND rpc"])
        np.testing.assert_allclose(
            exported.ground_to_image(stereo.ground), model.ground_to_image(stereo.ground), atol=1e-5
        )
        residual = stereo.seen[name] - model.ground_to_image(stereo.ground)
        assert np.sqrt((residual**2).mean()) < 0.2
    # 10 m pixels measured to 0.1: a metre or two.
    assert adjustment["object_rms"]["check"]["n"] == 12
    assert adjustment["object_rms"]["check"]["plan"] < 2.5
    assert "8 control points" in adjustment["gauge"]


@pytest.mark.parametrize("which", ["points", "image"])
def test_files_that_change_during_an_adjustment_end_it(
    stereo: Stereo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, which: str
) -> None:
    points, images = stereo.write(), stereo.images
    changing = points if which == "points" else images[1]
    adjust_block = block.adjust_block

    def changed(*given: Any, **more: Any) -> Any:
        os.utime(changing, ns=(1, 1))
        return adjust_block(*given, **more)

    monkeypatch.setattr(block, "adjust_block", changed)
    done = CliRunner().invoke(cli, ["adjust", *map(str, images), "--points", str(points), "-o", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert f"{changing}: this file changed during the run" in done.output
    assert not (tmp_path / "out").exists()


def test_adjust_names_the_images_of_a_folder_that_it_leaves_out(stereo: Stereo, tmp_path: Path) -> None:
    (stereo.folder / "damaged.jpeg").write_bytes(b"\xff\xd8\xff\xe0")
    args = ("adjust", stereo.folder, "--points", stereo.write(), "-o", tmp_path / "out", "--json")
    notices = json.loads(run(*args))["report"]["notices"]
    [notice] = [one for one in notices if one["code"] == "images-left-out"]
    assert (notice["count"], notice["images"]) == (1, ["damaged.jpeg"])
    assert "1 image of the folder cannot be used: damaged.jpeg: cannot be opened: " in notice["text"]


def test_written_points_are_read_as_ground_again(stereo: Stereo, tmp_path: Path) -> None:
    out = tmp_path / "out"
    points = stereo.write()
    run("adjust", *stereo.images, "--points", points, "-o", out)
    again = read_block_points(points_without_ground(points), gcps=out / "block_points.csv")
    assert (again.sigma_ground > 0).all()
    apart = (again.ground - stereo.ground) * (92_000.0, 111_000.0, 1.0)
    assert (np.abs(apart) < 4.5 * again.sigma_ground).all()
    geo = json.loads((out / "block_points.geojson").read_text())
    first = geo["features"][0]
    assert first["properties"]["kind"] == "control"
    assert first["properties"]["rays"] == 2
    assert 0 < first["properties"]["sigma_h"] < 10
    np.testing.assert_allclose(first["geometry"]["coordinates"], stereo.ground[0], rtol=0, atol=2.0)
    wide = read_block_points(points_without_ground(points), gcps=out / "block_points.geojson")
    np.testing.assert_allclose(wide.ground, again.ground, atol=1e-9)


def test_what_adjust_writes_goes_to_a_store(stereo: Stereo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with moto_server("blocks") as (host, port):
        at = {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_REGION": "us-east-1"}
        for name, value in (at | dict.fromkeys(("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), "test")).items():
            monkeypatch.setenv(name, value)
        args = ("adjust", *stereo.images, "--points", stereo.write(), "--json", "-o")
        assert "--allow-network" in json.loads(run(*args, "s3://blocks/out", code=2))["error"]["remedy"]
        there = json.loads(run(*args, "s3://blocks/out", "--allow-network"))
        here = json.loads(run(*args, tmp_path / "out"))
        store = Objects("s3://blocks/out", allow_network=True)
        listed = {one["name"] for one in json.loads(store.read("block_delivery.json", 1 << 20)[0])["files"]}
        assert {name for name, _ in store.names()} == listed | {"block_delivery.json"}
        assert {Path(path).name for path in there["files"].values()} == listed
        assert there["files"] == {
            kind: path.replace(str(tmp_path), "s3://blocks") for kind, path in here["files"].items()
        }
        rays = ("intersect", *stereo.images, "--points", stereo.write(), "--allow-network", "--json", "-o")
        assert json.loads(run(*rays, "s3://blocks/rays/all.csv"))["files"] == {"points": "s3://blocks/rays/all.csv"}
        run(*rays, tmp_path / "all.csv")
        rays_there = Objects("s3://blocks/rays", allow_network=True)
        assert {name for name, _ in rays_there.names()} == {"all.csv", "all_delivery.json"}
        assert rays_there.read("all.csv", 1 << 20)[0] == (tmp_path / "all.csv").read_bytes()


def test_an_adjustment_starts_from_saved_models(stereo: Stereo, tmp_path: Path) -> None:
    points = stereo.write()
    first = json.loads(run("adjust", *stereo.images, "--points", points, "-o", tmp_path / "one", "--json"))
    saved = [arg for name in BIAS for arg in ("--models", first["files"][f"{name}_BAND model"])]
    again = json.loads(run("adjust", *stereo.images, "--points", points, *saved, "-o", tmp_path / "two", "--json"))
    for name in BIAS:
        one, two = (
            load_model(tmp_path / folder / f"{name}_BAND_model.json").ground_to_image(stereo.ground)
            for folder in ("one", "two")
        )
        np.testing.assert_allclose(two, one, rtol=0, atol=1e-4)
        start = again["report"]["images"][f"{name}_BAND"]["model_source"]
        assert f"{name}_BAND_model.json" in start
    # It started there: as delivered the images were some pixels off, now a tenth.
    raw = again["report"]["adjustment"]["images"]["aft_BAND"]["rms"]["raw_residuals"]["check"]
    assert raw["total"] < 0.5
    inputs = {entry["path"] for entry in again["report"]["provenance"]["inputs"]}
    assert any(path.endswith("one/aft_BAND_model.json") for path in inputs)
    # Other corrections go on top, and one model for two images is refused.
    run("adjust", *stereo.images, "--points", points, *saved, "--correction", "affine", "-o", tmp_path / "three")
    assert "1 model for 2 images" in run(
        "adjust", *stereo.images, "--points", points, *saved[:2], "-o", tmp_path, code=2
    )


def test_ground_sigmas_are_estimated_or_stated_by_hand(stereo: Stereo, tmp_path: Path) -> None:
    points = stereo.write()
    points.write_text(points.read_text().replace(",0.2,0.1,0.1", ",0.2,,"))
    text = run("adjust", *stereo.images, "--points", points, "-o", tmp_path / "out")
    assert "8 control points state no ground accuracy; estimated: " in text
    assert "--ground-sigma" in text
    assert "state no ground accuracy" in (tmp_path / "out" / "block_report.html").read_text()
    args = ("adjust", *stereo.images, "--points", points, "-o", tmp_path / "out")
    report = json.loads(run(*args, "--ground-sigma", "0.1,0.2", "--json"))["report"]
    assert report["adjustment"]["variances"]["unstated_ground"]["h"]["points"] == 0
    assert report["provenance"]["options"]["block"]["ground_sigma"] == "0.1,0.2"
    for wrong in ("a", "1,2,3", "0", "-1", "nan"):
        assert "--ground-sigma" in run(*args, "--ground-sigma", wrong, code=2)


def points_without_ground(path: Path) -> Path:
    """Write the same rays without any ground."""
    lines = [line.split(",")[:4] for line in path.read_text().splitlines() if not line.startswith("#")]
    bare = path.with_name("bare.csv")
    bare.write_text("\n".join(",".join(line) for line in lines) + "\n")
    return bare


def test_the_report_is_one_page_in_both_lights(stereo: Stereo, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run("adjust", *stereo.images, "--points", stereo.write(), "-o", out)
    page = (out / "block_report.html").read_text()
    for text in ("prefers-color-scheme: dark", "aft_BAND", "fore_BAND", "12 check points", "Standard error", "<svg"):
        assert text in page
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in page
    # Notices say what to do, and one script, named by its digest, sorts the tables.
    assert "Use at least 30 check points" in page
    assert page.count("<script") == page.count("script-src &#39;sha256-") == 1
    report = json.loads((out / "block_report.json").read_text())
    assert report["document"] == "ortho-pipeline block report"
    assert {entry["role"] for entry in report["provenance"]["inputs"]} >= {"image", "points"}
    assert any("ASPRS" in text for text in report["warnings"])
    # The network of the images, and a card of each with its picture.
    assert page.count('data-plot="network"') == 1
    assert page.count('src="data:image/png;base64,') == 2
    assert '<tr><td>aft_BAND</td><td>fore_BAND</td><td class="n">30</td>' in page
    assert "Good enough for maps at 1:" in page
    network = report["network"]
    assert [(one["first"], one["second"], one["points"]) for one in network["pairs"]] == [("aft_BAND", "fore_BAND", 30)]
    # The cameras look 12 and 16 degrees from the vertical to either side, a little more where the Earth is round.
    assert 28.0 < network["angles"]["median"] < 32.0
    assert [len(part) for part in network["parts"]] == [2]
    for name in ("aft", "fore"):
        outline = np.array(report["images"][f"{name}_BAND"]["outline"])
        assert (
            np.abs(
                outline - stereo.rpcs[name].image_to_ground([[0, 0], [400, 0], [400, 400], [0, 400]], 500.0)[:, :2]
            ).max()
            < 2e-3
        )
        assert report["images"][f"{name}_BAND"]["covered"] == pytest.approx(0.5, abs=0.15)


def verdict_of(out: Path) -> str:
    (said,) = re.findall(r'<p class="verdict">(.*?)</p>', (out / "block_report.html").read_text())
    return html.unescape(said)


def test_the_verdict_leads_with_known_points_that_contradict_the_block(stereo: Stereo, tmp_path: Path) -> None:
    """One check point of twelve is wrong in height by much, then by little."""
    truth = stereo.ground[9].copy()
    stereo.ground[9, 2] += 60.0
    out = tmp_path / "wrong"
    said = run("adjust", *stereo.images, "--points", stereo.write(), "-o", out)
    against = "1 of 12 check points contradicts the block (p9)"
    assert verdict_of(out) == NO_SCALE
    assert f"Accuracy unknown: {against}" in said.split("Warning")[0]
    report = json.loads((out / "block_report.json").read_text())
    (notice,) = [one for one in report["notices"] if "p9" in one["text"]]
    assert notice["code"] == "checks-apart"
    assert (notice["off"], notice["count"], notice["points"]) == (1, 12, ["p9"])
    rms = report["adjustment"]["object_rms"]["check"]
    assert notice["rmse_m"] == pytest.approx({"plan": rms["plan"], "height": rms["h"]})
    page = (out / "block_report.html").read_text()
    assert (
        page.index('<li class="stop">')
        < page.index("p9: its given height differs by")
        < page.index('<li class="look">')
    )
    # Near enough that the RMSE still says how accurate the others are: named first, and the claim stands.
    stereo.ground[9] = truth + np.array([0.0, 0.0, 20.0])
    said = run("adjust", *stereo.images, "--points", stereo.write(), "-o", tmp_path / "near")
    assert verdict_of(tmp_path / "near").startswith("1 of 12 check points contradicts the block (p9): without it 0.")
    assert "Good enough for maps at 1:" in verdict_of(tmp_path / "near")
    assert verdict_of(tmp_path / "near").endswith("This does not cover heights.")
    assert (tmp_path / "near" / "block_report.html").read_text().count('class="doubted"') == 1
    assert "Warning: Check point p9: its given height differs by" in said


def test_empty_parts_of_images_are_said(stereo: Stereo, tmp_path: Path) -> None:
    """Points in a corner of the images: what they do not hold is named, in each image."""
    corner = [k for k in range(30) if (stereo.seen["aft"][k] < 260).all() and (stereo.seen["fore"][k] < 260).all()]
    assert len(corner) >= 5
    points = stereo.write()
    kept = [
        line for line in points.read_text().splitlines()
        if line.startswith(("#", "id")) or line.split(",")[0] in {f"p{j}" for j in corner}
    ]  # fmt: skip
    points.write_text("\n".join(kept) + "\n")
    run("adjust", *stereo.images, "--points", points, "-o", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "block_report.json").read_text())
    (notice,) = (one for one in report["notices"] if one["code"] == "points-cover-part")
    assert set(notice["share"]) == {"aft_BAND", "fore_BAND"}
    assert max(notice["share"].values()) < 0.7
    assert "ties where images overlap, control elsewhere" in (tmp_path / "out" / "block_report.html").read_text()


def test_ties_alone_hold_the_datum_and_say_so(stereo: Stereo, tmp_path: Path) -> None:
    points = points_without_ground(stereo.write())
    text = run("adjust", *stereo.images, "--points", points, "-o", tmp_path / "out")
    lines = text.splitlines()
    first = lines.index("Accuracy unknown: there are no check points")
    assert lines[first + 1].startswith("The images agree to 0.")
    assert "tests neither positions nor heights" in lines[first + 1]
    assert lines[first + 2].startswith(
        "No control points: positions and heights are only as accurate as the delivered models"
    )
    head = json.loads((tmp_path / "out" / "block_report.json").read_text())["headline"]
    assert (head["figure"], head["height"]) == ("Accuracy unknown", None)
    page = (tmp_path / "out" / "block_report.html").read_text()
    assert '<p class="figure">Accuracy unknown</p>' in page
    assert "No point tests the accuracy of this result." in page
    # Nor is it the figure of an ortho that is made with such a model.
    saved = SceneOptions(model=tmp_path / "out" / "aft_BAND_model.json")
    delivered = accuracy_before(open_scene(stereo.images[0], saved))
    assert delivered.figure == "Accuracy unknown"
    assert delivered.notes[0].startswith("There the images agree to 0.")


@pytest.mark.parametrize("crs", ["geocentric", "utm"])
def test_a_family_is_fitted_from_the_points(stereo: Stereo, tmp_path: Path, crs: str) -> None:
    document = json.loads(
        run("adjust", *stereo.images, "--points", stereo.write(15, 15), "-o", tmp_path / "out", "--json",
            "--model", "affine3d", "--model-crs", crs)
    )  # fmt: skip
    image = document["report"]["images"]["aft_BAND"]
    assert image["model"] == "affine3d"
    assert "15 control points" in image["model_source"]
    # Not quite an affine projection, but nearly, over 4 km.
    assert document["report"]["adjustment"]["object_rms"]["check"]["plan"] < 4.0


def test_one_image_is_tested_in_the_image(stereo: Stereo, tmp_path: Path) -> None:
    args = ("--points", stereo.write(), "-o", tmp_path, "--json")
    report = json.loads(run("adjust", stereo.images[0], *args))["report"]
    # One ray determines no ground, but known ground has a place in the image.
    assert report["adjustment"]["object_rms"]["check"] is None
    assert report["headline"]["figure"].endswith(" px")
    assert "12 measurements of check points" in report["headline"]["what"]
    assert any("12 check points: fewer than" in text for text in report["warnings"])


def test_nothing_is_claimed_of_a_fit_to_control_alone(stereo: Stereo, tmp_path: Path) -> None:
    images = stereo.images
    report = json.loads(
        run("adjust", *images, "--points", stereo.write(8, 0), "-o", tmp_path, "--json")
    )["report"]  # fmt: skip
    head = report["headline"]
    assert (head["figure"], head["what"]) == ("Accuracy unknown", "there are no check points")
    assert "control points in the images. This does not test the accuracy." in head["notes"][0]
    lines = stereo.write(3, 0).read_text().splitlines()
    few = tmp_path / "few.csv"
    few.write_text("\n".join(lines[:3] + [line for line in lines if line.startswith(("p0,", "p1,", "p2,"))]) + "\n")
    alone = run("adjust", images[0], "--points", few, "--correction", "affine", "-o", tmp_path)
    assert "Accuracy unknown: no point is left to test the fit" in alone


def test_correction_none_only_intersects(stereo: Stereo, tmp_path: Path) -> None:
    given = ("adjust", *stereo.images, "--points", stereo.write(0, 20), "-o", tmp_path / "out", "--json")
    document = json.loads(run(*given, "--correction", "none"))
    adjustment = document["report"]["adjustment"]
    assert adjustment["images"]["aft_BAND"]["parameters"] == {}
    assert adjustment["object_rms"]["check"]["plan"] > 15
    assert load_model(document["files"]["aft_BAND model"]).kind == "rpc"
    report = document["report"]
    assert (report["absolute"], report["relative"], report["network"]["pairs"][0]["sigma_px"]) == (None, None, None)


def test_check_option_and_gross_errors(stereo: Stereo, tmp_path: Path) -> None:
    stereo.seen["fore"][3] += (12.0, 9.0)
    points = stereo.write(20, 0)
    document = json.loads(
        run("adjust", *stereo.images, "--points", points, "-o", tmp_path / "out", "--check", "every:2", "--json")
    )
    adjustment = document["report"]["adjustment"]
    assert [entry["id"] for entry in adjustment["points"] if entry["role"] == "check"][:3] == ["p1", "p3", "p5"]
    assert [one["point"] for one in adjustment["rejected"]] == ["p3"]
    assert any("p3" in text and "gross error" in text for text in document["report"]["warnings"])


def test_geoid_heights_are_brought_to_the_ellipsoid(stereo: Stereo, tmp_path: Path) -> None:
    points = stereo.write(header="#CRS: EPSG:4326", dh=-UNDULATION)
    given = ("adjust", *stereo.images, "--points", points, "-o", tmp_path / "out", "--json")
    assert "--points-vertical" in json.loads(run(*given, code=2))["error"]["field"]
    document = json.loads(run(*given, "--points-vertical", "egm96"))
    # 28 m of height are 6 to 8 m in the image of either side: a wrong datum would be seen as a bias.
    assert document["report"]["adjustment"]["images"]["aft_BAND"]["parameters"]["col_shift"]["value"] == pytest.approx(
        BIAS["aft"][0], abs=0.15
    )


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--model", "pushbroom"), "has no model 'pushbroom'"),
        (("--model", "affine3d", "--correction", "shift"), "takes no correction"),
        (("--model-crs", "utm"), "only for fitted models"),
        (("--correction", "model"), "no parameters of its own to adjust"),
        (("--check", "every:0"), "not a selection of check points"),
    ],
)
def test_options_that_do_not_go_together(stereo: Stereo, tmp_path: Path, args: tuple[str, ...], message: str) -> None:
    assert message in run("adjust", *stereo.images, "--points", stereo.write(), "-o", tmp_path / "out", *args, code=2)
    assert not (tmp_path / "out").exists()


def test_outputs_beside_the_images_are_refused(stereo: Stereo) -> None:
    text = run("adjust", *stereo.images, "--points", stereo.write(), "-o", stereo.folder / "aft", code=2)
    assert "would attach to the source image" in text


# -- ortho intersect -------------------------------------------------------------------------------------------------


def test_intersect_with_saved_models(stereo: Stereo, tmp_path: Path) -> None:
    points, out = stereo.write(), tmp_path / "out"
    run("adjust", *stereo.images, "--points", points, "-o", out)
    table = tmp_path / "found.geojson"
    saved = [arg for name in BIAS for arg in ("--models", str(out / f"{name}_BAND_model.json"))]
    document = json.loads(run("intersect", *stereo.images, "--points", points, *saved, "-o", table, "--json"))
    found = np.array([row["ground"] for row in document["points"]])
    np.testing.assert_allclose(found[:, 2], stereo.ground[:, 2], atol=15.0)
    apart = np.array([row["residual"] for row in document["points"][:20]])
    assert np.sqrt((apart[:, :2] ** 2).mean()) < 2.5
    assert document["points"][25]["residual"] is None
    assert len(json.loads(table.read_text())["features"]) == 30
    # Without them the images' own models, with their bias.
    raw = json.loads(run("intersect", *stereo.images, "--points", points, "--json"))
    assert np.abs(np.array([row["residual"] for row in raw["points"][:20]])[:, :2]).max() > 20
    assert "sigma0" in run("intersect", *stereo.images, "--points", points)
    assert "2 images" in run("intersect", *stereo.images, "--points", points, *saved[:2], code=2)


# -- images and their points -----------------------------------------------------------------------------------------


def test_labels_are_unique(tmp_path: Path) -> None:
    paths = [tmp_path / "a" / "x.tif", tmp_path / "b" / "x.tif", tmp_path / "b" / "y.tif", tmp_path / "b" / "Y.jp2"]
    labels = labels_of(paths)
    assert labels[:2] == ["a_x", "b_x"]
    assert len({label.lower() for label in labels}) == 4
    with pytest.raises(InputError, match="listed twice"):
        labels_of([paths[0], paths[1], paths[0]])


def test_a_copy_of_an_image_is_refused(sample: Path, tmp_path: Path) -> None:
    """Their ties fit perfectly, and the errors that both have would count as independent."""
    images = [sample / "photos" / f"photo{number}.jpg" for number in (1, 2)]
    refuse_copies(images, [SceneOptions()] * 2)
    copy = Path(shutil.copy(images[0], tmp_path / "photo1 (1).jpg"))
    with pytest.raises(InputError, match=r"this is a copy of .*photo1\.jpg") as error:
        refuse_copies([*images, copy], [SceneOptions()] * 3)
    assert str(error.value.file) == str(copy)
    # The same pixels with models of their own, as of simulations, are different images.
    other = SceneOptions(sensor_options={"pitch": "horizon", "heights": "0,100"})
    refuse_copies([images[0], copy], [SceneOptions(), other])


def test_names_in_point_files_find_their_images(stereo: Stereo) -> None:
    points = read_block_points(stereo.write())
    table, strangers = points_of_images(points, stereo.images, ["a", "f"])
    assert table.images == ("a", "f")
    assert not strangers
    one, strangers = points_of_images(points, stereo.images[:1], ["a"])
    assert strangers == ["fore/BAND.tif"]
    assert one.rays == 30
    text = stereo.write().read_text().replace("aft/BAND.tif", "BAND").replace("fore/BAND.tif", "other")
    (stereo.folder / "rays.csv").write_text(text)
    with pytest.raises(InputError, match="ambiguous"):
        points_of_images(read_block_points(stereo.folder / "rays.csv"), stereo.images, ["a", "f"])


# -- point files -----------------------------------------------------------------------------------------------------

HEADER = "#CRS: EPSG:4326\n#vertical: ellipsoid\nid,image,col,row,x,y,h,role\n"


def read(tmp_path: Path, text: str, name: str = "rays.csv", **options: str | Path) -> BlockPoints:
    path = tmp_path / name
    path.write_text(text)
    return read_block_points(path, **options)  # type: ignore[arg-type]


def test_long_and_wide_forms_are_the_same(stereo: Stereo, tmp_path: Path) -> None:
    long = read_block_points(stereo.write())
    features = []
    for k in range(30):
        known = k < 20
        features.append({
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": stereo.ground[k].tolist()} if known else None,
            "properties": {
                "id": f"p{k}", "sigma_image": 0.2,
                "ji": {f"{name}/BAND.tif": (stereo.seen[name][k] - 0.5).tolist() for name in BIAS},
                **({"role": "control" if k < 8 else "check", "sigma_xy": 0.1, "sigma_h": 0.1} if known else {}),
            },
        })  # fmt: skip
    text = json.dumps({"type": "FeatureCollection", "features": features})
    wide = read(tmp_path, text, "rays.geojson")
    assert wide.ids == long.ids
    assert (wide.roles == long.roles).all()
    np.testing.assert_allclose(wide.ground, long.ground, atol=1e-12)
    order = np.lexsort((long.image, long.point))
    other = np.lexsort((np.array([long.images.index(wide.images[i]) for i in wide.image]), wide.point))
    np.testing.assert_allclose(wide.measured[other], long.measured[order], atol=1e-9)
    np.testing.assert_array_equal(wide.sigma_ground, long.sigma_ground)


def test_odm_lists_hold_blocks_too(tmp_path: Path) -> None:
    text = "EPSG:32634\n500000 4000000 10 5.5 6.5 a.tif one\n500000 4000000 10 7.5 8.5 b.tif one\n"
    text += "500100 4000000 11 15.5 6.5 a.tif\n500100 4000000 11 17.5 8.5 b.tif\n"
    points = read(tmp_path, text, "gcp_list.txt", vertical="ellipsoid")
    assert points.ids == ("one", "point 1")
    assert points.rays == 4
    assert points.control.all()
    with pytest.raises(DatumError):
        read(tmp_path, text, "gcp_list.txt")


def test_pixel_centres_and_ground_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "ground.csv").write_text("id,x,y,h,role\na,24.4,-33.6,100,check\nz,24.5,-33.6,100,control\n")
    text = "id,image,col,row\na,l.tif,10,20\na,r.tif,30,40\nb,l.tif,11,21\n"
    given = {"gcps": tmp_path / "ground.csv", "crs": "EPSG:4326", "vertical": "ellipsoid"}
    points = read(tmp_path, text, pixel_origin="center", **given)
    np.testing.assert_array_equal(points.measured, [[10.5, 20.5], [30.5, 40.5], [11.5, 21.5]])
    assert points.roles.tolist() == ["check", "tie"]
    with pytest.raises(CrsError, match="CRS of these points is unknown"):
        read(tmp_path, text, gcps=tmp_path / "ground.csv")
    (tmp_path / "ground.csv").write_text("id,x,y,h\nq,24.4,-33.6,100\n")
    with pytest.raises(InputError, match="no image shows any of these points"):
        read(tmp_path, text, **given)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("a,l,1,2,24,-33,5,\na,r,1,2,24,-33,6,\n", "the h of the point 'a'"),
        ("a,l,1,2,24,-33,5,control\na,r,1,2,,,,check\n", "the role of the point 'a'"),
        ("a,l,1,2,,,,\na,l,3,4,,,,\n", "measured twice in the image 'l'"),
        ("a,l,1,2,,,,\nb,l,1,2,,,,\n", "the same pixel of the same image"),
        ("a,l,1,2,24,-33,5,\nb,l,3,4,24,-33,5,\n", "have the same ground"),
        ("a,l,1,2,24,,5,\n", "x, y or both are missing"),
        ("a,l,1,2,,,,control\n", "control points without ground"),
        ("a,l,1,nan,,,,\n", "is not a number"),
        ("a,,1,2,,,,\n", "this point has no image"),
        (",l,1,2,,,,\n", "this point has no id"),
        ("a,l,1,2,240000,-33,5,\n", None),
        ("", "this file has no points"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, lines: str, message: str | None) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, HEADER + lines)
    assert caught.value.file


def test_a_file_of_one_image_is_no_block(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no column image"):
        read(tmp_path, "id,col,row,x,y,h\na,1,2,24,-33,5\n")
    feature = {
        "type": "Feature", "geometry": {"type": "Point", "coordinates": [24, -33, 5]}, "properties": {"ji": [1, 2]},
    }  # fmt: skip
    with pytest.raises(InputError, match="does not name its image"):
        read(tmp_path, json.dumps({"type": "FeatureCollection", "features": [feature]}), "a.geojson")


def test_images_in_an_archive_are_adjusted_and_intersected_as_those_on_disk(stereo: Stereo, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "pair.zip", "w") as made:
        for name in stereo.rpcs:
            made.write(stereo.image(name), f"{name}/BAND.tif")
    inside = [f"/vsizip/{tmp_path / 'pair.zip'}/{name}/BAND.tif" for name in stereo.rpcs]
    points = stereo.write()
    for command in ("adjust", "intersect"):
        found = []
        for label, images in (("disk", stereo.images), ("zip", inside)):
            out = tmp_path / f"{command}-{label}"
            target = out if command == "adjust" else out / "points.geojson"
            found.append(json.loads(run(command, *images, "--points", points, "-o", target, "--json")))
        one, other = (document["report"]["adjustment"]["images"] if command == "adjust" else document["points"]
                      for document in found)  # fmt: skip
        assert one == other


def test_control_that_was_held_has_no_rmse_of_zero(stereo: Stereo, tmp_path: Path) -> None:
    """Ground that a reference gives and that is held fits itself: its RMSE of 0.000 would read as a success."""
    run("adjust", *stereo.images, "--points", stereo.write(), "-o", tmp_path / "out")
    document = json.loads((tmp_path / "out" / "block_report.json").read_text())
    known = document["adjustment"]["object_rms"]["control"] or document["adjustment"]["object_rms"]["check"]
    zero = {name: [0.0] * 3 if isinstance(value, list) else 0.0 for name, value in known.items()} | {"n": 1504}
    document["adjustment"]["object_rms"]["control"] = zero
    said = summary_text(BlockReport.read(document))
    assert "1504 control points: held at the given coordinates, so no RMSE on the ground" in said
    assert "RMSE E 0.000" not in said


def test_heights_of_a_dem_hold_a_pair_without_control(tmp_path: Path) -> None:
    """A DEM is read for points of a file too; the report has its heights, and how well the images fit."""
    pair = Stereo(tmp_path)
    rows = ["id,image,col,row,sigma_image"]
    for name, seen in pair.seen.items():
        rows += [f"p{k},{name}/BAND.tif,{col},{row},0.2" for k, (col, row) in enumerate(seen.tolist())]
    ties = tmp_path / "ties.csv"
    ties.write_text("\n".join(rows))
    plane = tmp_path / "dem.tif"
    # Heights of a smooth DEM through the points' own would be better: this one says 500 m to 200 m.
    write_dem(plane, np.full((40, 40), 500.0), (LON - 0.05, LAT + 0.05), 0.0025, "EPSG:4326")
    dem = ["--dem", str(plane), "--dem-vertical", "ellipsoid", "--dem-sigma", "200"]
    words = ["adjust", *pair.images, "--points", str(ties), "--correction", "shift", "--json"]

    def adjusted(*more: str) -> tuple[int, dict]:
        result = CliRunner().invoke(cli, [*words, "-o", str(tmp_path / "out"), *more])
        return result.exit_code, json.loads(result.stdout) if result.exit_code == 0 else {"said": result.output}

    code, document = adjusted(*dem)
    assert code == 0
    report = document["report"]
    assert report["adjustment"]["heights"]["used"] == 30
    assert report["adjustment"]["heights"]["sigma_is"] == "stated"
    assert report["network"]["pairs"][0]["sigma_px"] > 0.5
    assert report["network"]["pairs"][0]["weak"]
    assert "weak-join" in [notice["code"] for notice in report["notices"]]
    code, document = adjusted(*dem, "--join-limit", "1000")
    assert "weak-join" not in [notice["code"] for notice in document["report"]["notices"]]
    code, document = adjusted(*dem, "--dem-heights", "off")
    assert code == 2
    assert "nothing is matched" in document["said"]
    code, document = adjusted("--dem-bias", "3")
    assert code == 2
    assert "--dem" in document["said"]


def test_heights_of_points_and_dem_with_different_datums_are_told(
    stereo: Stereo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control without a stated accuracy gives way to the DEM, so its residuals alone look like poor control."""
    plane = tmp_path / "dem.tif"
    write_dem(plane, np.full((40, 40), 500.0), (LON - 0.05, LAT + 0.05), 0.0025, "EPSG:4326")
    dem = ["--dem", str(plane), "--dem-vertical", "ellipsoid", "--dem-sigma", "500"]
    for off, codes in ((0.4, []), (-33.0, ["heights-disagree"])):

        def above(surface: Any, ground: np.ndarray, crs: Any, off: float = off) -> np.ndarray:
            return off + 0.1 * np.sin(np.arange(len(ground)))

        monkeypatch.setattr("ortho_pipeline.surface.dem.DemSurface.above", above)
        out = tmp_path / str(off)
        run("adjust", *stereo.images, "--points", stereo.write(), *dem, "-o", out)
        document = json.loads((out / "block_report.json").read_text())
        found = [one for one in document["notices"] if one["code"] == "heights-disagree"]
        assert [one["code"] for one in found] == codes
    assert found[0]["median_m"] == pytest.approx(-33.0, abs=0.1)
