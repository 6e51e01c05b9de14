"""Follow the inputs of the sample job through the code: `python tools/journey.py [-v] [FOLDER OF THE REPOSITORY]`.

Rectifies the sample scene under a profiler and prints, for the DEM, the points and the model, how many functions in how
many files are handed it on the way from `commands.rectify` to the warp engine: as options, as a path, or opened. The
model is counted within the engine. Three ways are told apart:

- on the way: functions that take it as an argument,
- own: methods of the thing itself (it is `self`),
- inside: functions below those that open a raster, read a table of points, take a checksum, or adjust a model.

With -v every function is listed.
"""

from __future__ import annotations

import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

#: Functions that do one thing whole: what is called below them is part of it.
_WHOLE = {"open_dataset", "open_pixels", "read_table", "points_of", "sha256", "located", "fit"}
_WAYS = ("on the way", "own", "inside")


class Journey:
    """The functions that are handed a thing.

    Parameters
    ----------
    is_it : callable (value) -> bool
    within_engine : bool
        Count within the warp engine, not on the way to it.
    """

    def __init__(self, is_it: Callable[[Any], bool], *, within_engine: bool = False) -> None:
        self.is_it, self.within_engine = is_it, within_engine
        self.seen: dict[str, dict[tuple[str, str], int]] = {way: {} for way in _WAYS}

    def enter(self, frame: FrameType, name: tuple[str, str]) -> None:
        """Note a function that was just called, if it is handed the thing."""
        code = frame.f_code
        values = [frame.f_locals.get(one) for one in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]]
        found = [number for number, value in enumerate(values) if self.is_it(value)]
        if not found:
            return
        own = found == [0] and code.co_varnames[0] == "self"
        way = "inside" if _is_inside(frame) else "own" if own else "on the way"
        self.seen[way][name] = self.seen[way].get(name, 0) + 1

    def text(self, *, listed: bool) -> str:
        """Return the counts, and the functions if they are `listed`."""
        lines = []
        for way, functions in self.seen.items():
            files = {file for file, _ in functions}
            lines.append(f"  {way:<11}{len(functions):>4} functions in {len(files):>2} files")
            lines += [f"      {file}: {name}" for file, name in functions] if listed else []
        return "\n".join(lines)


def _is_inside(frame: FrameType) -> bool:
    caller = frame.f_back
    while caller is not None:
        if caller.f_code.co_name in _WHOLE:
            return True
        caller = caller.f_back
    return False


def follow(root: Path) -> dict[str, Journey]:
    """Rectify the sample scene of a checkout and return the journeys of its inputs."""
    sys.path.insert(0, str(root))
    from ortho_pipeline.commands.rectification import rectify
    from ortho_pipeline.models import SensorModel
    from ortho_pipeline.options import PointOptions, SurfaceOptions
    from ortho_pipeline.points import Points
    from ortho_pipeline.surface.base import Surface

    sample = root / "sample_data"
    dem, gcps = str(sample / "dem.tif"), str(sample / "gcps.geojson")

    def of(path: str, *kinds: type) -> Callable[[Any], bool]:
        return lambda value: isinstance(value, kinds) or (isinstance(value, str | Path) and str(value) == path)

    journeys = {
        "DEM": Journey(of(dem, SurfaceOptions, Surface)),
        "points": Journey(of(gcps, PointOptions, Points)),
        "model": Journey(of("", SensorModel), within_engine=True),
    }
    package = str(root / "ortho_pipeline") + "/"
    at = {"engine": False}

    def called(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(package) or code.co_name.startswith("<"):
            return
        file = code.co_filename.removeprefix(package)
        at["engine"] = at["engine"] or file == "warp/lattice_engine.py"
        for journey in journeys.values():
            if journey.within_engine == at["engine"] and (not journey.within_engine or file.startswith("warp/")):
                journey.enter(frame, (file, getattr(code, "co_qualname", code.co_name)))

    with tempfile.TemporaryDirectory() as folder:
        threading.setprofile(called)
        sys.setprofile(called)
        try:
            rectify(
                str(sample / "scene.tif"), folder, points=PointOptions(gcps=gcps), surface=SurfaceOptions(dem=dem)
            )  # fmt: skip
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    return journeys


def main() -> None:
    """Print the journeys."""
    words = [word for word in sys.argv[1:] if word != "-v"]
    root = Path(words[0]).resolve() if words else Path(__file__).resolve().parent.parent
    for name, journey in follow(root).items():
        print(name)
        print(journey.text(listed="-v" in sys.argv))


if __name__ == "__main__":
    main()
