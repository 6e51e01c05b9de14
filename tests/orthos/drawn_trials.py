"""Experiments with `ortho verify` on drawn pairs: tests run a few, `benchmarks/ortho_pairs.py` many."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from pairs import Pair, drawn

from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.options import MatchOptions, OutputOptions

STATISTICS = ("bias_east", "bias_north", "rmse", "ce90")


def trial(seed: int, *, elsewhere: bool) -> dict[str, Any]:
    """Return what `ortho verify` finds for one pair, compared with the truth; lengths in px of the coarser image."""
    pair: Pair = drawn(seed, elsewhere=elsewhere)
    coarse = max(pair.ortho.gsd, pair.reference.gsd)
    row: dict[str, Any] = {
        "seed": seed, "ground": pair.ground, "ratio": pair.ortho.gsd / pair.reference.gsd, "bend": pair.bend / coarse,
        "clouds": pair.ortho.clouds, "season": pair.ortho.season, "shift": float(np.hypot(*pair.shift)) / coarse,
        "pixels": pair.pixels, "band": pair.ortho.band, "haze": pair.ortho.haze, "length": pair.length,
        "slopes": pair.slopes != ((0.0, 0.0), (0.0, 0.0)),
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        ortho, reference = pair.write(Path(folder))
        begin = time.monotonic()
        search = 1.3 * float(np.hypot(*pair.shift)) + 10 * coarse
        try:
            options = MatchOptions(reference=[str(reference)], search=search)
            document = verify(ortho, match=options, output=OutputOptions(threads=1)).document
        except OrthoError as error:
            return row | {"refused": error.message, "seconds": time.monotonic() - begin}
        row["seconds"] = time.monotonic() - begin
    cells = np.array([one["image"] for one in document["field"]["cells"]])
    true = pair.on_the_ground(cells)
    found = np.array([[one["east_m"], one["north_m"]] for one in document["field"]["cells"]])
    length = np.hypot(*true.T)
    truth = {
        "bias_east": true[:, 0].mean(), "bias_north": true[:, 1].mean(), "rmse": np.sqrt((length**2).mean()),
        "ce90": np.quantile(length, 0.9),
    }  # fmt: skip
    relative = document["relative"]
    for name, value in truth.items():
        one = relative[f"{name}_m"]
        row[name] = {
            "truth": float(value) / coarse,
            "error": (one["value"] - value) / coarse,
            "half": (one["high"] - one["low"]) / 2 / coarse,
            "covers": bool(one["low"] <= value <= one["high"]),
        }
    row["field_error"] = float(np.median(np.hypot(*(found - true).T))) / coarse
    matches = document["matches"]
    row["kept"], row["local"], row["tested"] = (matches[name] for name in ("kept", "local", "tested_share"))
    row["noise"] = [one * pair.ortho.gsd / coarse for one in matches["noise_px"]]
    # 1 % of results may lie outside of a 99 % interval; half a pixel beyond it is wrong.
    wide = 2.576 / 1.96
    row["wrong"] = any(abs(row[name]["error"]) > wide * row[name]["half"] + 0.5 for name in truth)
    return row


def same_content(row: dict[str, Any]) -> bool:
    """Whether ortho and reference show the ground in the same season and band."""
    return not row["season"] and row["band"] == "a"


def told(rows: list[dict[str, Any]]) -> str:
    """Return what rows say together."""
    done = [row for row in rows if "refused" not in row]
    lines = [f"{len(rows)} pairs, {len(rows) - len(done)} refused, {sum(row['wrong'] for row in done)} wrong"]
    if done:
        lines.append(f"median error of the field {np.median([row['field_error'] for row in done]):.4f} px")
        for name in STATISTICS:
            errors = [abs(row[name]["error"]) for row in done]
            covers = np.mean([row[name]["covers"] for row in done])
            lines.append(
                f"{name}: median error {np.median(errors):.4f} px, 90th percentile {np.quantile(errors, 0.9):.4f} px, "
                f"covered {covers:.3f}"
            )
        for alike, text in ((True, "same"), (False, "another")):
            some = [row for row in done if same_content(row) == alike]
            parts = [f"{name} {np.mean([row[name]['covers'] for row in some]):.3f}" for name in STATISTICS if some]
            lines.append(f"covered in {len(some)} pairs of {text} season and band: {', '.join(parts)}")
        lines.append(f"seconds: median {np.median([row['seconds'] for row in done]):.1f}")
    return "\n".join(lines)
