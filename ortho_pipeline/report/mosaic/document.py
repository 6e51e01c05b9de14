"""The record of a mosaic, and its summary in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ortho_pipeline.display.numbers import share, short
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.geodesy.naming import crs_definition, crs_text
from ortho_pipeline.warp.mosaic import Balance, Mosaic, Owners


def mosaic_document(
    placed: Mosaic,
    seams: Sequence[Mapping[str, Any]],
    balance: Balance | None = None,
    owners: Owners | None = None,
    clamped: float = 0.0,
) -> dict[str, Any]:
    """Return the record of a mosaic as JSON values, which docs/mosaic.md explains."""
    measured = [seam for seam in seams if seam["patches"]]
    lengths = [math.hypot(*seam["median_px"]) for seam in measured]
    worst = max(zip(lengths, measured, strict=True), key=lambda pair: pair[0], default=None)
    return {
        "crs": crs_definition(placed.grid.crs, min_confidence=70),
        "crs_name": crs_text(placed.grid.crs),
        "extent": [float(value) for value in placed.grid.extent],
        "resolution": [placed.grid.dx, placed.grid.dy],
        "size": [placed.grid.width, placed.grid.height],
        "on_top_first": [layer.ortho.name for layer in placed.layers],
        "balance": None if balance is None else _balance(placed, balance, clamped),
        "seamlines": None if owners is None else _seamlines(placed, owners),
        "seams": [dict(seam) for seam in seams],
        "seams_measured": len(measured),
        "median_seam_px": float(np.median(lengths)) if lengths else None,
        "worst_seam": worst and {"first": worst[1]["first"], "second": worst[1]["second"], "px": worst[0]},
    }


def _balance(placed: Mosaic, balance: Balance, clamped: float) -> dict[str, Any]:
    return {
        "scenes": {
            layer.ortho.name: {"gain": gain.tolist(), "offset": offset.tolist()}
            for layer, gain, offset in zip(placed.layers, balance.gains, balance.offsets, strict=True)
        },
        "before": balance.before.tolist(),
        "after": balance.after.tolist(),
        "cells": balance.cells,
        "outlying_share": balance.outlying,
        "clamped_share": clamped,
    }


def _seamlines(placed: Mosaic, owners: Owners) -> dict[str, Any]:
    known = owners.owners >= 0
    counts = np.bincount(owners.owners[known], minlength=len(placed.layers)) / max(int(known.sum()), 1)
    return {
        "cell_px": owners.cell,
        "moved_share": float((owners.owners != owners.ordered)[known].mean()) if known.any() else 0.0,
        "shares": {layer.ortho.name: float(part) for layer, part in zip(placed.layers, counts, strict=True)},
    }


# -- words -----------------------------------------------------------------------------------------------------------


def summary_text(document: Mapping[str, Any]) -> str:
    """Return the result of a mosaic as a few lines."""
    width, height = document["size"]
    lines = [f"mosaic: {width} x {height} px of {counted(len(document['on_top_first']), 'scene')}"]
    if balance := document["balance"]:
        lines.append(f"balance: {balance_text(balance)}")
    if seamlines := document["seamlines"]:
        lines.append(f"seam lines: {share(seamlines['moved_share'])} of the mosaic changed its scene")
    if document["seams"]:
        text = f"seams: {document['seams_measured']} of {len(document['seams'])} measured"
        if document["worst_seam"]:
            worst = document["worst_seam"]
            text += f", median {document['median_seam_px']:.2f} px, worst {worst['px']:.2f} px"
            text += f" ({worst['first']} and {worst['second']})"
        lines.append(text)
    lines += [along_text(before, after) for before, after in along(document)]
    return "\n".join(lines)


def balance_text(balance: Mapping[str, Any]) -> str:
    """Return the result of a balance in words."""
    before, after = (" / ".join(short(value) for value in balance[when]) for when in ("before", "after"))
    said = f"overlaps differ by {after} (before the balance: {before}; RMS of each band)"
    said += f"; {share(balance['outlying_share'])} of {counted(balance['cells'], 'cell')} excluded as outliers"
    if balance["clamped_share"]:
        said += f"; {share(balance['clamped_share'])} of the pixels exceeded their type and were clamped"
    return said


def along(document: Mapping[str, Any]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return the differences along all seams before and after; nothing if they were not measured."""
    found = [[seam[when] for seam in document["seams"] if seam.get(when)] for when in ("before", "after")]
    return [(_together(found[0]), _together(found[1]))] if all(found) else []


def _together(seams: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the root mean squares over seams: of the brightness by places, of the content by matches."""
    seen = [seam for seam in seams if seam["rms"] is not None]
    places, matched = sum(seam["places"] for seam in seen), sum(seam["matched"] for seam in seams)
    rms = np.sqrt(sum(seam["places"] * np.mean(np.square(seam["rms"])) for seam in seen) / places) if places else None
    apart = sum(seam["matched"] * seam["rmse_px"] ** 2 for seam in seams if seam["matched"])
    return {
        "length_px": sum(seam["length_px"] for seam in seams),
        "rms": None if rms is None else float(rms),
        "largest_rms": max((max(seam["largest_rms"]) for seam in seen), default=None),
        "matched": matched,
        "rmse_px": math.sqrt(apart / matched) if matched else None,
    }


def along_text(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return how scenes differ along the seams, before and after."""
    said = []
    if before["rms"] is not None and after["rms"] is not None:
        worst = f"largest {short(after['largest_rms'])}"
        said.append(
            f"{short(after['rms'])} in brightness (RMS; {worst}; before the correction: {short(before['rms'])})"
        )
    if before["rmse_px"] is not None and after["rmse_px"] is not None:
        said.append(f"{after['rmse_px']:.2f} px in position (before the correction: {before['rmse_px']:.2f} px)")
    return f"along the seams scenes differ by {' and '.join(said)}" if said else "along the seams nothing was measured"
