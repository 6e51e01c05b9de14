"""docs/performance.json holds what both pages on performance show, in the form in which `make bench` writes it."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def collect() -> ModuleType:
    spec = importlib.util.spec_from_file_location("collect", ROOT / "benchmarks" / "collect.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tables_of_the_pages_are_those_of_the_file(collect: ModuleType) -> None:
    document = json.loads(collect.FILE.read_text(encoding="utf-8"))
    for page, expected in ((collect.PAGE, collect.table), (collect.USER_PAGE, collect.user_table)):
        shown = page.read_text(encoding="utf-8").split(collect.BEGIN)[1].split(collect.END)[0].strip()
        assert shown == expected(document), "python benchmarks/collect.py --table"
    assert document["ratios"] == collect.summary(document["headline"])
    assert document["targets"] == collect.targets(document["ratios"])
    assert {"cpu", "system", "python", "gdal", "numpy"} <= set(document["machine"])
    rounds = {len(runs) for runs in document["headline"].values()}
    assert len(rounds) == 1, "programs that did not take turns are not compared"
    for one in document.get("scaling", {}).values():
        assert {"megapixels", "bands", "wall_ns", "cpu_ns", "wall_ratio", "memory", "runs"} <= set(one)


def test_ratios_are_of_runs_within_a_round(collect: ModuleType) -> None:
    def runs(*walls: float) -> list[dict[str, float]]:
        return [{"wall": wall, "cpu": 2 * wall, "memory": 100.0 + wall} for wall in walls]

    # The machine became twice as slow in the third round: medians of all seconds would say 24 and 22.
    told = collect.summary({collect.OURS: runs(1.0, 1.1, 2.0), collect.EXACT: runs(20.0, 22.0, 44.0)})
    assert told[collect.EXACT]["wall_ratio"] == pytest.approx([20.0, 20.0, 22.0])
    assert told[collect.EXACT]["memory"] == 144.0
    met = {one["asked"]: one["met"] for one in collect.targets(told)}
    assert met == {
        "exact gdalwarp takes at least 15 times as long": True,
        "exact gdalwarp takes at least 20 times the CPU": True,
        "bilinear takes at most 512 MB": True,
    }


def test_each_crs_of_the_dem_has_its_row(collect: ModuleType) -> None:
    document = json.loads(collect.FILE.read_text(encoding="utf-8"))
    runs = {
        collect.OURS: [{"wall": 2.0, "cpu": 3.0, "memory": 1.0}],
        collect.EXACT: [{"wall": 30.0, "cpu": 60.0, "memory": 1.0}],
    }
    after = collect.merged(document, "warp-lonlat", {"exit": 0, "found": {"headline": runs}})
    row = {"dem": "EPSG:4326", "ours": 2.0, "exact": 30.0, "wall_ratio": 15.0, "cpu_ratio": 20.0}
    assert after["dems"] == [row, document["dems"][1]]
    assert "| EPSG:4326 | 2 s | 30 s | **15** | 20 |" in collect.user_table(after)
    assert after["headline"] == document["headline"]


def test_a_benchmark_that_fails_is_noted_and_stops_nothing(collect: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("print('so far'); raise SystemExit('a target was missed')")
    told = collect.run([str(tmp_path / "broken.py")], True)
    assert (told["exit"], told["printed"]) == (1, ["so far"])
    document = {"machine": {}, "headline": {}, "ratios": {}, "targets": [], "others": {"fit": {"exit": 0}}}
    after = collect.merged(document, "blocks", told)
    assert after["others"] == {"fit": {"exit": 0}, "blocks": told}
    # A warp that failed leaves what was measured before.
    assert collect.merged(document, "warp", told)["headline"] == {}
    assert all((ROOT / "benchmarks" / words[0]).exists() for words, _ in collect.BENCHMARKS.values())
