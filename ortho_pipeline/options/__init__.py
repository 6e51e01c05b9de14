"""Options of a user, grouped as the pipeline takes them.

Each option is stated here, once: its field and default, and an `Option` from which the command line and the pipeline
file make their own options. Messages name an option by an `errors.texts.Setting`, as ``group.field``. That is its name
in Python and in the pipeline file; the command line shows the flag instead.

Imports nothing but `errors`. A new option is a field in `groups`, of a block in `block`, of a mosaic in
`mosaic`, of a stack in `stack`.
"""

from ortho_pipeline.options.block import BlockOptions
from ortho_pipeline.options.groups import (
    GROUPS,
    MatchOptions,
    PointOptions,
    PointTable,
    SceneOptions,
    SurfaceOptions,
)
from ortho_pipeline.options.mosaic import MosaicOptions
from ortho_pipeline.options.option import (
    CORRECTIONS,
    EXECUTORS,
    PIXEL_ORIGINS,
    PIXEL_TYPES,
    RESAMPLING,
    Kind,
    Option,
    PathLike,
    height_range,
    is_usable,
    number_of,
    numbers_of,
    options_of,
    pose_sigmas,
)
from ortho_pipeline.options.output import OutputOptions
from ortho_pipeline.options.stack import StackOptions

__all__ = [
    "CORRECTIONS",
    "EXECUTORS",
    "GROUPS",
    "PIXEL_ORIGINS",
    "PIXEL_TYPES",
    "RESAMPLING",
    "BlockOptions",
    "Kind",
    "MatchOptions",
    "MosaicOptions",
    "Option",
    "OutputOptions",
    "PathLike",
    "PointOptions",
    "PointTable",
    "SceneOptions",
    "StackOptions",
    "SurfaceOptions",
    "height_range",
    "is_usable",
    "number_of",
    "numbers_of",
    "options_of",
    "pose_sigmas",
]
