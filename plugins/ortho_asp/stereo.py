"""The commands with which Ames Stereo Pipeline computes a DSM from a block: a script that changes to its folder.

Models are CSM states (centre of the first pixel (0.5, 0.5)) or RPCs as DigitalGlobe's XML (centre (0, 0)). Heights are
above the WGS 84 ellipsoid.

Source: ASP 3.7 (`parallel_stereo`, `mapproject`, `point2dem`, `dem_mosaic`, its `RPC_XML`).
"""

from __future__ import annotations

import shlex

from ortho_pipeline.plugin import BlockExport, InputError

#: The session of ASP for each format of models.
_SESSIONS = {"csm": "csm", "rpc-xml": "rpc"}


def asp_text(block: BlockExport) -> str:
    """Return the commands of ASP: a DSM of each pair, with standard deviations, and the mean of several.

    Raises
    ------
    InputError
        For images of several bands.
    """
    for label, image in block.images.items():
        if image.bands != 1:
            raise InputError(
                f"Ames Stereo Pipeline takes images of one band, but {label} has {image.bands}",
                field="export",
                remedy="adjust images of one band, such as the panchromatic ones",
            )
    session = f"-t {_SESSIONS[block.models]}"
    crs, step = block.crs, f"{block.resolution:g}"
    lines = ["#!/bin/sh", "# Heights are above the WGS 84 ellipsoid.", "set -e", 'cd "$(dirname "$0")"']
    pictures = {label: image.path for label, image in block.images.items()}
    if block.elevation is not None:
        dem = shlex.quote(block.elevation)
        for label, image in block.images.items():
            pictures[label] = f"asp/{label}_map.tif"
            names = _quoted(image.path, image.model, pictures[label])
            lines.append(f"mapproject {session} --t_srs {crs} --tr {step} {dem} {names}")
    surfaces = []
    for pair in block.pairs:
        prefix = f"asp/{pair.first}-{pair.second}/run"
        both = [block.images[label] for label in (pair.first, pair.second)]
        names = _quoted(pictures[pair.first], pictures[pair.second], *(image.model for image in both), prefix)
        ends = names if block.elevation is None else f"{names} {shlex.quote(block.elevation)}"
        lines.append(f"parallel_stereo {session} --stereo-algorithm asp_mgm --subpixel-mode 9 {ends}")
        cloud = shlex.quote(f"{prefix}-PC.tif")
        lines.append(f"point2dem --t_srs {crs} --tr {step} --errorimage {cloud}")
        surfaces.append(f"{prefix}-DEM.tif")
    if len(surfaces) > 1:
        lines.append(f"dem_mosaic --median {_quoted(*surfaces)} -o asp/dsm.tif")
    return "\n".join(lines) + "\n"


def _quoted(*names: str) -> str:
    # A name that begins with a dash would be an option.
    return " ".join(shlex.quote(f"./{name}" if name.startswith("-") else name) for name in names)
