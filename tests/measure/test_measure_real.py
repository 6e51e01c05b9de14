"""Six points clicked in a real QuickBird scene against orthos of real aerial frames; surveyed points judge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ortho_measure.session import open_session
from test_match_real import QuickBird

from ortho_pipeline.options import MatchOptions, SurfaceOptions

pytestmark = [pytest.mark.realdata, pytest.mark.slow]
WANTED = 6


def test_six_clicks_give_the_surveyed_shift(real: Path, tmp_path: Path) -> None:
    """At the places that the page offers; what is refused is passed over, as a person does."""
    scene = QuickBird(real, tmp_path)
    dem = SurfaceOptions(dem=real / "orthority" / "ngi" / "dem.tif", vertical="egm96", override_vertical=True)
    references = tuple(map(str, scene.orthos(6.0)))
    session = open_session(
        scene.image, tmp_path / "p.geojson", surface=dem, match=MatchOptions(reference=references, search=60.0)
    )
    state, refused, found = session.state(), 0, 0
    while found < WANTED:
        click = np.add(state["next"][refused]["image"], (1.5, -1.0))
        match = session.proposal(click.tolist())
        if match["reason"]:
            refused += 1
            continue
        found, refused = found + 1, 0
        mark = {key: match[key] for key in ("image", "ground", "score", "covariance")}
        mark |= {"id": f"P{found}", "how": "matched", "ground_from": "reference"}
        state = session.act({"do": "put", "mark": mark})
    fit, surveyed = session.solution.fit, scene.surveyed
    assert fit is not None
    assert not fit.rejected
    # Both know the shift to a part of a pixel, and say to which.
    spread = np.sqrt(np.diag(fit.covariance) + np.diag(surveyed.covariance))
    assert (np.abs(fit.values - surveyed.values) < 3 * spread).all()
    assert np.abs(fit.values - surveyed.values).max() < 0.5
    session.close()
