"""Everything that a plugin needs: its author imports only from this module.

It has the hooks and their types, errors and messages, files, the ellipsoid, sensor models, points, fits, and parts of
commands. docs/plugins.md shows how to write a plugin; `ortho_pipeline.hookspecs` documents the hooks.
docs/plugin-reference.md explains fields, and states how long names stay stable; `make docs` lists the names.

Each name is loaded on first use: ``from ortho_pipeline.plugin import Subcommand, hookimpl`` loads neither NumPy nor
GDAL.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ortho_pipeline.runtime.lazy_names import lazily

if TYPE_CHECKING:
    from ortho_pipeline.cli.machine.terminal import say as say
    from ortho_pipeline.cli.options import folder_option as folder_option
    from ortho_pipeline.cli.options import image_argument as image_argument
    from ortho_pipeline.cli.options import images_argument as images_argument
    from ortho_pipeline.cli.options import json_option as json_option
    from ortho_pipeline.cli.options import match_options as match_options
    from ortho_pipeline.cli.options import output_options as output_options
    from ortho_pipeline.cli.options import point_options as point_options
    from ortho_pipeline.cli.options import scene_options as scene_options
    from ortho_pipeline.cli.options import surface_options as surface_options
    from ortho_pipeline.cli.parsing import Command as Command
    from ortho_pipeline.cli.parsing import Group as Group
    from ortho_pipeline.cli.printing import print_json as print_json
    from ortho_pipeline.cli.printing import print_warnings as print_warnings
    from ortho_pipeline.display.notices import Notice as Notice
    from ortho_pipeline.errors import CrsError as CrsError
    from ortho_pipeline.errors import DatumError as DatumError
    from ortho_pipeline.errors import InputError as InputError
    from ortho_pipeline.errors import ModelError as ModelError
    from ortho_pipeline.errors import OrthoError as OrthoError
    from ortho_pipeline.errors import PluginError as PluginError
    from ortho_pipeline.errors import reads as reads
    from ortho_pipeline.errors.texts import Setting as Setting
    from ortho_pipeline.errors.texts import Text as Text
    from ortho_pipeline.errors.texts import counted as counted
    from ortho_pipeline.estimation.family_fit import fit_family as fit_family
    from ortho_pipeline.estimation.fit import Fit as Fit
    from ortho_pipeline.estimation.fit import fit as fit
    from ortho_pipeline.estimation.observations.prior import Prior as Prior
    from ortho_pipeline.estimation.observations.prior import priors_at as priors_at
    from ortho_pipeline.estimation.spatial.correlation import analyse_fit as analyse_fit
    from ortho_pipeline.exchange.block_export import BlockExport as BlockExport
    from ortho_pipeline.exchange.export import Export as Export
    from ortho_pipeline.exchange.rpc import export_rpc as export_rpc
    from ortho_pipeline.exchange.rpc import has_rpc as has_rpc
    from ortho_pipeline.exchange.rpc import read_rpc as read_rpc
    from ortho_pipeline.exchange.rpc import require_same_rpc as require_same_rpc
    from ortho_pipeline.exchange.rpc import rpc_of_dataset as rpc_of_dataset
    from ortho_pipeline.exchange.rpc import write_rpc_txt as write_rpc_txt
    from ortho_pipeline.exchange.rpc_files import read_rpc_text as read_rpc_text
    from ortho_pipeline.exchange.rpc_files import rpc_of_fields as rpc_of_fields
    from ortho_pipeline.files import decoded as decoded
    from ortho_pipeline.files import parse_json as parse_json
    from ortho_pipeline.files import read_bounded as read_bounded
    from ortho_pipeline.files import read_json as read_json
    from ortho_pipeline.files import write_text as write_text
    from ortho_pipeline.files.folders import Listing as Listing
    from ortho_pipeline.files.folders import listing as listing
    from ortho_pipeline.files.locations import place as place
    from ortho_pipeline.files.xml_fields import XmlFields as XmlFields
    from ortho_pipeline.files.xml_fields import parse_xml as parse_xml
    from ortho_pipeline.geodesy.crs import Vertical as Vertical
    from ortho_pipeline.geodesy.crs import ground_transform as ground_transform
    from ortho_pipeline.geodesy.crs import parse_crs as parse_crs
    from ortho_pipeline.geodesy.crs import same_crs as same_crs
    from ortho_pipeline.geodesy.declared_vertical import declared_vertical as declared_vertical
    from ortho_pipeline.geodesy.ellipsoid import ECCENTRICITY_SQUARED as ECCENTRICITY_SQUARED
    from ortho_pipeline.geodesy.ellipsoid import SEMI_MAJOR as SEMI_MAJOR
    from ortho_pipeline.geodesy.ellipsoid import angles_of_rotation as angles_of_rotation
    from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef as enu_from_ecef
    from ortho_pipeline.geodesy.ellipsoid import geocentric as geocentric
    from ortho_pipeline.geodesy.ellipsoid import geodetic as geodetic
    from ortho_pipeline.geodesy.ellipsoid import orbital_from_ecef as orbital_from_ecef
    from ortho_pipeline.hookspecs import BlockFormat as BlockFormat
    from ortho_pipeline.hookspecs import Format as Format
    from ortho_pipeline.hookspecs import Piece as Piece
    from ortho_pipeline.hookspecs import Scene as Scene
    from ortho_pipeline.hookspecs import Sensor as Sensor
    from ortho_pipeline.hookspecs import Subcommand as Subcommand
    from ortho_pipeline.hookspecs import hookimpl as hookimpl
    from ortho_pipeline.host import open_scene as open_scene
    from ortho_pipeline.models import RPC as RPC
    from ortho_pipeline.models import ImageCorrection as ImageCorrection
    from ortho_pipeline.models import MapPlane as MapPlane
    from ortho_pipeline.models import Rational as Rational
    from ortho_pipeline.models import SensorModel as SensorModel
    from ortho_pipeline.models import require_view as require_view
    from ortho_pipeline.models.base import KINDS as KINDS
    from ortho_pipeline.models.base import Array as Array
    from ortho_pipeline.models.base import ground_of_grid as ground_of_grid
    from ortho_pipeline.models.frame.camera import LOOKS_PAST as LOOKS_PAST
    from ortho_pipeline.models.frame.camera import FrameCamera as FrameCamera
    from ortho_pipeline.models.frame.orientation import camera_from_platform as camera_from_platform
    from ortho_pipeline.models.frame.orientation import exterior_sigmas as exterior_sigmas
    from ortho_pipeline.models.frame.orientation import geocentric_of_map as geocentric_of_map
    from ortho_pipeline.models.frame.orientation import heights_below as heights_below
    from ortho_pipeline.models.frame.working_frame import GEOGRAPHIC as GEOGRAPHIC
    from ortho_pipeline.models.frame.working_frame import TOPOCENTRIC as TOPOCENTRIC
    from ortho_pipeline.models.lens import Interior as Interior
    from ortho_pipeline.models.light import LightPath as LightPath
    from ortho_pipeline.models.mosaicked import relative_scale as relative_scale
    from ortho_pipeline.models.pushbroom.line_camera import LineCamera as LineCamera
    from ortho_pipeline.models.pushbroom.metadata import SoftSigmas as SoftSigmas
    from ortho_pipeline.models.pushbroom.metadata import pushbroom_of_metadata as pushbroom_of_metadata
    from ortho_pipeline.models.pushbroom.rotations import are_rotations as are_rotations
    from ortho_pipeline.models.pushbroom.rotations import rotations as rotations
    from ortho_pipeline.models.pushbroom.scanner import Pushbroom as Pushbroom
    from ortho_pipeline.models.pushbroom.splines import SplineForm as SplineForm
    from ortho_pipeline.models.pushbroom.tables import lagrange as lagrange
    from ortho_pipeline.models.pushbroom.tables import pushbroom_of_tables as pushbroom_of_tables
    from ortho_pipeline.models.pushbroom.tables import rotations_of_angles as rotations_of_angles
    from ortho_pipeline.models.pushbroom.tables import rotations_of_quaternions as rotations_of_quaternions
    from ortho_pipeline.options import MatchOptions as MatchOptions
    from ortho_pipeline.options import OutputOptions as OutputOptions
    from ortho_pipeline.options import PointOptions as PointOptions
    from ortho_pipeline.options import SceneOptions as SceneOptions
    from ortho_pipeline.options import SurfaceOptions as SurfaceOptions
    from ortho_pipeline.options import height_range as height_range
    from ortho_pipeline.options import is_usable as is_usable
    from ortho_pipeline.options import number_of as number_of
    from ortho_pipeline.options import numbers_of as numbers_of
    from ortho_pipeline.options import pose_sigmas as pose_sigmas
    from ortho_pipeline.points import Points as Points
    from ortho_pipeline.points import read_points as read_points
    from ortho_pipeline.points import write_points as write_points
    from ortho_pipeline.raster.source import open_dataset as open_dataset
    from ortho_pipeline.surface.base import Surface as Surface

_NAMES = {
    "cli.machine.terminal": ("say",),
    "cli.options": (
        "folder_option",
        "image_argument",
        "images_argument",
        "json_option",
        "match_options",
        "output_options",
        "point_options",
        "scene_options",
        "surface_options",
    ),
    "cli.parsing": (
        "Command",
        "Group",
    ),
    "cli.printing": (
        "print_json",
        "print_warnings",
    ),
    "display.notices": ("Notice",),
    "errors": (
        "CrsError",
        "DatumError",
        "InputError",
        "ModelError",
        "OrthoError",
        "PluginError",
        "reads",
    ),
    "estimation.family_fit": ("fit_family",),
    "estimation.fit": (
        "Fit",
        "fit",
    ),
    "estimation.observations.prior": (
        "Prior",
        "priors_at",
    ),
    "estimation.spatial.correlation": ("analyse_fit",),
    "exchange.block_export": ("BlockExport",),
    "exchange.export": ("Export",),
    "exchange.rpc": (
        "export_rpc",
        "has_rpc",
        "read_rpc",
        "require_same_rpc",
        "rpc_of_dataset",
        "write_rpc_txt",
    ),
    "exchange.rpc_files": (
        "read_rpc_text",
        "rpc_of_fields",
    ),
    "files": (
        "decoded",
        "parse_json",
        "read_bounded",
        "read_json",
        "write_text",
    ),
    "files.folders": (
        "Listing",
        "listing",
    ),
    "files.locations": ("place",),
    "files.xml_fields": (
        "XmlFields",
        "parse_xml",
    ),
    "geodesy.crs": (
        "Vertical",
        "ground_transform",
        "parse_crs",
        "same_crs",
    ),
    "geodesy.declared_vertical": ("declared_vertical",),
    "geodesy.ellipsoid": (
        "ECCENTRICITY_SQUARED",
        "SEMI_MAJOR",
        "angles_of_rotation",
        "enu_from_ecef",
        "geocentric",
        "geodetic",
        "orbital_from_ecef",
    ),
    "hookspecs": (
        "BlockFormat",
        "Format",
        "Piece",
        "Scene",
        "Sensor",
        "Subcommand",
        "hookimpl",
    ),
    "models": (
        "RPC",
        "ImageCorrection",
        "MapPlane",
        "Rational",
        "SensorModel",
        "require_view",
    ),
    "models.base": (
        "KINDS",
        "Array",
        "ground_of_grid",
    ),
    "models.frame.camera": (
        "LOOKS_PAST",
        "FrameCamera",
    ),
    "models.frame.orientation": (
        "camera_from_platform",
        "exterior_sigmas",
        "geocentric_of_map",
        "heights_below",
    ),
    "models.frame.working_frame": (
        "GEOGRAPHIC",
        "TOPOCENTRIC",
    ),
    "models.lens": ("Interior",),
    "models.light": ("LightPath",),
    "models.mosaicked": ("relative_scale",),
    "models.pushbroom.line_camera": ("LineCamera",),
    "models.pushbroom.metadata": (
        "SoftSigmas",
        "pushbroom_of_metadata",
    ),
    "models.pushbroom.rotations": (
        "are_rotations",
        "rotations",
    ),
    "models.pushbroom.scanner": ("Pushbroom",),
    "models.pushbroom.splines": ("SplineForm",),
    "models.pushbroom.tables": (
        "lagrange",
        "pushbroom_of_tables",
        "rotations_of_angles",
        "rotations_of_quaternions",
    ),
    "options": (
        "MatchOptions",
        "OutputOptions",
        "PointOptions",
        "SceneOptions",
        "SurfaceOptions",
        "height_range",
        "is_usable",
        "number_of",
        "numbers_of",
        "pose_sigmas",
    ),
    "errors.texts": (
        "Setting",
        "Text",
        "counted",
    ),
    "host": ("open_scene",),
    "points": (
        "Points",
        "read_points",
        "write_points",
    ),
    "raster.source": ("open_dataset",),
    "surface.base": ("Surface",),
}
#: Name -> module that holds it.
_HOMES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = sorted(_HOMES)  # noqa: PLE0605

if not TYPE_CHECKING:  # a checker knows the names from above, and no others
    __getattr__ = lazily(__name__, _HOMES)
