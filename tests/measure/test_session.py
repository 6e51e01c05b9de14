"""A session on the sample scene: clicks become points of known truth, and the live fit is that of `ortho fit`."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ortho_measure.serving.tiles import TileServer
from ortho_measure.session import Session, open_session

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.options import MatchOptions, PointOptions, SurfaceOptions

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
SURFACE = SurfaceOptions(dem=SAMPLE / "dem.tif")
Opens = Callable[..., Session]


@pytest.fixture
def opens(reference: Path, tmp_path: Path):
    """Open sessions of one output, and close what is left open."""
    opened = []

    def opening(output: str = "p.geojson", **options: object) -> Session:
        session = open_session(
            SAMPLE / "scene.tif", tmp_path / output, surface=SURFACE, points=PointOptions(**options),
            match=MatchOptions(reference=(str(reference),)),
        )  # fmt: skip
        opened.append(session)
        return session

    yield opening
    for session in opened:
        session.journal.close()


def put(name: str, proposal: dict, **more: object) -> dict:
    mark = {key: proposal[key] for key in ("image", "ground", "score", "covariance")}
    return {"do": "put", "mark": {"id": name, "how": "matched", "ground_from": "reference", **mark, **more}}


def test_clicks_land_where_they_belong_and_the_fit_is_that_of_the_file(
    opens: Opens, truth, features: np.ndarray
) -> None:
    """Clicks up to 4 px beside features, the first against a model that is off by 7.5 px."""
    session, rng = opens(), np.random.default_rng(5)
    grounds = truth.ground_at(features)
    missed, claimed = [], []
    for number, feature in enumerate(features):
        angle = rng.uniform(0, 2 * np.pi)
        click = feature + rng.uniform(0, 4) * np.array([np.cos(angle), np.sin(angle)])
        found = session.proposal(click.tolist())
        assert not found["reason"]
        missed.append(np.array(found["image"]) - truth.image_of([found["ground"]])[0])
        claimed.append([found["covariance"][0], found["covariance"][1]])
        # And the other way round: the ground is known, its image is wanted.
        known = session.proposal(click.tolist(), grounds[number].tolist())
        assert not known["reason"]
        if number == 0:
            # Before any point the model is off by more than a click is: it is searched as far as it may be.
            alone = session.proposal(None, grounds[number].tolist())
            assert not alone["reason"]
            missed.append(np.array(alone["image"]) - feature)
            claimed.append([alone["covariance"][0], alone["covariance"][1]])
        missed.append(np.array(known["image"]) - feature)
        claimed.append([known["covariance"][0], known["covariance"][1]])
        state = session.act(put(f"P{number}", found, role="check" if number == 2 else "control"))
    assert np.hypot(*np.array(missed).T).max() < 0.1
    # What is claimed is of the size of what was missed: 26 numbers, whose root mean square is known to 15 %.
    spread = np.sqrt(np.mean(np.array(missed) ** 2 / np.array(claimed)))
    assert 0.4 < spread < 2.5
    assert state["headline"]["n"] == len(features) - 1
    assert "relative to the reference" in state["headline"]["what"]
    assert "1 check point (" in state["headline"]["what"]
    assert state["version"] >= 1, "the model moved by 7 px: the reference is rendered anew"
    session.save()
    fit = commands.fit(SAMPLE / "scene.tif", PointOptions(gcps=session.output), surface=SURFACE).fit
    live = session.solution.fit
    assert live is not None
    for name in ("values", "covariance", "residuals", "loo_residuals"):
        np.testing.assert_allclose(getattr(live, name), getattr(fit, name), rtol=0, atol=1e-9)
    assert live.rejected == fit.rejected
    assert any(one.code == "relative-to-reference" for one in fit.warnings)


def test_the_next_point_gains_what_was_promised(opens: Opens) -> None:
    session = opens(gcps=SAMPLE / "gcps.geojson", correction="affine")
    before = session.state()["next"][0]
    assert before["largest"] >= before["then"] > 0
    fit = session.solution.fit
    assert fit is not None
    place = session.predict(0, "scene-0", before["image"])
    sigma = float(np.median(fit.points.sigma_image[fit.used]))
    mark = {"id": "new", "image": place["places"]["scene-0"], "ground": place["ground"], "sigma_image": sigma}
    after = session.act({"do": "put", "mark": mark})["next"][0]
    # The new point has no residual, so that sigma0 falls by what one more point of 13 makes it fall.
    assert after["largest"] == pytest.approx(before["then"], rel=0.15)
    assert np.hypot(*np.subtract(after["image"], before["image"])) > 100


def test_no_place_is_offered_twice(opens: Opens) -> None:
    """Where the model is least certain there may be a point already: at a corner, for a drift."""
    session = opens(correction="shift-drift")
    state, places = session.state(), []
    for number in range(8):
        places.append(state["next"][0]["image"])
        ground = session.predict(state["version"], "scene-0", places[-1])["ground"]
        state = session.act({"do": "put", "mark": {"id": f"P{number}", "image": places[-1], "ground": ground}})
    apart = [np.abs(np.subtract(one, other)).max() for k, one in enumerate(places) for other in places[:k]]
    assert min(apart) >= 20


def test_a_blunder_is_named_at_once_and_switched_off(opens: Opens) -> None:
    session = opens(gcps=SAMPLE / "gcps.geojson")
    mark = next(one for one in session.state()["marks"] if one["role"] == "control")
    plain = {key: value for key, value in mark.items() if key != "places"}
    moved = {**plain, "image": [mark["image"][0] + 8, mark["image"][1]]}
    state = session.act({"do": "put", "mark": moved, "was": mark["id"]})
    assert state["points"][mark["id"]]["suspicious"]
    assert "gross error" in state["points"][mark["id"]]["reason"]
    assert any(mark["id"] in text for text in state["notices"])
    state = session.act({"do": "put", "mark": {**moved, "off": True}, "was": mark["id"]})
    assert mark["id"] not in state["points"]
    session.act({"do": "undo"})
    assert session.act({"do": "undo"})["points"][mark["id"]]["suspicious"] is False


def test_reopening_goes_on_where_it_ended(opens: Opens, tmp_path: Path) -> None:
    first = opens(gcps=SAMPLE / "gcps.geojson")
    first.act({"do": "remove", "id": first.state()["marks"][0]["id"]})
    first.act({"do": "correct", "correction": "shift-drift"})
    shown = first.state()
    first.journal.close()  # as a kill leaves it: nothing was saved
    again = opens(gcps=SAMPLE / "gcps.geojson")
    # The renderings in between are not made again; what is measured and what follows from it is the same to the bit.
    moves = {"version": 0, "marks": 0}
    assert {**again.state(), **moves} == {**shown, **moves}
    assert again.marks == first.marks
    second = opens()
    assert second.journal.read_only
    assert second.marks == first.marks
    with pytest.raises(InputError, match="another ortho measure process"):
        second.act({"do": "undo"})
    # It follows what the one that writes does, and not the half of a line.
    again.act({"do": "remove", "id": again.state()["marks"][0]["id"]})
    assert second.state()["marks"] == again.state()["marks"]
    assert second.marks == again.marks
    again.act({"do": "undo"})
    with again.journal.path.open("ab") as torn:
        torn.write(b'{"crc":"')
    assert second.state()["points"] == again.state()["points"]
    assert second.marks == again.marks
    again.close()
    assert len(json.loads((tmp_path / "p.geojson").read_text())["features"]) == 17
    with pytest.raises(InputError, match="started with other points"):
        opens(gcps=SAMPLE / "gcps.csv")
    (tmp_path / "old.geojson").write_text("{}")
    with pytest.raises(InputError, match="was not made by ortho measure"):
        opens("old.geojson")


def test_points_that_another_program_changed_are_not_overwritten(opens: Opens, tmp_path: Path) -> None:
    opens(gcps=SAMPLE / "gcps.geojson").close()
    path, journal = tmp_path / "p.geojson", tmp_path / "p.geojson.journal"

    def written(document: dict[str, object], age: int) -> str:
        path.write_text(json.dumps(document))
        moment = journal.stat().st_mtime_ns - age * 10**9
        os.utime(path, ns=(moment, moment))
        return path.read_text()

    document = json.loads(path.read_text())
    written({**document, "name": "as QGIS saves it"}, -9)
    opens().close()
    fewer = {**document, "features": document["features"][1:]}
    changed = written(fewer, -9)
    with pytest.raises(InputError, match="another program changed these points"):
        opens()
    assert path.read_text() == changed
    assert len(opens("other.geojson", gcps=path).marks.by_id) == len(fewer["features"])
    # A kill leaves an older file: the journal has what it lacks.
    written(fewer, 9)
    opens().close()
    assert json.loads(path.read_text())["features"] == document["features"]


def test_points_that_were_deleted_after_they_were_saved_are_saved_again(opens: Opens, tmp_path: Path) -> None:
    session = opens(gcps=SAMPLE / "gcps.geojson")
    session.save()
    before = session.output.read_bytes()
    session.output.unlink()
    session.save()
    assert session.output.read_bytes() == before


def test_typed_ground_is_understood(opens: Opens, monkeypatch: pytest.MonkeyPatch) -> None:
    session = opens()
    lon, lat, height = 33.35, 37.25, 800.0
    assert session.typed([lon, lat, height], "", None) == pytest.approx([lon, lat, height])
    above = session.typed([lon, lat, height], "EPSG:4326", "egm96")
    # sample_data/README.md: the geoid lies 33.6 m above the ellipsoid there.
    assert above[2] == pytest.approx(height + 33.6, abs=0.5)
    with monkeypatch.context() as patched:
        patched.setattr(Vertical, "undulation", lambda self, lon, lat: np.full(np.shape(lon), 30.0))
        in_feet = session.typed([lon, lat, 1000.0], "EPSG:4326", "EPSG:8228")
    assert in_feet == pytest.approx([lon, lat, 304.8 + 30.0])
    # The heights of a compound CRS are in its datum: not above the ellipsoid, which the page sends by default.
    for stated in ("ellipsoid", None):
        with pytest.raises(InputError, match="the CRS has heights in EGM96") as refused:
            session.typed([lon, lat, height], "EPSG:4326+5773", stated)
        assert refused.value.remedy == "give the height datum EPSG:5773"
    assert session.typed([lon, lat, height], "EPSG:4326+5773", "EPSG:5773") == pytest.approx(above)
    from_dem = session.typed([531000.0, 4122700.0, None], "EPSG:32636", None)
    assert from_dem[:2] == pytest.approx([33.35, 37.25], abs=0.01)
    assert 690 < from_dem[2] < 1100
    with pytest.raises(InputError):
        session.typed([lon, None, height], "", None)


def test_tiles_show_the_pixels_that_are_there(opens: Opens, truth, features: np.ndarray) -> None:
    session = opens()
    tiles = TileServer(session)
    from ortho_pipeline.raster.source import RasterSource

    pixels = RasterSource(SAMPLE / "scene.tif").read(0, 0, 1000, 1000)[0].astype(float)
    np.testing.assert_array_equal(tiles.pixels("scene-0", 0, 1, 256, 512, 0), pixels[512:768, 256:512])
    np.testing.assert_allclose(
        tiles.pixels("scene-0", 0, 2, 0, 0, 0), pixels[:512, :512].reshape(256, 2, 256, 2).mean(axis=(1, 3)), rtol=1e-6
    )
    coarse = tiles.pixels("scene-0", 0, 32, 0, 0, 0)
    assert np.isfinite(coarse).sum() == 31 * 31
    low, high = tiles.limits("scene-0", 0, None, 0)
    assert np.percentile(pixels, 0.2) < low < high < np.percentile(pixels, 99.8)
    # By the true shift the rendered reference is the scene; by the delivered model it is not.
    bias = np.array([6.3, -4.1])
    left, top = (features[2] - 60).astype(int)
    scene = pixels[top : top + 120, left : left + 120]
    session.rendered.append(session.places.moved(bias).model)
    alike = [
        np.corrcoef(tiles.pixels("reference-0", version, 1, left, top, 0)[:120, :120].ravel(), scene.ravel())[0, 1]
        for version in (0, 1)
    ]
    assert alike[1] > 0.97
    assert alike[0] < 0.9
    assert tiles.png("reference-0", 1, 1, 1, 1, [0], [(0, 250)])[:4] == b"\x89PNG"
    for wrong in (
        ("other", 0, 1, 0, 0, 0),
        ("scene-1", 0, 1, 0, 0, 0),
        ("scene-0", 0, 3, 0, 0, 0),
        ("scene-0", 0, 1, 0, 0, 2),
        ("reference-0", 9, 1, 0, 0, 0),
    ):
        with pytest.raises(InputError):
            tiles.pixels(*wrong)


def test_the_reference_as_a_map_has_its_own_pixels_and_the_places_of_the_truth(
    opens: Opens, reference: Path, truth, features: np.ndarray
) -> None:
    """A place of the map is where its ground truly is in the scene, once the model is adjusted; and links agree."""
    session = opens(gcps=SAMPLE / "gcps.geojson")
    from ortho_pipeline.raster.source import RasterSource

    tiles = TileServer(session)
    pixels = RasterSource(reference).read(512, 256, 256, 256)[0]
    shown = tiles.pixels("map-0", 0, 1, 512, 256, 0)
    np.testing.assert_array_equal(np.nan_to_num(shown), pixels)
    grounds = truth.ground_at(features)
    on_map = [session.predict(0, ground=ground.tolist())["places"]["map-0"] for ground in grounds]
    # The corner of the map and its pixel are those that the reference was written with.
    xy = truth.terrain.xy(*grounds[:, :2].T)
    left, top = truth.terrain.x0 - 1700.0, truth.terrain.y0 + 1700.0
    np.testing.assert_allclose(on_map, (xy - (left, top)) / (2.5, -2.5), atol=1e-4)
    for ground, feature, place in zip(grounds, features, on_map, strict=True):
        back = session.predict(0, "map-0", place)
        # The DEM of the sample errs by some decimetres, which is less than a tenth of a pixel at 18 degrees.
        assert np.hypot(*np.subtract(back["places"]["scene-0"], feature)) < 0.5
        assert back["ground"][:2] == pytest.approx(ground[:2].tolist(), abs=1e-9)
        link = session.link(0, "map-0", place, "scene-0")
        step = np.array([5.0, -3.0])
        there = session.predict(0, "map-0", (np.array(place) + step).tolist())["places"]["scene-0"]
        np.testing.assert_allclose(link["place"] + np.array(link["matrix"]) @ step, there, atol=0.1)
        again = session.link(0, "scene-0", link["place"], "map-0")
        np.testing.assert_allclose(np.array(again["matrix"]) @ link["matrix"], np.eye(2), atol=0.05)
    assert session.predict(0, "map-0", [-50.0, 20.0])["places"]["map-0"] is None
    assert session.link(0, "scene-0", [-9e5, 0.0], "map-0") == {"place": None, "matrix": None}
    ahead = session.state()["next"][0]
    assert session.predict(0, "map-0", ahead["places"]["map-0"])["places"]["scene-0"] == pytest.approx(
        ahead["image"], abs=0.05
    )
