"""OrbView-3: labels whole and damaged, the choice of the RPC, deliveries from end to end, the RPC in GDAL."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import ortho_orbview3
import pytest
from click.testing import CliRunner
from ortho_orbview3.label import read_label
from ortho_orbview3.product import read_product
from ortho_studies.orbview3.simulation import write_product
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.spatial.correlation import in_metres
from ortho_pipeline.exchange.rpc import export_rpc, rpc_metadata
from ortho_pipeline.host import open_scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.options import PointOptions
from ortho_pipeline.points import read_points
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.testing import check_sensor

STEMS = {
    "471890": "3v050620p0000471890a5200000000100m_001471890",
    "443940": "3v050620p0000443940a5200000000200m_001443940",
}


@pytest.fixture
def delivery(sample) -> Path:
    return sample / "orbview3"


@pytest.fixture
def copied(delivery, tmp_path) -> Path:
    """The first scene in a folder of its own; returns the image."""
    for end in (".tif", ".pvl", "_rpc.txt"):
        shutil.copy(delivery / f"{STEMS['471890']}{end}", tmp_path)
    return tmp_path / f"{STEMS['471890']}.tif"


def sensor():
    return next(iter(ortho_orbview3.ortho_sensors()))


def run(*arguments: object) -> str:
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


def edit(image: Path, *changes: tuple[str, str], end: str = ".pvl") -> Path:
    path = image.with_name(image.stem + end)
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text)
    return path


# -- the delivery ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", STEMS)
def test_a_delivery_keeps_the_contract(delivery, scene):
    opened = check_sensor(sensor(), delivery / f"{STEMS[scene]}.tif")
    assert opened.model_source.endswith("_rpc.txt")
    assert list(opened.models) == ["rpc"]
    assert opened.facts["kind"] == "panchromatic"
    assert opened.facts["families"] == ["affine14", "affine12", "affine3d", "dlt"]
    assert opened.accuracy == pytest.approx(33 / 2.146, abs=0.02)
    assert "cloud_cover_percent" not in opened.facts
    assert not opened.warnings
    assert np.abs(read_product(opened.facts["label"]).corner_misses).max() < 0.01


def test_both_scenes_see_the_same_points_and_their_truth(delivery):
    truth = json.loads((delivery / "truth.json").read_text())
    ground = np.array([point["lon_lat_h"] for point in truth["points"]])
    for name, stem in STEMS.items():
        opened = open_scene(delivery / f"{stem}.tif")
        points = read_points(delivery / f"{stem}_gcps.csv")
        assert len(points) == 34
        assert (points.image > 0).all()
        assert (points.image < (opened.width, opened.height)).all()
        image = np.array(truth["scenes"][name]["images"])
        # The vendor's RPC is some 14 m off; corrected, it is where the truth is to about 2 m.
        missed = np.abs(opened.model.ground_to_image(ground) - image).mean(axis=0)
        assert 0.2 < np.hypot(*missed) < 3
        affine = fit(ImageCorrection.identity(opened.model, "affine", (167, 416)), points)
        assert np.sqrt(((affine.model.ground_to_image(ground) - image) ** 2).mean()) < 2.5 / 24
        assert 0.7 < np.hypot(*np.sqrt((in_metres(affine, affine.residuals) ** 2).mean(axis=0))) < 4


@pytest.mark.slow
def test_sample_is_made_again_the_same(delivery, tmp_path):
    files = write_product(tmp_path, seed=1, pixel=24, dem_step=150.0)
    for path in files.values():
        kept = delivery / path.name
        if path.suffix == ".tif":
            np.testing.assert_array_equal(open_dataset(path).ReadAsArray(), open_dataset(kept).ReadAsArray())
        elif path.suffix == ".csv":
            assert path.read_text() == kept.read_text()
    assert sum(path.stat().st_size for path in delivery.iterdir()) < 1_500_000


def test_simulate_writes_a_scene_that_rectify_takes(tmp_path):
    said = json.loads(run("simulate", "orbview3", "-o", tmp_path / "s", "--seed", 3, "--pixel", 40, "--json"))
    files = {name: Path(path) for name, path in said["files"].items()}
    report = json.loads(
        run("rectify", files["image_443940"], "--gcps", files["gcps_443940"], "--dem", files["dem"], "-o",
            tmp_path / "o", "--json")
    )["report"]  # fmt: skip
    assert report["scene"]["sensor"] == "orbview3"
    assert report["adjustment"]["model"] == "rpc+shift"
    assert not any("not projected to a plane" in warning for warning in report["warnings"])
    done = CliRunner().invoke(cli, ["simulate", "orbview3", "-o", str(tmp_path), "--pixel", "0", "--json"])
    assert json.loads(done.stdout)["error"]["field"] == "--pixel, --seed"


def test_fit_without_the_unjustified_parameters(delivery):
    stem = delivery / STEMS["471890"]
    asked = ("fit", f"{stem}.tif", "--gcps", f"{stem}_gcps.csv", "--correction", "affine", "--json")
    full, less = json.loads(run(*asked)), json.loads(run(*asked, "--prune"))
    assert full["model"] == "rpc+affine"
    assert set(full["parameters"]) - set(less["parameters"]) == {"col_per_col"}
    totals = [found["rmse"]["control"]["total"] for found in (full, less)]
    assert totals[0] <= totals[1] < 1.02 * totals[0]


def test_a_small_family_is_far_off_on_an_original_scene(delivery):
    stem = delivery / STEMS["443940"]
    totals = {}
    for family in ("affine14", "affine12", "affine3d", "dlt"):
        options = PointOptions(f"{stem}_gcps.csv", fit_model=family)
        found = commands.fit(f"{stem}.tif", options)
        totals[family] = found.fit.rmse("control").total * 24
        said = [text for text in found.warnings if "not projected to a plane" in text]
        assert said == [text for name, text in ortho_orbview3.UNSUITED.items() if name == family]
    # Also when the search for gross errors has taken the worst points out.
    assert totals["affine14"] < totals["dlt"] < totals["affine12"] < totals["affine3d"]
    assert totals["affine14"] < 5 < totals["affine12"]


def test_points_that_a_family_cannot_follow_are_not_hidden(delivery, tmp_path):
    # There is no gross error among them: the figure is of those that a wrong model happens to fit.
    stem = delivery / STEMS["471890"]
    said = run("rectify", f"{stem}.tif", "--gcps", f"{stem}_gcps.csv", "--height", 200, "--fit-model", "affine3d",
               "-tr", 200, "-o", tmp_path)  # fmt: skip
    assert "6 control points left out." in said
    # No model was delivered that could be off.
    assert "raw bias" not in said
    assert "Error of the delivered model" not in next(tmp_path.glob("*.html")).read_text()
    assert "raw bias" in run("rectify", f"{stem}.tif", "--gcps", f"{stem}_gcps.csv", "--height", 200, "-tr", 200,
                             "-o", tmp_path)  # fmt: skip


def test_only_what_fits_an_unsuited_family_is_warned(delivery):
    stem = delivery / STEMS["443940"]
    assert not commands.info(f"{stem}.tif")["warnings"]
    compared = commands.compare(f"{stem}.tif", PointOptions(f"{stem}_gcps.csv"), models="rpc+affine,affine14,affine3d")
    rows = {row["model"]: row["warnings"] for row in compared.to_json()["rows"]}
    assert ortho_orbview3.UNSUITED["affine3d"] in rows.pop("affine3d")
    assert "not projected to a plane" not in str(rows)
    best = commands.fit(f"{stem}.tif", PointOptions(f"{stem}_gcps.csv", correction="affine"))
    assert "not projected to a plane" not in str(best.warnings)


# -- recognition and the choice of the RPC ---------------------------------------------------------------------------


def test_recognition_looks_at_the_label(copied):
    assert sensor().recognises(open_dataset(copied)) is True
    label = copied.with_suffix(".pvl")
    # Cut off before the satellite's name, it should be opened and say so.
    label.write_text(label.read_text()[:700])
    assert sensor().recognises(open_dataset(copied)) is True
    with pytest.raises(InputError, match="cut off"):
        open_scene(copied)
    other = copied.with_name("other.tif")
    copied.rename(other)
    label.rename(other.with_suffix(".pvl"))
    other.with_suffix(".pvl").write_text("Object = IsisCube\nEnd_Object\nEnd\n")
    assert sensor().recognises(open_dataset(other)) is False


def test_capitals_and_multispectral_names(copied):
    image = copied.with_name("3V050905M0000880351A520001100172M_001659557.TIF")
    dataset = gdal.GetDriverByName("MEM").Create("", 334, 833, 4, gdal.GDT_UInt16)
    gdal.GetDriverByName("GTiff").CreateCopy(str(image), dataset, options=["COMPRESS=DEFLATE"]).FlushCache()
    for end in (".pvl", "_rpc.txt"):
        copied.with_name(copied.stem + end).rename(image.with_name((image.stem + end).upper()))
    opened = check_sensor(sensor(), image)
    assert opened.facts["kind"] == "multispectral"
    assert opened.facts["bands"] == ["blue", "green", "red", "nir"]
    assert opened.model_source.endswith("_RPC.TXT")


def test_slow_down_where_it_can_be_derived(copied):
    # Pixels of the sample are too large for it; those of the paper give its number.
    assert "slow_down_factor_at_full_line_rate" not in open_scene(copied).facts
    assert ortho_orbview3.slow_down(1.0, "panchromatic") == pytest.approx(1.42)
    assert ortho_orbview3.slow_down(4.0, "multispectral") == pytest.approx(1.42)


def test_an_rpc_without_its_text_is_that_of_the_label(copied):
    copied.with_name(f"{copied.stem}_rpc.txt").unlink()
    opened = open_scene(copied)
    assert opened.model_source.endswith(".pvl")
    assert "no RPC text" in opened.warnings[0]
    with pytest.raises(InputError, match="no RPC text") as caught:
        open_scene(copied, options={"rpc": "text"})
    assert caught.value.field == "rpc"


def test_a_tag_that_contradicts_the_text_is_an_error(copied):
    dataset = gdal.OpenEx(str(copied), gdal.OF_UPDATE, sibling_files=[copied.name])
    dataset.SetMetadata(rpc_metadata(read_product(copied.with_suffix(".pvl")).rpc.shifted(0.0, 9.0)), "RPC")
    dataset = None
    with pytest.raises(InputError, match=r"differ by 9\.0 px"):
        open_scene(copied)
    lines = [open_scene(copied, options={"rpc": choice}).model.row_off for choice in ("tag", "sidecar")]
    assert lines[1] - lines[0] == pytest.approx(9.0)


@pytest.mark.parametrize(("moved", "outcome"), [(0.0005, None), (0.02, "differ by 0.02 px"), (3.0, InputError)])
def test_label_and_text_are_compared(copied, moved, outcome):
    text = copied.with_name(f"{copied.stem}_rpc.txt")
    line = next(line for line in text.read_text().splitlines() if line.startswith("SAMP_OFF"))
    value = float(line.split()[1])
    edit(copied, (line, f"SAMP_OFF: {value + moved!r} pixels"), end="_rpc.txt")
    if outcome is InputError:
        with pytest.raises(InputError, match="differ by 3 px") as caught:
            open_scene(copied)
        assert "`scene.rpc=label`" in caught.value.remedy
        by_label, by_text, by_file = (
            open_scene(copied, options={"rpc": choice}).model.col_off for choice in ("label", "text", str(text))
        )
        assert by_text - by_label == pytest.approx(3.0)
        assert by_file == by_text
        return
    warnings = [warning for warning in open_scene(copied).warnings if "differ" in warning]
    assert bool(warnings) == (outcome is not None)
    assert not outcome or outcome in warnings[0]


def test_another_size_is_refused_and_another_label_can_be_given(copied):
    small = copied.with_name("small.tif")
    gdal.GetDriverByName("GTiff").Create(str(small), 20, 30, 1, gdal.GDT_UInt16).FlushCache()
    label = str(copied.with_suffix(".pvl"))
    with pytest.raises(InputError, match="334 x 833") as caught:
        open_scene(small, "orbview3", {"label": label})
    assert "numScanLines" in caught.value.field
    whole = copied.with_name("whole.tif")
    copied.rename(whole)
    assert open_scene(whole, "orbview3", {"label": label}).model_source == label
    with pytest.raises(InputError, match=r"no label \(\.pvl\) found next to"):
        open_scene(whole, "orbview3")


def test_corners_that_do_not_fit_the_rpc_are_reported(copied):
    product = read_product(copied.with_suffix(".pvl"))
    lat = f"{product.corners[0, 1]:.10f}"
    edit(copied, (lat, f"{product.corners[0, 1] + 0.01:.10f}"))
    assert any("contradicts itself" in warning for warning in open_scene(copied).warnings)


# -- labels ----------------------------------------------------------------------------------------------------------


def test_what_vendors_vary_is_tolerated(tmp_path):
    path = tmp_path / "a.pvl"
    path.write_bytes(
        b'\xef\xbb\xbf/* comment\n of two lines */ GROUP = outer\r\n name = "a; b = (c)"\r\n # another\r\n'
        b"list = { 1, 2.5 ,3 };; length = 12.5 <metres>\nBegin_Group = inner; x = 1D3; END_GROUP;\n"
        b"end_group = outer\nEND\n"
        b"garbage = = ("
    )
    outer = read_label(path).group("outer")
    assert outer.text("name") == "a; b = (c)"
    assert outer.numbers("list", 3) == (1.0, 2.5, 3.0)
    assert outer.number("length") == 12.5
    assert outer.group("inner").whole("x") == 1000
    path.write_bytes('a = "\u00fc";\nEND;'.encode("latin-1"))
    assert read_label(path).text("a") == "\u00fc"


RATIONAL = "productInfo.rationalFunctions"
DAMAGES = {
    "other END_GROUP": ("BEGIN_GROUP = sensorInfo;", "BEGIN_GROUP = sensor;", "sensor", "not with its own name"),
    "group gone": ("sensorInfo", "sensor", "sensorInfo", "missing"),
    "no END_GROUP": ("  END_GROUP = rationalFunctions;\n", "", RATIONAL, "not with its own name"),
    "key twice": ("lineScale =", "lineOffset =", f"{RATIONAL}.lineOffset", "twice"),
    "group twice": ("upperRightCorner", "upperLeftCorner", "productInfo.geodeticCorners.upperLeftCorner", "twice"),
    "no key": ("heightScale =", "heightSize =", f"{RATIONAL}.heightScale", "missing"),
    "no number": ("heightScale = 500.0", "heightScale = high", f"{RATIONAL}.heightScale", "'high' is not a number"),
    "decimal comma": ("heightScale = 500.0", "heightScale = 500,0", f"{RATIONAL}.heightScale", "is not a key"),
    "infinite": ("heightScale = 500.0", "heightScale = 1e400", f"{RATIONAL}.heightScale", "too large"),
    "not a number": ("heightScale = 500.0", "heightScale = nan", f"{RATIONAL}.heightScale", "not a number"),
    "zero scale": ("heightScale = 500.0", "heightScale = 0", f"{RATIONAL}.heightScale", "zero"),
    "list": ("heightScale = 500.0", "heightScale = (1, 2)", f"{RATIONAL}.heightScale", "not a list"),
    "no list": ("(\n", "7; x = (\n", f"{RATIONAL}.lineNumeratorCoefficients", "not one value"),
    "open list": (");", ";", f"{RATIONAL}.lineNumeratorCoefficients", "';' is not a list value"),
    "short list": ("(\n", "(\n 0,", f"{RATIONAL}.lineNumeratorCoefficients", "a list of 21"),
    "fraction": ("numScanLines = 833", "numScanLines = 833.5", "productInfo.numScanLines", "not a number of pixels"),
    "spacing": ("lineSpacing = ", "lineSpacing = -", "productInfo.lineSpacing", "not a possible spacing"),
    "no Earth": ("latitude = 41", "latitude = 141", "productInfo.geodeticCorners.upperLeftCorner", "not on Earth"),
    "time": ("2005-06-20", "2005-13-20", "inputImageInfo.firstLineAcquisitionDateTime", "not a time"),
    "no value": ("sensorName = ", "sensorName ; = ", "sensorInfo.sensorName", "'=' is missing"),
    "empty value": ('sensorName = "PAN"', "sensorName = ", "sensorInfo.sensorName", "value of this key is missing"),
    "quote": ('sensorName = "PAN', "sensorName = PAN", "sensorInfo.sensorName", "is not a key"),
    "END within": ("  satelliteName", "  END; satelliteName", "sensorInfo", "no END_GROUP before END"),
    "outside": ("END;\n", "END_GROUP;\n", "line 15", "END_GROUP without a group"),
    "no name": ("BEGIN_GROUP = sensorInfo", 'BEGIN_GROUP = ""', "", "has no name"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_labels_name_group_and_key(copied, damage):
    old, new, field, words = DAMAGES[damage]
    path = copied.with_suffix(".pvl")
    text = path.read_text()
    assert old in text
    everywhere = damage in ("group gone", "group twice")
    path.write_text(text.replace(old, new) if everywhere else text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        open_scene(copied)
    assert words in str(caught.value)
    assert field in (caught.value.field or "")
    assert caught.value.file == str(path)


def test_files_that_are_no_labels(tmp_path):
    path = tmp_path / "a.pvl"
    for content, words in (
        (b"", "cut off"), (b"END;", "empty"), (b"a = 1\0;END;", "plain"), ("a = 1; END;".encode("utf-16"), "plain"),
        (b"a = 1;\n" * 200_000, "bytes"), (b"GROUP = a;" * 50, "too deeply"), (b"a = 1; = 2; END;", "is not a key"),
        (b"a = ", "cut off before"), (b"a = (1, 2", "cut off in this list"), (b"a = 1; GROUP = g; b = 2;", "after b"),
    ):  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(InputError, match=words):
            read_label(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_label(tmp_path / "none.pvl")


def test_hostile_labels_are_answered_at_once(tmp_path, calls):
    path = tmp_path / "a.pvl"
    for content in ("".join(f"/*{k}=1;" for k in range(8_000)), "a = (" + "1," * 30_000, '"' * 69_999, "<" * 69_999):
        path.write_text(content)
        with pytest.raises(InputError), calls:
            read_label(path)
        # Each letter is looked at a few times, none for every other one.
        assert calls.count < 20 * len(content)


def test_unknown_numbers_are_none(copied):
    edit(copied, ("circularError = 32.98", "circularError = 999; x = 32.98"), ("acquisitionOrbitNumber", "other"))
    opened = open_scene(copied)
    assert not {"circular_error_m", "orbit", "cloud_cover_percent"} & set(opened.facts)
    assert opened.accuracy is None
    edit(copied, ("productCloudCoverPercentage = 999", "productCloudCoverPercentage = 12"))
    assert open_scene(copied).facts["cloud_cover_percent"] == 12


def test_a_denominator_with_a_zero_in_the_scene_is_refused(copied):
    path = copied.with_suffix(".pvl")
    lines = path.read_text().splitlines()
    start = next(k for k, line in enumerate(lines) if "pixelDenominatorCoefficients" in line)
    lines[start + 2], lines[start + 3] = "      1.0,", "      -1.0,"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match="denominator of this RPC is zero within its box") as caught:
        read_product(path)
    assert caught.value.field == f"{RATIONAL}.pixelDenominatorCoefficients"


# -- the adjusted RPC in GDAL ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("correction", ["shift", "affine"])
def test_the_adjusted_rpc_in_gdal(delivery, correction):
    stem = delivery / STEMS["471890"]
    opened = open_scene(f"{stem}.tif")
    start = ImageCorrection.identity(opened.model, correction, (opened.width / 2, opened.height / 2))
    model = fit(start, read_points(f"{stem}_gcps.csv")).model
    exported = export_rpc(model)
    dataset = gdal.GetDriverByName("MEM").Create("", opened.width, opened.height, 1, gdal.GDT_Byte)
    dataset.SetMetadata(rpc_metadata(exported.rpc), "RPC")
    centre, half = model.domain
    steps = np.linspace(-0.7, 0.7, 7)
    signs = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    ground = centre + signs * half
    transformer = gdal.Transformer(dataset, None, ["METHOD=RPC"])
    there, good = transformer.TransformPoints(1, ground.tolist())
    assert all(good)
    miss = np.abs(np.array(there)[:, :2] - model.ground_to_image(ground)).max()
    if correction == "shift":
        assert exported.exact
        assert miss < 1e-6
    else:
        # Denominators differ, so the cross terms are fitted; on these points the error is what was stated.
        assert not exported.exact
        assert 0 < exported.max_error_px < 1e-4
        assert miss <= 2 * exported.max_error_px
