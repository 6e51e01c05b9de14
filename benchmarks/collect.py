"""All benchmarks, one after the other, into docs/performance.json, and the tables of both pages from it.

    python benchmarks/collect.py                     all
    python benchmarks/collect.py --only warp         one of them; may be repeated, the others stay as they are
    python benchmarks/collect.py --table             the tables of both pages, from the file

A benchmark that fails, or a figure that is not what was asked for, is noted there and stops nothing.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

HOME = Path(__file__).resolve().parents[1]
FILE = HOME / "docs" / "performance.json"
#: For users: one row for each CRS of the DEM. For engineers: all programs.
USER_PAGE, PAGE = HOME / "docs" / "performance.md", HOME / "docs" / "engineering" / "performance.md"
OURS, CUBIC = "ortho rectify, bilinear", "ortho rectify, cubic"
COPY, EXACT = "gdal_translate (copy)", "gdalwarp exact, bilinear"
#: Benchmark -> the CRS of its DEM, as the table for users calls it.
DEMS = {"warp-lonlat": "EPSG:4326", "warp": "the CRS of the ortho"}
#: Name -> the words of a benchmark, and whether it writes JSON.
BENCHMARKS: dict[str, tuple[list[str], bool]] = {
    "warp": (["warp.py", "--rounds", "5"], True),
    "warp-lonlat": (
        ["warp.py", "--rounds", "5", "--dem-crs", "EPSG:4326", "--program", OURS, "--program", EXACT],
        True,
    ),
    "scaling": (["warp.py", "--scaling"], True),
    "points": (["points.py"], True),
    "fit": (["fit.py"], False),
    "blocks": (["adjust.py"], True),
    "scenes": (["batch.py"], True),
    "answers": (["answers.py"], False),
    "measuring": (["measure.py"], False),
}
#: What was asked of the warp: a text, the program, the part, which bound, and its side.
TARGETS = (
    ("exact gdalwarp takes at least 15 times as long", EXACT, "wall_ratio", 15.0, "least"),
    ("exact gdalwarp takes at least 20 times the CPU", EXACT, "cpu_ratio", 20.0, "least"),
    ("a copy takes at least 1 / 1.5 of the time", COPY, "wall_ratio", 1 / 1.5, "least"),
    ("cubic takes at most 1.25 times as long as bilinear", CUBIC, "wall_ratio", 1.25, "most"),
    ("bilinear takes at most 512 MB", OURS, "memory", 512.0, "most"),
)
BEGIN, END = "<!-- headline -->", "<!-- end of headline -->"


def summary(runs: Mapping[str, Sequence[Mapping[str, float]]]) -> dict[str, dict[str, Any]]:
    """Return medians of each program, and its ratios to ours within each round: median, least, greatest."""
    told: dict[str, dict[str, Any]] = {}
    for name, found in runs.items():
        told[name] = {part: statistics.median(run[part] for run in found) for part in ("wall", "cpu")}
        told[name]["memory"] = max(run["memory"] for run in found)
        for part in ("wall", "cpu"):
            ratios = sorted(one[part] / other[part] for one, other in zip(found, runs[OURS], strict=True))
            told[name][f"{part}_ratio"] = [statistics.median(ratios), ratios[0], ratios[-1]]
    return told


def targets(told: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return what was asked for, what was found, and whether that is enough; of programs that were run."""
    listed = []
    for text, program, part, bound, side in TARGETS:
        if program in told:
            value = told[program][part]
            found = value[0] if isinstance(value, list) else value
            met = found >= bound if side == "least" else found <= bound
            listed.append({"asked": text, "bound": bound, "found": found, "met": met})
    return listed


def row_of(runs: Mapping[str, Sequence[Mapping[str, float]]], dem: str) -> dict[str, Any]:
    """Return the row of the table for users: seconds of both programs, and their ratios."""
    told = summary({OURS: runs[OURS], EXACT: runs[EXACT]})
    ratios = {part: told[EXACT][part][0] for part in ("wall_ratio", "cpu_ratio")}
    return {"dem": dem, "ours": told[OURS]["wall"], "exact": told[EXACT]["wall"], **ratios}


def user_table(document: Mapping[str, Any]) -> str:
    """Return the table of docs/performance.md."""
    lines = ["| DEM in | `ortho rectify` | exact `gdalwarp` | ratio | ratio in CPU time |", "|---|---|---|---|---|"]
    for row in document["dems"]:
        ours, exact, wall, cpu = (f"{row[part]:.2g}" for part in ("ours", "exact", "wall_ratio", "cpu_ratio"))
        lines.append(f"| {row['dem']} | {ours} s | {exact} s | **{wall}** | {cpu} |")
    return "\n".join(lines)


def table(document: Mapping[str, Any]) -> str:
    """Return the table of docs/engineering/performance.md."""
    lines = [
        "| program | wall s | CPU s | memory MB | wall time of ours = 1 | CPU time of ours = 1 |",
        "|---|---|---|---|---|---|",
    ]
    told = document["ratios"]
    for name in sorted(told, key=lambda name: told[name]["wall"]):
        one = told[name]
        middle, low, high = one["wall_ratio"]
        ratio = "1" if name == OURS else f"{middle:.3g} ({low:.3g}–{high:.3g})"
        strong = "**" if name == OURS else ""
        lines.append(
            f"| {strong}{name}{strong} | {one['wall']:.1f} | {one['cpu']:.1f} | {one['memory']:.0f} | {ratio} "
            f"| {one['cpu_ratio'][0]:.3g} |"
        )
    return "\n".join(lines)


def write_tables(document: Mapping[str, Any]) -> None:
    """Write the tables of both pages between their marks."""
    for page, text in ((USER_PAGE, user_table(document)), (PAGE, table(document))):
        before, rest = page.read_text(encoding="utf-8").split(BEGIN)
        after = rest.split(END)[1]
        page.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


def run(words: Sequence[str], writes_json: bool) -> dict[str, Any]:
    """Run a benchmark; return its end, its seconds, what it printed, and what it found if it says so as JSON."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "found.json"
        more = ["--json", str(path)] if writes_json else []
        done = subprocess.run(
            [sys.executable, str(HOME / "benchmarks" / words[0]), *words[1:], *more],
            stdout=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
        print(done.stdout, flush=True)
        told: dict[str, Any] = {
            "exit": done.returncode, "seconds": round(time.monotonic() - begin, 1), "printed": done.stdout.splitlines(),
        }  # fmt: skip
        if path.exists():
            told["found"] = json.loads(path.read_text(encoding="utf-8"))
    return told


def merged(document: Mapping[str, Any], name: str, told: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document with the result of a benchmark."""
    found = dict(told.get("found", {}))
    out = {**document, "others": dict(document.get("others", {}))}
    if name in DEMS and found and told.get("exit") == 0:
        rows = {row["dem"]: row for row in document.get("dems", [])}
        rows[DEMS[name]] = row_of(found["headline"], DEMS[name])
        out["dems"] = [rows[dem] for dem in DEMS.values() if dem in rows]
    if name in ("warp", "scaling") and found:
        out |= found
        if name == "warp":
            out["ratios"] = summary(found["headline"])
            out["targets"] = targets(out["ratios"])
    elif name not in DEMS or not found:
        out["others"][name] = dict(told)
    return out


def main() -> None:
    """Parse the options and run."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", action="append", choices=tuple(BENCHMARKS), help="may be repeated; all without")
    parser.add_argument("--table", action="store_true", help="write the table only")
    arguments = parser.parse_args()
    document = json.loads(FILE.read_text(encoding="utf-8"))
    for name in [] if arguments.table else arguments.only or BENCHMARKS:
        print(f"== {name}", flush=True)
        document = merged(document, name, run(*BENCHMARKS[name]))
        # What was measured stays, whatever comes after it.
        FILE.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    # Of a file that somebody else has written, too.
    document = merged(document, "warp", {"found": {"headline": document["headline"]}})
    FILE.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    write_tables(document)
    for one in document["targets"]:
        print(f"{'met' if one['met'] else 'NOT MET':8s}{one['asked']}: {one['found']:.3g}")


if __name__ == "__main__":
    main()
