"""The page in Chromium: a person clicks, presses keys, and looks."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from ortho_measure.serving.entry import leading_to

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytest.importorskip("uvicorn", reason="the extra 'measure' is not installed")

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine")
_FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-background-networking"]
#: Milliseconds that anything may take: on a new machine the first click waits for kernels to be compiled.
_SLOW_MACHINE = 180_000


class Served:
    """`ortho measure` as a process of its own, and a browser page on it."""

    def __init__(self, page, folder: Path, reference: Path, *images: Path) -> None:
        self.output = folder / "p.geojson"
        code = "from ortho_pipeline.cli.program import main; main()"
        self.process = subprocess.Popen(
            [sys.executable, "-c", code, "measure", str(SAMPLE / "scene.tif"), *map(str, images),
             "--reference", str(reference), "--dem",
             str(SAMPLE / "dem.tif"), "-o", str(self.output), "--no-browser"],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().split()[-1]
        self.page, self.hosts, self.faults = page, set(), []
        page.set_default_timeout(_SLOW_MACHINE)
        page.on(
            "request", lambda request: self.hosts.add(request.url.split("/")[2]) if "file:" not in request.url else None
        )
        page.on("console", lambda told: self.faults.append(told.text) if told.type == "error" else None)
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        # As the command opens it: by a file, from where a strict cookie is not sent.
        leading = folder / "open.html"
        leading.write_text(leading_to(self.address))
        page.goto(leading.as_uri())
        self.says("#what", "no points yet|no redundancy")

    def says(self, where: str, text: str) -> None:
        playwright.expect(self.page.locator(where)).to_have_text(re.compile(text), timeout=_SLOW_MACHINE)

    def click(self, pane: str, place: np.ndarray) -> None:
        """Click a pixel of the scene as the page shows it at first: the whole of it."""
        box = self.page.locator(f"#{pane}").bounding_box()
        assert box is not None
        middle = np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])
        self.page.mouse.click(*(middle + (place - 500) * min(box["width"], box["height"]) / 1000).tolist())

    def accept(self, name: str) -> None:
        self.says("#said", f"Matched|{name}")
        self.page.keyboard.press("Enter")
        self.says("#said", f"{name} accepted")

    def end(self) -> list[dict]:
        """End the server as Ctrl-C does, and return the points that it wrote."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(30) == 0
        return json.loads(self.output.read_text())["features"]


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=_FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def serve(browser, tmp_path: Path):
    running = []

    def serving(reference: Path, *images: Path, **context: object) -> Served:
        own = browser.new_context(**{"viewport": {"width": 1400, "height": 860}, **context})
        running.append(Served(own.new_page(), tmp_path, reference, *images))
        return running[-1]

    yield serving
    for served in running:
        served.page.context.close()
        served.process.kill()
        served.process.wait()


def missed(points: list[dict], truth) -> np.ndarray:
    """Return how far (px) points of a file are from the truth."""
    image = np.array([one["properties"]["ji"] for one in points]) + 0.5
    return np.hypot(*(image - truth.image_of([one["geometry"]["coordinates"] for one in points])).T)


#: Keeps all that the page says.
LISTEN = """() => { const said = document.getElementById('said'); window.told = [];
  new MutationObserver(() => window.told.push(said.textContent)).observe(said, {childList: true}); }"""


def test_a_person_clicks_two_points(serve, reference: Path, truth, features: np.ndarray) -> None:
    served = serve(reference)
    panes = _panes(served.page)
    served.page.evaluate(LISTEN)
    for number, feature in enumerate(features[[2, 3]]):
        served.click("scene", feature + np.array([2, -2]))
        served.accept(f"P{number + 1}")
        assert _panes(served.page) == panes
    served.says("#what", r"\(leave-one-out\), relative to the reference")
    # Whoever waits reads for what.
    told = served.page.evaluate("() => window.told")
    assert [text for text in told if "…" in text] == ["Matching …", "Saving P1 …", "Matching …", "Saving P2 …"]
    _say_much(served.page)
    assert _panes(served.page) == panes
    assert served.page.locator("#table tbody tr").count() == 2
    # Loaded anew, the page shows the points that there are.
    served.page.reload()
    served.says("#what", r"\(leave-one-out\), relative to the reference")
    playwright.expect(served.page.locator("#table tbody tr")).to_have_count(2)
    served.says("#said", "Click a feature")
    # A second window follows what the first one does.
    second = served.page.context.new_page()
    second.goto(served.address)
    playwright.expect(second.locator("#banner-text")).to_have_text(re.compile("Read-only"), timeout=_SLOW_MACHINE)
    served.page.keyboard.press("z")
    playwright.expect(second.locator("#table tbody tr")).to_have_count(1, timeout=_SLOW_MACHINE)
    # The second window takes over and leaves. The first one must load the points again before it can write.
    second.click("#take")
    playwright.expect(second.locator("#banner")).to_be_hidden()
    second.keyboard.press("Shift+Z")
    playwright.expect(second.locator("#table tbody tr")).to_have_count(2, timeout=_SLOW_MACHINE)
    second.close()
    served.page.keyboard.press("z")
    served.says("#banner-text", "Read-only")
    playwright.expect(served.page.locator("#table tbody tr")).to_have_count(2, timeout=_SLOW_MACHINE)
    served.page.click("#take")
    playwright.expect(served.page.locator("#banner")).to_be_hidden()
    # Another browser does not get in: neither by the address that was used, nor by that of the page.
    other = served.page.context.browser.new_page()
    for address in (served.address, served.page.url):
        answer = other.goto(address)
        assert answer is not None
        assert answer.status == 403
    other.close()
    points = served.end()
    assert missed(points, truth).max() < 0.1
    assert [one["properties"]["measured"] for one in points] == ["matched", "matched"]
    assert served.hosts == {served.address.split("/")[2]}, "a request left the page's own server"
    # Chromium reports the refused action.
    assert all("409" in fault for fault in served.faults)


@pytest.mark.slow
def test_errors_that_a_person_enters_are_saved(serve, reference: Path, truth, features: np.ndarray) -> None:
    """Those of surveyed coordinates are entered before the coordinates are used, and the pixel may move after."""
    served = serve(reference)
    page = served.page
    page.click("summary:has-text('Surveyed coordinates')")
    for name, value in zip(("x", "y", "h"), truth.ground_at(features[[2]])[0], strict=True):
        page.fill(f"#{name}", f"{value:.9f}")
    page.fill("#sigma-xy", "0.03")
    page.fill("#sigma-h", "0,05")
    page.click("#typed")
    served.says("#said", "Coordinates set")
    page.focus("#scene")
    page.keyboard.press("m")
    served.says("#said", "Matched|No match")
    page.wait_for_load_state("networkidle")
    page.locator("#sigma").press_sequentially("0.25")
    page.focus("#scene")
    page.keyboard.press("ArrowRight")
    served.says("#said", "Manual")
    page.keyboard.press("Enter")
    served.says("#said", "P1 accepted")
    (point,) = served.end()
    assert point["properties"]["sigma_image"] == 0.25
    assert [point["properties"][name] for name in ("sigma_xy", "sigma_h")] == [0.03, 0.05]


@pytest.mark.slow
def test_a_person_clicks_six_points_in_either_view(serve, reference: Path, truth, features: np.ndarray) -> None:
    served = serve(reference)
    for number, feature in enumerate(features):
        served.click("scene" if number < 2 or number % 2 else "reference", feature + np.array([-2, 2]))
        served.accept(f"P{number + 1}")
    # Undo, redo, a blunder made by the arrow keys, and its name.
    served.page.keyboard.press("z")
    playwright.expect(served.page.locator("#table tbody tr")).to_have_count(5)
    served.page.keyboard.press("Shift+Z")
    playwright.expect(served.page.locator("#table tbody tr")).to_have_count(6)
    points = served.end()
    assert missed(points, truth).max() < 0.1
    assert not served.faults


@pytest.mark.slow
def test_a_point_is_measured_in_the_map_which_follows_the_scene(serve, whole_reference: Path, truth) -> None:
    served = serve(whole_reference)
    page = served.page
    page.keyboard.press("u")
    served.says("#reference-title", "Reference as a map")
    accepted = 0
    while accepted < 3:
        page.keyboard.press("n")
        page.wait_for_load_state("networkidle")
        page.focus("#reference")
        page.keyboard.press("m")
        served.says("#said", "Matched|No match")
        if "Matched" in page.inner_text("#said"):
            accepted += 1
            served.accept(f"P{accepted}")
    # Panned in the map, the scene follows: what is measured there is the same place.
    page.focus("#reference")
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(800)
    page.focus("#scene")
    page.keyboard.press("m")
    served.says("#said", "Matched|No match|outside the image")
    page.keyboard.press("Escape")
    points = served.end()
    assert len(points) == 3
    assert missed(points, truth).max() < 0.1
    assert not served.faults


@pytest.mark.slow
def test_a_stereo_pair_is_tied_by_clicks_in_either_image(
    serve, reference: Path, stereo, truth, features: np.ndarray, tmp_path: Path
) -> None:
    served = serve(reference, stereo.path)
    page = served.page
    served.says("#reference-title", "second.tif")
    # Ties and control by a click in the first image; the last one begins in the second.
    for number, role in enumerate(["control", "tie", "control", "check"]):
        page.select_option("#role", role)
        served.click("scene", features[number] + np.array([2, -2]))
        served.says("#said", "Matched: second")
        page.keyboard.press("Enter")
        served.says("#said", f"P{number + 1} accepted")
        page.keyboard.press("Escape")
    served.says("#what", "1 check point")
    scrolled, shown = page.evaluate(
        "() => { const box = document.querySelector('aside > .scroll'); return [box.scrollWidth, box.clientWidth]; }"
    )
    assert scrolled <= shown, "the last column is cut off"
    page.select_option("#role", "tie")
    page.select_option("#scene-shows", "scene-1")
    page.select_option("#reference-shows", "scene-0")
    page.keyboard.press("j")
    served.says("#said", "P1 \\(control")
    page.keyboard.press("Escape")
    page.select_option("#reference-shows", "map-0")
    page.wait_for_timeout(500)
    playwright.expect(page.locator("#table tbody tr")).to_have_count(4)
    features_of_file = served.end()
    assert [one["properties"]["filename"] for one in features_of_file] == ["scene.tif", "second.tif"] * 4
    for first, second in zip(features_of_file[::2], features_of_file[1::2], strict=True):
        ground = truth.ground_at(np.array([first["properties"]["ji"]]) + 0.5)
        apart = np.array(second["properties"]["ji"]) + 0.5 - stereo.truth.image_of(ground)[0]
        assert np.hypot(*apart) < 0.2
    assert not served.faults


def tab_to_scene(page: playwright.Page, most: int) -> None:
    """Press the tabulator until the view of the scene has the focus."""
    for _ in range(most):
        page.keyboard.press("Tab")
        if page.evaluate("() => document.activeElement.id") == "scene":
            break
    assert page.evaluate("() => document.activeElement.id") == "scene"


@pytest.mark.slow
def test_six_points_by_keyboard_alone(serve, whole_reference: Path, truth) -> None:
    served = serve(whole_reference)
    page = served.page
    page.keyboard.press("?")
    playwright.expect(page.locator("#keys")).to_be_visible()
    page.keyboard.press("Escape")
    tab_to_scene(page, 12)
    accepted = 0
    for _ in range(12):
        page.keyboard.press("n")
        page.keyboard.press("m")
        served.says("#said", "Matched|No match")
        if "No match" in page.inner_text("#said"):
            continue
        accepted += 1
        page.keyboard.press("Enter")
        served.says("#said", f"P{accepted} accepted")
        if accepted == 6:
            break
    page.keyboard.press("j")
    served.says("#said", "P1 \\(control")
    before = page.inner_text("#table tbody")
    page.keyboard.press("ArrowRight")
    served.says("#said", "Manual")
    page.keyboard.press("Escape")
    assert page.inner_text("#table tbody") == before
    points = served.end()
    assert len(points) == 6
    assert missed(points, truth).max() < 0.1
    assert not served.faults


@pytest.mark.slow
def test_six_points_of_a_pair_by_keyboard_alone(serve, whole_reference: Path, whole_stereo, truth) -> None:
    """Ties and control at the places that are offered, a role changed, models compared: no mouse."""
    served = serve(whole_reference, whole_stereo.path)
    page = served.page
    tab_to_scene(page, 14)
    accepted = 0
    for _ in range(40):
        page.keyboard.press("n")
        page.keyboard.press("m")
        served.says("#said", "Matched: second|No match|Reference")
        said = page.inner_text("#said")
        # A control point could do with one image; those of the other roles could not.
        # Places near an edge are offered again after each point.
        if "Enter to accept" not in said or "No match" in said:
            page.keyboard.press("Escape")
            continue
        # Tie, control, check, and again.
        page.keyboard.press("r")
        served.says("#said", r"Role: \w+\. Press Enter to accept\.")
        accepted += 1
        page.keyboard.press("Enter")
        served.says("#said", f"P{accepted} accepted")
        if accepted == 6:
            break
    served.says("#what", "Only 2 check points")
    assert "Best next control point" in page.inner_text("#gain")
    roles = [row.split("\t")[1] for row in page.inner_text("#table tbody").strip().split("\n")]
    assert sorted(roles) == ["check", "check", "control", "control", "tie", "tie"]
    page.keyboard.press("c")
    playwright.expect(page.locator("#compared")).to_be_visible(timeout=_SLOW_MACHINE)
    assert "Recommended" in page.inner_text("#recommended")
    page.keyboard.press("Escape")
    page.keyboard.press("g")
    served.says("#ortho-said", r"scene\.tif: .* px: RMSE of .* when it was adjusted in a block")
    playwright.expect(page.locator("#ortho-own")).to_be_visible()
    page.keyboard.press("Escape")
    page.keyboard.press("j")
    served.says("#said", "P1 ")
    before = page.inner_text("#table tbody")
    page.keyboard.press("ArrowRight")
    served.says("#said", "Manual")
    page.keyboard.press("Escape")
    assert page.inner_text("#table tbody") == before
    points = served.end()
    assert len(points) == 12
    assert served.hosts == {served.address.split("/")[2]}, "a request left the page's own server"
    assert not served.faults


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("pair", [False, True])
def test_nothing_serious_keeps_anybody_out(
    browser, serve, reference: Path, stereo, features: np.ndarray, scheme: str, pair: bool
) -> None:
    """axe-core finds no serious fault, with a point under way and with dialogues open, of a scene and of a pair."""
    # The page's own policy would not let a script of the test in.
    served = serve(reference, *([stereo.path] if pair else []), bypass_csp=True, color_scheme=scheme)
    if pair:
        for number, feature in enumerate(features[1:5]):
            served.click("scene", feature)
            served.says("#said", "Matched: second")
            served.page.keyboard.press("Enter")
            served.says("#said", f"P{number + 1} accepted")
    served.click("scene", features[0 if pair else 2])
    served.says("#said", "Matched")
    axe = (Path(__file__).parent / "axe" / "axe.min.js").read_text(encoding="utf-8")
    served.page.evaluate(axe)
    for opened in ("", "?", *("c" if pair else "")):
        if opened:
            served.page.keyboard.press("Escape")
            served.page.focus("#scene")
            served.page.keyboard.press(opened)
            playwright.expect(served.page.locator("dialog[open]")).to_be_visible(timeout=_SLOW_MACHINE)
        found = served.page.evaluate("() => axe.run(document, {resultTypes: ['violations']})")
        serious = [
            (one["id"], [node["html"][:120] for node in one["nodes"]])
            for one in found["violations"] if one["impact"] in ("serious", "critical")
        ]  # fmt: skip
        assert not serious


@pytest.mark.slow
def test_a_killed_server_loses_nothing_and_the_page_says_so(serve, reference: Path, features: np.ndarray) -> None:
    served = serve(reference)
    served.click("scene", features[2])
    served.accept("P1")
    served.process.kill()
    served.process.wait()
    served.page.keyboard.press("z")
    served.says("#said", "All accepted points are saved")
    again = serve(reference)
    playwright.expect(again.page.locator("#table tbody tr")).to_have_count(1)
    assert len(again.end()) == 1


def _panes(page: playwright.Page) -> list:
    return [page.locator(f"#{pane}").bounding_box() for pane in ("scene", "reference")]


def _say_much(page: playwright.Page) -> None:
    """Let every text of the page be long."""
    page.evaluate("() => { document.getElementById('what').textContent = 'A long headline. '.repeat(60); }")
    page.evaluate("() => { document.getElementById('said').textContent = 'A long message. '.repeat(60); }")
    page.evaluate("() => { document.getElementById('reference-title').textContent = 'A long title. '.repeat(60); }")
    page.evaluate("() => { document.getElementById('banner').hidden = false; }")


@pytest.mark.slow
def test_panes_of_a_narrow_window_stay_where_they_are(serve, reference: Path, features: np.ndarray) -> None:
    served = serve(reference, viewport={"width": 1000, "height": 860})
    page, before = served.page, _panes(served.page)
    for number, feature in enumerate(features[[2, 3]]):
        served.click("scene", feature)
        served.accept(f"P{number + 1}")
        assert _panes(page) == before
    _say_much(page)
    assert _panes(page) == before
    assert not served.faults


#: What a pane shows.
SEEN = """(pane) => [...document.querySelectorAll(`#${pane} canvas`)].map((one) => one.toDataURL()).join()"""


def at_rest(page: playwright.Page, pane: str) -> str:
    """Return what a pane shows as soon as no tile and no animation has changed it for half a second."""
    seen, later = None, page.evaluate(SEEN, pane)
    while seen != later:
        page.wait_for_load_state("networkidle")
        page.wait_for_timeout(500)
        seen, later = later, page.evaluate(SEEN, pane)
    return str(later)


def zooms(page: playwright.Page, pane: str) -> bool:
    """Turn the wheel over a pane; return whether it shows something else then."""
    box = page.locator(f"#{pane}").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    before = at_rest(page, pane)
    page.mouse.wheel(0, -300)
    try:
        page.wait_for_function(f"(before) => ({SEEN})({pane!r}) !== before", arg=before)
    except playwright.TimeoutError:
        return False
    return at_rest(page, pane) != before


def test_the_wheel_zooms_and_a_dragged_point_stays(serve, reference: Path, features: np.ndarray) -> None:
    served = serve(reference)
    page = served.page
    assert zooms(page, "scene"), "nothing has the focus yet"
    assert zooms(page, "reference")
    page.locator("#cancel").evaluate("(button) => button.focus()")
    assert zooms(page, "reference")
    assert zooms(page, "scene")
    # The whole scene again.
    page.reload()
    served.says("#what", "no points yet")
    served.click("scene", np.array([500.0, -60.0]))
    served.says("#said", "^You clicked outside the image.$")
    served.click("scene", features[2])
    served.accept("P1")
    page.keyboard.press("j")
    served.says("#said", "P1 ")
    box = page.locator("#scene").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.wait_for_timeout(500)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 30, middle[1] + 20, steps=6)
    page.mouse.up()
    served.says("#said", r"P1 \(control, manual")
    page.keyboard.press("Enter")
    served.says("#said", "P1 accepted")
    (point,) = served.end()
    moved = np.array(point["properties"]["ji"]) + 0.5 - features[2]
    assert np.allclose(moved, [30, 20], atol=1.5), moved
    assert not served.faults
