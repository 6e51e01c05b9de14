"""The configurations that CARS and s2p take, from a `BlockExport`.

=======  ================  ============================  ==================================================
program  models            pixel origin in them          paths are relative to
=======  ================  ============================  ==================================================
CARS     OTB keyword list  centre of first pixel (0, 0)  the configuration; outputs: the folder of the caller
s2p      RPC text          centre of first pixel (0, 0)  the configuration
=======  ================  ============================  ==================================================

Both compute heights above the WGS 84 ellipsoid.

Source: CARS 1.3 (`sensor_inputs`, `output_parameters`), s2p (`initialization`, `config`).
"""

from __future__ import annotations

import json
from typing import Any

from ortho_pipeline.plugin import BlockExport, InputError


def cars_text(block: BlockExport) -> str:
    """Return the configuration of CARS: heights above the ellipsoid, with a layer of their accuracy."""
    sensors: dict[str, Any] = {}
    for label, image in block.images.items():
        picture: dict[str, Any] = {"path": image.path}
        if image.nodata is not None and float(image.nodata).is_integer():
            picture["no_data"] = int(image.nodata)
        sensors[label] = {"image": picture, "geomodel": {"path": image.model, "model_type": "RPC"}}
    inputs: dict[str, Any] = {"sensors": sensors, "pairing": [[pair.first, pair.second] for pair in block.pairs]}
    if block.elevation is not None:
        # No geoid: the heights of this DEM are ellipsoidal.
        inputs["initial_elevation"] = {"dem": block.elevation, "geoid": None}
    output = {
        "directory": "cars",
        "epsg": int(block.crs.removeprefix("EPSG:")),
        "resolution": block.resolution,
        "geoid": False,
        # An empty list of classes: the accuracy itself, in metres.
        "auxiliary": {"performance_map": []},
    }
    return _json({"input": inputs, "output": output})


def s2p_text(block: BlockExport) -> str:
    """Return the configuration of s2p, which matches the first image with all others.

    Raises
    ------
    InputError
        If an image is no pair with the first.
    """
    first, *others = block.images
    partners = {
        label for pair in block.pairs for label in (pair.first, pair.second) if first in (pair.first, pair.second)
    }
    if strangers := [label for label in others if label not in partners]:
        raise InputError(
            f"s2p matches all images with the first one, but {first} and {strangers[0]} are no stereo pair",
            field="export",
            remedy=f"list another image first, or leave out {strangers[0]}",
        )
    document: dict[str, Any] = {
        "out_dir": "s2p",
        "images": [{"img": image.path, "rpc": image.model} for image in block.images.values()],
        "full_img": True,
        "dsm_resolution": block.resolution,
        "out_crs": block.crs.lower(),
        "disp_range_method": "sift",
    }
    if block.elevation is not None:
        document |= {
            "disp_range_method": "wider_sift_exogenous",
            "exogenous_dem": block.elevation,
            "exogenous_dem_geoid_mode": False,
        }
    return _json(document)


def _json(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=2) + "\n"
