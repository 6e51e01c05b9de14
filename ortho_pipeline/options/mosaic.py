"""Options of a mosaic."""

# Annotations are read from the class: as values, not as text.
from dataclasses import dataclass
from typing import Annotated

from ortho_pipeline.options.option import Option, documented


@documented
@dataclass(frozen=True)
class MosaicOptions:
    """One raster of all scenes."""

    format: Annotated[
        str, Option("--format -of", "A VRT refers to the orthos, a COG holds a copy.", choices=("VRT", "COG"))
    ] = "VRT"
    order: Annotated[
        str,
        Option(
            "--order",
            "What lies on top: the scene that looks down most steeply, or the first; or at each pixel "
            "the scene that is most accurate there, as their output.accuracy_raster says.",
            choices=("best-view", "first-on-top", "most-accurate"),
        ),
    ] = "best-view"
    seams: Annotated[bool, Option("--seams", "Measure how well the scenes agree where they overlap.")] = True
    seamlines: Annotated[
        bool,
        Option(
            "--seamlines",
            "Let the seams run where scenes differ least, up to 256 pixels from where the order has them.",
        ),
    ] = False
    balance: Annotated[
        bool,
        Option(
            "--balance",
            "Make the brightness of the scenes alike where they overlap: a gain and an offset of each scene and band.",
        ),
    ] = False
