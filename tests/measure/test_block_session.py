"""A session of two images: clicks become ties and control of known truth; the live fit is that of `ortho adjust`."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ortho_measure.block.session import BlockSession, open_block_session
from ortho_measure.serving.guard import MAX_BODY
from ortho_measure.serving.tiles import TileServer

from ortho_pipeline.commands.block import adjust
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import BlockOptions, MatchOptions, SurfaceOptions

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
SURFACE = SurfaceOptions(dem=SAMPLE / "dem.tif")
Opens = Callable[..., BlockSession]


@pytest.fixture
def opens(stereo: Any, reference: Path, tmp_path: Path):
    """Open sessions of one output, and close what is left open."""
    opened = []

    def opening(output: str = "p.geojson", with_reference: bool = True, **options: object) -> BlockSession:
        session = open_block_session(
            [SAMPLE / "scene.tif", stereo.path], tmp_path / output, surface=SURFACE, points=BlockOptions(**options),
            match=MatchOptions(reference=(str(reference),) if with_reference else ()),
        )  # fmt: skip
        opened.append(session)
        return session

    yield opening
    for session in opened:
        session.journal.close()


def put(name: str, found: dict[str, Any], role: str, **more: object) -> dict[str, Any]:
    """Return the action that accepts a proposal."""
    rays = {
        label: {"image": ray["image"], "covariance": ray["covariance"], "how": "matched"}
        for label, ray in found["rays"].items()
    }
    ground = {"ground": found["ground"]["ground"], "ground_from": "reference"} if role != "tie" else {}
    return {"do": "put", "mark": {"id": name, "role": role, "rays": rays, **ground, **more}}


def clicked(session: BlockSession, features: np.ndarray, roles: list[str]) -> tuple[list[dict], dict[str, Any]]:
    rng, found, state = np.random.default_rng(3), [], {}
    for number, (feature, role) in enumerate(zip(features, roles, strict=True)):
        found.append(session.proposal(0, (feature + rng.uniform(-3, 3, 2)).tolist(), {}))
        assert not found[-1]["rays"]["second"]["reason"]
        state = session.act(put(f"P{number}", found[-1], role))
    return found, state


def apart(found: dict[str, Any], truth: Any, second: Any) -> np.ndarray:
    """Return how far (px) the second image's place is from where the truth has what the first shows."""
    ground = truth.ground_at(np.array([found["rays"]["scene"]["image"]]))
    return np.array(found["rays"]["second"]["image"]) - second.image_of(ground)[0]


def test_clicks_tie_the_images_and_the_block_is_that_of_the_file(
    opens: Opens, stereo: Any, truth: Any, features: np.ndarray, tmp_path: Path
) -> None:
    """Models that are off by 7 and 6 px in different directions, seen from 18 and 14 degrees on both sides."""
    session = opens()
    found, state = clicked(session, features[:5], ["control", "tie", "control", "control", "check"])
    off = np.array([apart(one, truth, stereo.truth) for one in found])
    # Across 32 degrees the slope of the DEM, which errs, shears chips: more than against a reference from above.
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.1
    assert np.hypot(*off.T).max() < 0.2
    assert state["error"] == ""
    assert state["headline"]["n"] == 3
    assert "Only 1 check point" in state["headline"]["what"]
    assert "relative to the reference" in state["headline"]["what"]
    assert state["version"] >= 1, "the models moved by pixels: the reference is rendered anew"
    fit = session.solution.fit
    assert fit is not None
    # The tie is known on the ground as well as the geometry lets it be: within 3 of the stated sigmas, and what the
    # control's heights, of a DEM that errs by decimetres, are off by.
    known = truth.ground_at(np.array([found[1]["rays"]["scene"]["image"]]))[0]
    metres = np.subtract(fit.ground[1], known) * [111320 * np.cos(np.radians(37.25)), 111320, 1]
    assert (np.abs(metres) < 3 * fit.ground_sigmas[1] + 0.3).all()
    session.save()
    adjust([SAMPLE / "scene.tif", stereo.path], tmp_path / "out", BlockOptions(points=session.output), surface=SURFACE)
    made = json.loads((tmp_path / "out/block_report.json").read_text())["adjustment"]
    for label in ("scene", "second"):
        for name, said in made["images"][label]["parameters"].items():
            live = state["parameters"][label][name]
            assert live["value"] == pytest.approx(said["value"], rel=0, abs=1e-9)
            assert live["sigma"] == pytest.approx(said["sigma"], rel=0, abs=1e-9)
    for k, point in enumerate(made["points"]):
        assert fit.points.ids[k] == point["id"]
        np.testing.assert_allclose(fit.ground[k], point["ground"], rtol=0, atol=1e-9)
    rays = json.loads(session.output.read_text())["features"]
    assert len(rays) == 10
    assert {one["properties"]["measured"] for one in rays} == {"matched"}
    assert all(one["properties"]["at"] for one in rays)
    assert [one["geometry"] is None for one in rays] == [False, False, True, True, *[False] * 6]


def test_a_click_in_the_other_image_and_one_in_the_reference_find_their_places(
    opens: Opens, stereo: Any, truth: Any, features: np.ndarray
) -> None:
    session = opens()
    grounds = truth.ground_at(features)
    there = stereo.truth.image_of(grounds)
    # The place in the first image is known: a click 3 px next to it in the second is mended.
    beside = session.proposal(1, (there[2] + (2.0, -2.0)).tolist(), {"scene": features[2].tolist()})
    assert np.hypot(*np.subtract(beside["rays"]["second"]["image"], there[2])) < 0.1
    # A place in the map, and so its ground.
    on_map = session.predict(0, ground=grounds[3].tolist())["places"]["map-0"]
    ground = session.predict(0, "map-0", on_map)["ground"]
    found = session.of_ground(ground)["rays"]
    # The DEM's height at that place displaces both images by the decimetres that it is off.
    for label, place in (("scene", features[3]), ("second", there[3])):
        assert not found[label]["reason"]
        assert np.hypot(*np.subtract(found[label]["image"], place)) < 0.3
    assert session.of_ground([30.0, 37.0, 900.0])["rays"]["scene"]["image"] is None
    state = session.state()
    assert set(state["next"][0]["places"]) == {"scene-0", "scene-1", "reference-0", "reference-1", "map-0"}


def test_without_a_reference_ties_alone_hold_the_images_together(
    opens: Opens, stereo: Any, truth: Any, features: np.ndarray
) -> None:
    session = opens(with_reference=False)
    found, state = clicked(session, features[2:5], ["tie"] * 3)
    assert found[0]["ground"] is None
    assert state["error"] == ""
    assert "no check points" in state["headline"]["what"]
    assert "reference-0" not in TileServer(session).bands
    places = state["marks"][0]["places"]
    assert np.hypot(*np.subtract(places["scene-1"], found[0]["rays"]["second"]["image"])) < 1.0
    # One ray alone says nothing, stays in the file, and is shown in the other image where it is expected.
    state = session.act(
        {"do": "put", "mark": {"id": "half", "role": "tie", "rays": {"scene": {"image": [500.0, 480.0]}}}}
    )
    assert "half" not in state["points"]
    assert state["marks"][-1]["places"]["scene-1"] is not None
    session.save()
    assert [one["id"] for one in json.loads(session.output.read_text())["left_out"]] == ["half"]


@pytest.mark.slow
def test_three_images_are_measured_judged_and_planned_together(
    stereo: Any, third: Any, truth: Any, features: np.ndarray, tmp_path: Path
) -> None:
    """Ties of three rays by one click each, one of which is then moved; without a reference."""
    session = open_block_session(
        [SAMPLE / "scene.tif", stereo.path, third.path], tmp_path / "p.geojson", surface=SURFACE
    )
    others = {"second": stereo.truth, "third": third.truth}
    for number, feature in enumerate(features[:5]):
        found = session.proposal(0, feature.tolist(), {})["rays"]
        ground = truth.ground_at(feature[None])
        for label, other in others.items():
            assert not found[label]["reason"]
            assert np.hypot(*np.subtract(found[label]["image"], other.image_of(ground)[0])) < 0.2
        state = session.act(put(f"P{number}", {"rays": found, "ground": None}, "tie"))
    assert state["error"] == ""
    assert all(set(one["loo"]) == {"scene", "second", "third"} for one in state["points"].values())
    assert not any(one["suspicious"] for one in state["points"].values())
    # The next place is one that two images show at least, and ties them by what is said.
    best = state["next"][0]
    assert (best["role"], best["number"]) == ("tie", 0)
    assert 0 < best["then"] < best["largest"]
    assert {"scene-0", "scene-1", "scene-2"} <= {name for name, place in best["places"].items() if place}
    rows = session.compared()
    assert [row["model"] for row in rows["rows"]] == ["none", "shift", "shift-drift", "affine"]
    assert rows["recommendation"]["model"] == "shift"
    assert rows["rows"][0]["rays"] > 5 * rows["rows"][1]["rays"], "the models are off by pixels"
    # A ray that is moved by 3 px across is named at once.
    mark = next(one for one in state["marks"] if one["id"] == "P2")
    ray = mark["rays"]["third"]
    wrong = {**ray, "image": [ray["image"][0], ray["image"][1] + 3.0]}
    moved = {key: mark[key] for key in ("id", "role")} | {"rays": {**mark["rays"], "third": wrong}}
    state = session.act({"do": "put", "mark": moved, "was": "P2"})
    assert [name for name, one in state["points"].items() if one["suspicious"]] == ["P2"]
    session.journal.close()


@pytest.mark.slow
def test_the_ortho_of_an_image_has_the_model_of_the_block(
    block_client: Any, stereo: Any, truth: Any, features: np.ndarray
) -> None:
    def ask(what: str, **given: Any) -> Any:
        return block_client.post(f"/folder/api/{what}", json={"window": "window-one", **given}).json()

    grounds = truth.ground_at(features)
    there = stereo.truth.image_of(grounds)
    for k, ground in enumerate(grounds.tolist()):
        rays = {"scene": {"image": features[k].tolist()}, "second": {"image": there[k].tolist()}}
        mark = {"id": f"P{k}", "role": "check" if k == 5 else "control", "rays": rays, "ground": ground,
                "ground_from": "typed", "sigma_xy": 0.1, "sigma_h": 0.1}  # fmt: skip
        state = ask("act", action={"do": "put", "mark": mark})
    told = ask("make", number=1)
    while told["state"] == "running":
        time.sleep(0.1)
        told = ask("made")
    assert told["state"] == "done", told
    assert told["number"] == 1
    assert "whose ground coordinates were not used, in this image, when it was adjusted in a block" in told["what"]
    ortho = next(Path(path) for path in told["files"] if path.endswith("second_ortho.tif"))
    assert ortho.parent.name == "second"
    said = json.loads((ortho.parents[1] / "block/block_report.json").read_text())["adjustment"]["images"]["second"]
    for name, value in said["parameters"].items():
        assert state["parameters"]["second"][name]["value"] == pytest.approx(value["value"], rel=0, abs=1e-9)
    assert block_client.get("/folder/made/ortho").content[:4] == b"\x89PNG"


def test_a_block_is_guarded_as_one_scene_is(block_client: Any) -> None:
    """Host, token, origin, long bodies, paths and images that there are not."""
    url = "/folder/api/tie"
    given = {"window": "window-one", "number": 0, "image": [1.0, 2.0]}
    for headers, status in (({"host": "evil.example"}, 421), ({"origin": "http://evil.example"}, 403)):
        assert block_client.post(url, json=given, headers=headers).status_code == status
    assert block_client.post("/foldes/api/tie", json=given).status_code == 404
    assert block_client.post(url, content=b" " * (MAX_BODY + 1)).status_code == 413
    for path in ("tiles/scene-2/0/1/0/0?l=0,1", "tiles/..%2fscene/0/1/0/0?l=0,1", "tiles/reference-0/0/1/0/0?l=0,1",
                 "made/..%2f..%2fp.geojson", "made/nonsense", "../p.geojson", "scene.tif"):  # fmt: skip
        answer = block_client.get(f"/folder/{path}")
        assert answer.status_code in (400, 404)
        assert str(SAMPLE) not in answer.text
    for wrong in ({"rays": {"../scene": {"image": [1, 2]}}}, {"rays": {"scene": {"image": [1, 2], "path": "/etc"}}}):
        action = {"do": "put", "mark": {"id": "X", "role": "tie", **wrong}}
        answer = block_client.post("/folder/api/act", json={"window": "window-one", "action": action})
        assert answer.status_code == 400
    assert block_client.post("/folder/api/make", json={"window": "another-window"}).status_code == 409


@pytest.mark.parametrize(
    ("what", "given"),
    [("tie", {"number": 2, "image": [1, 2]}), ("tie", {"number": 0, "image": [1]}), ("tie", {}),
     ("tie", {"number": 0, "image": [1, 2], "known": {"third": [1, 2]}}),
     ("tie", {"number": 0, "image": [1, 2], "known": 3}),
     ("propose", {"image": [1, 2]}), ("make", {"number": 2}), ("make", {"number": -1}),
     ("predict", {"at": "scene-2", "place": [1, 2]})],
)  # fmt: skip
def test_what_several_images_have_not_is_refused_in_a_line(block_client: Any, what: str, given: dict[str, Any]) -> None:
    answer = block_client.post(f"/folder/api/{what}", json={"window": "window-one", **given})
    assert answer.status_code == 400
    assert answer.json()["error"]["message"]


@pytest.fixture(scope="module")
def block_client(stereo: Any, tmp_path_factory: pytest.TempPathFactory):
    testclient = pytest.importorskip("starlette.testclient", reason="the extra 'measure' is not installed")
    from ortho_measure.serving.entry import PageEntry
    from ortho_measure.serving.server import application

    output = tmp_path_factory.mktemp("block") / "p.geojson"
    session = open_block_session([SAMPLE / "scene.tif", stereo.path], output, surface=SURFACE)
    entry = PageEntry("folder")
    with testclient.TestClient(application(session, entry, {"127.0.0.1:1"}), base_url="http://127.0.0.1:1") as client:
        client.get(entry.path)
        facts = client.post("/folder/api/begin", json={"window": "window-one"}).json()
        assert facts["labels"] == ["scene", "second"]
        yield client
    session.close()


@pytest.mark.slow
def test_a_block_goes_on_where_it_ended_and_refuses_what_is_not_its_own(
    opens: Opens, features: np.ndarray, tmp_path: Path
) -> None:
    first = opens()
    clicked(first, features[3:5], ["control"] * 2)
    first.act({"do": "correct", "correction": "shift"})
    for wrong in ({"rays": {"third": {"image": [1, 2]}}}, {"image": [1, 2]}, {"rays": {"scene": {"image": [1]}}}):
        with pytest.raises(InputError):
            first.act({"do": "put", "mark": {"id": "X", **wrong}})
    with pytest.raises(InputError, match="no parameters of its own"):
        first.act({"do": "correct", "correction": "model"})
    shown = first.state()
    first.close()
    again = opens()
    moves = {"version": 0, "marks": 0, "next": 0}
    assert {**again.state(), **moves} == {**shown, **moves}
    assert again.marks == first.marks
    again.act({"do": "undo"})
    again.close()
    # A saved file is what another project may begin with.
    other = opens("other.geojson", points=tmp_path / "p.geojson")
    assert list(other.marks.by_id) == ["P0", "P1"]
    assert other.marks.by_id["P1"].rays["second"].image == pytest.approx(again.marks.by_id["P1"].rays["second"].image)
