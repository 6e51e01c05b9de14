"""The public names with their types; `__init__.py` loads each when it is first used."""

from ortho_pipeline.adjustment import adjust as adjust
from ortho_pipeline.block_points import BlockPoints as BlockPoints
from ortho_pipeline.block_points import read_block_points as read_block_points
from ortho_pipeline.comparison import compare as compare
from ortho_pipeline.crs import Vertical as Vertical
from ortho_pipeline.dem import Surface as Surface
from ortho_pipeline.ellipse import Ellipse as Ellipse
from ortho_pipeline.ellipse import fit_ellipse as fit_ellipse
from ortho_pipeline.errors import OrthoError as OrthoError
from ortho_pipeline.estimation import Fit as Fit
from ortho_pipeline.estimation import fit as fit
from ortho_pipeline.hookspecs import Scene as Scene
from ortho_pipeline.hookspecs import Sensor as Sensor
from ortho_pipeline.hookspecs import hookimpl as hookimpl
from ortho_pipeline.intersection import intersect as intersect
from ortho_pipeline.model_file import load_model as load_model
from ortho_pipeline.model_file import save_model as save_model
from ortho_pipeline.models import RPC as RPC
from ortho_pipeline.models import ImageCorrection as ImageCorrection
from ortho_pipeline.models import SensorModel as SensorModel
from ortho_pipeline.options import OutputOptions as OutputOptions
from ortho_pipeline.options import PointOptions as PointOptions
from ortho_pipeline.options import SceneOptions as SceneOptions
from ortho_pipeline.options import SurfaceOptions as SurfaceOptions
from ortho_pipeline.pipeline import rectify as rectify
from ortho_pipeline.plugins import open_scene as open_scene
from ortho_pipeline.points import Points as Points
from ortho_pipeline.points import read_points as read_points
from ortho_pipeline.points import write_points as write_points
from ortho_pipeline.problem import Prior as Prior
from ortho_pipeline.raster import Grid as Grid
from ortho_pipeline.raster import RasterSource as RasterSource
from ortho_pipeline.rpc import export_rpc as export_rpc
from ortho_pipeline.rpc import read_rpc as read_rpc
from ortho_pipeline.rpc import write_rpc_txt as write_rpc_txt

__all__: list[str]
__version__: str
