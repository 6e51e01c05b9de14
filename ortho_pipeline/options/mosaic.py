"""Options of a mosaic."""

# Annotations are read from the class: as values, not as text.
from dataclasses import dataclass
from typing import Annotated

from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.options.option import Option, documented


@documented
@dataclass(frozen=True)
class MosaicOptions:
    """Options of one raster of all scenes."""

    format: Annotated[
        str, Option("--format -of", "A VRT refers to the orthos; a COG holds a copy.", choices=("VRT", "COG"))
    ] = "VRT"
    order: Annotated[
        str,
        Option(
            "--order",
            Text(
                "Which scene is on top: the one with the steepest view, the first, or at each pixel the most accurate "
                "(needs ",
                Setting("output.accuracy_raster"),
                " of each ortho).",
            ),
            choices=("best-view", "first-on-top", "most-accurate"),
        ),
    ] = "best-view"
    seams: Annotated[bool, Option("--seams", "Measure how well the scenes agree where they overlap.")] = True
    seamlines: Annotated[
        bool,
        Option(
            "--seamlines",
            "Move the seam lines to where the scenes differ least, by at most 256 pixels.",
        ),
    ] = False
    balance: Annotated[
        bool,
        Option(
            "--balance",
            "Balance the brightness where scenes overlap: one gain and offset for each scene and band.",
        ),
    ] = False
