"""How well the panchromatic and the multispectral ortho agree: the displacement of one from the other."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ortho_pipeline.commands.orthos.measuring import measure_ortho
from ortho_pipeline.commands.orthos.statistics import Verified
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors.texts import Text
from ortho_pipeline.files.shell import typed
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions

#: Displacement (panchromatic px, RMS) beyond which colours are visibly beside their objects.
LIMIT = 0.5
#: Matches to try. An error that all of them share limits the mean, so more of them do not improve it.
_MATCHES = 100


@dataclass(frozen=True)
class Agreement:
    """The displacement of the panchromatic ortho from the multispectral one, in panchromatic pixels.

    Parameters
    ----------
    shift, sigma : (float, float)
        Mean over the common area, columns and rows, and its standard deviation.
    rmse : float
        RMS of the displacement, with its changes over the area.
    matches, tried : int
        Places that were matched, and that were tried.
    """

    shift: tuple[float, float]
    sigma: tuple[float, float]
    rmse: float
    matches: int
    tried: int

    def to_json(self) -> dict[str, object]:
        """Return the numbers by name."""
        return {
            "column_px": self.shift[0],
            "row_px": self.shift[1],
            "sigma_column_px": self.sigma[0],
            "sigma_row_px": self.sigma[1],
            "rmse_px": self.rmse,
            "matches": self.matches,
            "tried": self.tried,
        }


def measure_agreement(
    pan: str | os.PathLike[str], colours: str | os.PathLike[str], scene: SceneOptions, output: OutputOptions
) -> Agreement:
    """Match two orthos of one acquisition.

    Raises
    ------
    InputError
        If they do not match.
    """
    measured = measure_ortho(pan, MatchOptions(reference=(colours,), points=_MATCHES), scene=scene, output=output)
    verified = Verified.of(measured)
    # Of each draw of the field: metres to east and north, in pixels.
    pixels = np.einsum("pa,kma->kmp", np.linalg.inv(measured.metres), verified.draws)
    means = pixels.mean(axis=1)
    (column, row), (across, down) = means.mean(axis=0).tolist(), means.std(axis=0).tolist()
    rmse = float(np.median(np.sqrt((pixels**2).sum(axis=2).mean(axis=1))))
    tried = len(measured.matched.matches.reason)
    return Agreement((column, row), (across, down), rmse, len(measured.image), tried)


def displaced(
    agreement: Agreement, pan: str | os.PathLike[str], colours: str | os.PathLike[str], ratio: int | None = None
) -> Notice | None:
    """Return the warning about orthos that do not agree; None if they do.

    Parameters
    ----------
    ratio : int, optional
        Panchromatic pixels along an original multispectral one, where the multispectral ortho has panchromatic pixels.
    """
    if agreement.rmse <= LIMIT:
        return None
    moved = typed(Path("aligned", f"{Path(colours).stem}_aligned.tif"))
    again = f"`ortho sharpen {typed(pan)} {moved} -o sharpened`"
    if ratio:
        again = f"`ortho sharpen {typed(pan)} {moved} --ratio {ratio} -o sharpened`"
    text = Text(
        f"the multispectral ortho is displaced by {agreement.rmse:.2f} panchromatic px (limit {LIMIT} px), so colours "
        f"are next to their objects. Align it: `ortho align {typed(colours)} --reference {typed(pan)} -o aligned`. "
        f"Then sharpen again: {again}"
    )
    return Notice("sharpen-displaced", text, rmse_px=agreement.rmse, limit_px=LIMIT)
