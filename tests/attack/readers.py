"""Every reader of files of strangers: a valid file, how it is read, and what of the result has to be finite."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import products
import seeds
import state
from ortho_asp.cameras import read_adjust, read_aster, read_tsai
from ortho_bilsat.survey import read_survey
from ortho_cartosat.metadata import read_metadata as read_cartosat
from ortho_csm.files import csm_text, read_csm
from ortho_enmap import read_enmap
from ortho_ikonos.metadata import read_header, read_metadata
from ortho_maxar.isd import Isd, read_isd_pushbroom
from ortho_orbview3.product import read_product
from ortho_planet import read_item
from ortho_rpc.dimap import read_dimap_pushbroom
from ortho_sar import read_extended
from ortho_spot.dimap import read_spot
from osgeo import gdal
from photos import DJI, packet, photo

from ortho_pipeline import commands
from ortho_pipeline.batch import plan as batch_plan
from ortho_pipeline.batch.records import FileState, RunRecord
from ortho_pipeline.batch.stack.dates import read_list
from ortho_pipeline.batch.stack.matching import read_matches
from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.errors import CrsError
from ortho_pipeline.exchange.model_file import read_model_file, save_model
from ortho_pipeline.exchange.rpc import rpc_of_dataset
from ortho_pipeline.exchange.rpc_files import read_rpc_text, write_rpb, write_rpc_txt
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.imaging.matching import open_references
from ortho_pipeline.models import ImageCorrection, SensorModel
from ortho_pipeline.options import PointOptions, SceneOptions
from ortho_pipeline.points import read_points
from ortho_pipeline.raster.source import RasterSource, open_dataset
from ortho_pipeline.report import document as report
from ortho_pipeline.report.stac import acquisition_time
from ortho_pipeline.stores.stac.collection import Collection
from ortho_pipeline.stores.stac.item import read_item as read_stac_item
from ortho_pipeline.surface.dem import open_dem


@dataclass(frozen=True)
class Reader:
    """One reader.

    Parameters
    ----------
    kind : str
        A key of `mutate.KINDS`.
    file : str
        Name that the file has to have.
    seed : callable(folder) -> bytes
        Makes a valid file; may put others next to it into the folder.
    read : callable(path) -> any
        Reads it and returns all that has to be finite (`numbers`).
    unknown : bool
        Whether NaN may stand for what the file does not say (heights of points, voids).
    """

    name: str
    kind: str
    file: str
    seed: Callable[[Path], bytes]
    read: Callable[[Path], Any]
    unknown: bool = False
    of_files: bool = True


def numbers(value: Any) -> Iterable[float]:
    """Yield every number that a result holds."""
    if isinstance(value, SensorModel):
        yield from numbers(value.to_dict())
        yield from numbers(value.domain)
        if not getattr(value, "sees_ground", True):
            # Start values of an adjustment; the scene has a warning.
            return
        centre, half = value.domain
        parts = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 3), axis=-1).reshape(-1, 3)
        image = value.ground_to_image(centre + parts * half)
        # NaN is a point outside of the image; a model that sees none is damaged.
        yield from image[np.isfinite(image).all(axis=1)][:1].ravel().tolist() or [math.nan]
        yield from image[np.isinf(image)].tolist()
    elif isinstance(value, np.ndarray):
        yield from value.ravel().tolist() if value.dtype.kind == "f" else ()
    elif isinstance(value, bool | str | bytes | None):
        return
    elif isinstance(value, int | float):
        yield float(value)
    elif isinstance(value, Mapping):
        for one in value.values():
            yield from numbers(one)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from numbers(getattr(value, field.name))
    elif isinstance(value, Iterable):
        for one in value:
            yield from numbers(one)


# -- how each is read ------------------------------------------------------------------------------------------------


def _sample(*parts: str) -> Callable[[Path], bytes]:
    return lambda folder: seeds.SAMPLE.joinpath(*parts).read_bytes()


def _text(text: str) -> Callable[[Path], bytes]:
    return lambda folder: text.encode()


def _written(write: Callable[[Path], Any]) -> Callable[[Path], bytes]:
    def seed(folder: Path) -> bytes:
        path = folder / "seed"
        write(path)
        data = path.read_bytes()
        path.unlink()
        return data

    return seed


def _points(crs: str | None = None, vertical: str | None = None) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        points = read_points(path, crs=crs, vertical=vertical, image_name="one.tif")
        return [points.image, points.ground, points.sigma_image, points.sigma_ground, points.covariance_image]

    return read


def _block(path: Path) -> Any:
    points = read_block_points(path)
    return [getattr(points, field.name) for field in dataclasses.fields(points)]


def _tagged(path: Path) -> Any:
    return rpc_of_dataset(open_dataset(path))[0]


def _image(path: Path) -> Any:
    dataset = open_dataset(path)
    source = RasterSource(path)
    window = source.read(0, 0, min(64, dataset.RasterXSize), min(64, dataset.RasterYSize))
    return [0.0, float(window.size)]


def _reference(path: Path) -> Any:
    (reference,) = open_references([path])
    intensity = reference.intensity
    part = intensity.read(0, 0, min(intensity.width, 40), min(intensity.height, 40), 1)
    return [reference.pixel_from_map, reference.corners, part[np.isfinite(part)]]


def _scene(**options: Any) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        given = {key: str(path) if value is None else value for key, value in options.items()}
        scene = open_scene(path.parent / "one.tif", SceneOptions(**given))
        return [*scene.models.values(), scene.facts]

    return read


def _frame(camera: str, exterior: str, **more: str) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        files = {"camera": str(path.with_name(camera)), "exterior": str(path.with_name(exterior))}
        scene = open_scene(
            path.with_name("one.tif"),
            SceneOptions(sensor="frame", sensor_options={**files, "vertical": "ellipsoid", **more}),
        )
        return [*scene.models.values(), scene.facts]

    return read


def _photo(path: Path) -> Any:
    # An empty packet cannot be written into a file; blanks are as empty for whoever reads them.
    xmp = path.read_bytes().decode("utf-8", "replace").replace("\0", "") or " "
    scene = open_scene(photo(path.with_name("one.tif"), xmp=xmp), SceneOptions(sensor="photo"))
    return [*scene.models.values(), scene.facts, scene.priors]


def _frame_seed(text: str) -> Callable[[Path], bytes]:
    def seed(folder: Path) -> bytes:
        seeds.image(folder / "one.tif", tag=False)
        (folder / "camera.json").write_text(seeds.CAMERA)
        (folder / "exterior.csv").write_text(seeds.FRAME_TABLE)
        return text.encode()

    return seed


def _beside(image: str, *source: str) -> Callable[[Path], bytes]:
    """Return a seed that lies next to the image of a sample product, whose other files are there too."""

    def seed(folder: Path) -> bytes:
        product = seeds.SAMPLE / source[0]
        for path in product.iterdir():
            if path.name.startswith(image.rpartition(".")[0][:12]) or path.suffix == ".tif":
                shutil.copy(path, folder / path.name)
        return seeds.SAMPLE.joinpath(*source).read_bytes()

    return seed


def _product(image: str) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        scene = open_scene(path.with_name(image))
        return [*scene.models.values(), scene.facts]

    return read


def _survey(path: Path) -> Any:
    scene = open_scene(
        path.with_name("bilsat.tif"), SceneOptions(sensor="bilsat", sensor_options={"survey": str(path)})
    )
    return [read_survey(path), *scene.models.values(), scene.facts]


def _dem(path: Path) -> Any:
    surface = open_dem(path, "ellipsoid")
    rows, columns = surface.shape
    part = surface.window(0, 0, min(columns, 40), min(rows, 40))
    return [part[np.isfinite(part)], np.isinf(part).any() * math.inf if np.isinf(part).any() else 0.0]


_COUNT = itertools.count()


def _grid(path: Path) -> Any:
    # A grid is read once under its name.
    again = path.with_name(f"{next(_COUNT)}{path.suffix}")
    again.hardlink_to(path)
    try:
        found = Vertical.parse(str(again)).undulation(np.array([33.0, 34.5]), np.array([36.0, 37.5]))
    finally:
        again.unlink()
    return np.where(np.isnan(found), 0.0, found)


def _system(path: Path) -> Any:
    crs = parse_crs(path.read_bytes().decode("utf-8", "replace"))
    found = ground_transform(crs, "EPSG:4979")(np.array([[500000.0, 4100000.0, 100.0]]))
    return np.where(np.isnan(found), 0.0, found)


def _model(path: Path) -> Any:
    return read_model_file(path).model


def _report_seed(folder: Path) -> bytes:
    fitted = commands.fit(seeds.SAMPLE / "scene.tif", PointOptions(gcps=seeds.SAMPLE / "gcps.geojson", check="every:4"))
    return json.dumps(json_value(report.build_report(scene=fitted.scene, fit=fitted.fit))).encode()


def _report(path: Path) -> Any:
    commands.write_plots(path, path.with_name("plots"))
    return []


def _yaml_seed(folder: Path) -> bytes:
    for name in ("one.tif", "two.tif", "dem.tif"):
        (folder / name).write_bytes(b"")
    deep = folder / "a" / "b" / "c"
    deep.mkdir(parents=True, exist_ok=True)
    (deep / "three.tif").write_bytes(b"")
    return seeds.PIPELINE.encode()


def _yaml(path: Path) -> Any:
    planned = batch_plan.plan(path)
    return [job.configuration for job in planned.jobs]


def _record_seed(folder: Path) -> bytes:
    state = FileState.of("ortho", seeds.SAMPLE / "gcps.csv", name="gcps.csv")
    facts = {"rmse_px": {"control": 0.5}, "lean_m_per_m": 0.1}
    record = RunRecord(
        name="one", key="0" * 64, status="done", inputs=(state,), outputs=(state,), siblings="0" * 64, seconds=1.5,
        facts=facts, run="run",
    )  # fmt: skip
    record.write(folder / "record.json")
    return (folder / "record.json").read_bytes()


def _record(path: Path) -> Any:
    record = RunRecord.at(path)
    if record is None:
        return []
    # What `ortho run` does with it.
    record.intact(path.parent)
    [one.untouched() for one in record.inputs]
    sorted((one.role, one.path, one.sha256) for one in record.inputs)
    {(one.path, one.bytes, one.mtime_ns): one.sha256 for one in (*record.inputs, *record.outputs)}
    record.write(path.with_name("again.json"))
    return [record.seconds, record.facts, record.key == "", record.status in ("done",), {record.run, record.name}]


def _time(path: Path) -> Any:
    acquisition_time({"acquired": path.read_bytes().decode("utf-8", "replace")})
    return []


def _correction(folder: Path) -> bytes:
    coefficients = np.array([3.0, 1e-5, 0.0, -2.0, 0.0, 1e-5])
    save_model(ImageCorrection(seeds.rpc(), "affine", (20.0, 15.0), coefficients), folder / "m")
    return (folder / "m").read_bytes()


def _pushbroom(folder: Path) -> bytes:
    (folder / "DIM.XML").write_text(seeds.dimap_text())
    save_model(read_dimap_pushbroom(folder / "DIM.XML"), folder / "m")
    return (folder / "m").read_bytes()


def _frame_model(folder: Path) -> bytes:
    _frame_seed("")(folder)
    model = _frame("camera.json", "exterior.csv", crs="EPSG:32636")(folder / "exterior.csv")[0]
    save_model(model, folder / "m")
    return (folder / "m").read_bytes()


def _bundle_seed(folder: Path) -> bytes:
    """Write the panchromatic image of a bundle, whose pieces the metadata of the colours next to it give."""
    pan, colours = "IMG_PHR1A_P_1_R1C1.TIF", "IMG_PHR1A_MS_1_R1C1.TIF"
    for name, size in ((pan, (40, 32)), (colours, (10, 8))):
        dataset = gdal.GetDriverByName("GTiff").Create(str(folder / name), *size)
        dataset.GetRasterBand(1).Fill(1)
        dataset = None
    (folder / "DIM_PHR1A_P_1.XML").write_text(products.bundle_text("P", (40, 32)))
    (folder / "RPC_X_MS.XML").write_text(seeds.rpc_xml(seeds.rpc().scaled(4.0)))
    write_rpc_txt(seeds.rpc(), folder / f"{Path(pan).stem}_RPC.TXT")
    return products.bundle_text("MS", (10, 8)).encode()


def _bundle(path: Path) -> Any:
    scene = open_scene(path.with_name("IMG_PHR1A_P_1_R1C1.TIF"))
    return [*scene.models.values(), scene.facts, *((piece.scale, piece.model) for piece in scene.pieces)]


def _geolocation_seed(folder: Path) -> bytes:
    seeds.image(folder / "one.tif", tag=False)
    return products.geolocation_text(folder).encode()


def _opened(path: Path) -> Any:
    scene = open_scene(path, SceneOptions(sensor="geolocation"))
    return [*scene.models.values(), scene.facts]


def _tsai(path: Path) -> Any:
    return read_tsai(path, seeds.SIZE)


def _stac_item(path: Path) -> Any:
    item = read_stac_item(path)
    found = [asset.is_table or asset.is_rpc for asset in item.assets]
    return [str(item.rpc_of(item.image())), found, item.id]


def _stac_collection(path: Path) -> Any:
    collection = Collection(path)
    return [[asset.name for item in collection.items((0.0, 0.0, 1.0, 1.0), "S") for asset in item.assets]]


def _stac_heights(path: Path) -> Any:
    items, _ = Collection(path).under([(0.5, 0.5, 1.5, 0.6)])
    systems = [_name_of_system(text) for item in items for text in item.heights().systems]
    return [[(item.id, item.date, item.boxes, item.heights().name) for item in items], systems]


def _name_of_system(text: str) -> str:
    try:
        return parse_crs(text).name
    except CrsError:
        return ""


def _csm_seed(folder: Path) -> bytes:
    (folder / "METADATA.DIM").write_text(products.spot_text())
    return csm_text(read_spot(folder / "METADATA.DIM", heights=(0.0, 300.0)).model)[0].encode()


def _csm_frame_seed(folder: Path) -> bytes:
    (folder / "one.tsai").write_text(products.tsai_text())
    return csm_text(_tsai(folder / "one.tsai").with_heights(0.0, 300.0))[0].encode()


def _enmap_seed(folder: Path) -> bytes:
    return products.enmap_text(seeds.SIZE, (seeds.rpc(),) * 5).encode()


def _enmap(path: Path) -> Any:
    rpcs, facts = read_enmap(path)
    return [*rpcs, facts]


def _maxar_seed(folder: Path) -> bytes:
    tiles = (("A-P1BS_R1C1-1_P001.TIF", 0, 0, 40, 50), ("A-P1BS_R1C2-1_P001.TIF", 40, 0, 20, 50))
    return products.isd_text(tiles=tiles, rpc=seeds.rpc()).encode()


def _maxar(path: Path) -> Any:
    isd = Isd(path)
    return [isd.size, isd.rpc, isd.facts, [vars(tile) for tile in isd.tiles], read_isd_pushbroom(isd)]


def _spot(path: Path) -> Any:
    found = read_spot(path)
    return [found.model, found.facts, found.bands_differ]


def _cartosat(path: Path) -> Any:
    metadata = read_cartosat(path)
    return [metadata.view and 0.0, metadata.size, metadata.altitude, metadata.corners, *_product("BANDA.tif")(path)]


def _ikonos_header(folder: Path) -> bytes:
    text = (seeds.SAMPLE / "ikonos" / "po_39001_metadata.txt").read_text()
    return text[text.index("Component ID") :].encode()


def _with_image(text: Callable[[Path], str | bytes]) -> Callable[[Path], bytes]:
    def seed(folder: Path) -> bytes:
        seeds.image(folder / "one.tif", tag=False)
        found = text(folder)
        return found.encode() if isinstance(found, str) else found

    return seed


def _tiff(write: Callable[[Path], Path]) -> Callable[[Path], bytes]:
    return lambda folder: write(folder / "seed.tif").read_bytes()


_WKT = 'PROJCS["a",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],' \
    'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],' \
    'PARAMETER["central_meridian",33],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],' \
    'PARAMETER["false_northing",0],UNIT["metre",1]]'  # fmt: skip
_PO = "po_39001_metadata.txt"
_GRIDS = "+proj=longlat +ellps=bessel +nadgrids=@missing.gsb,null +geoidgrids=egm96_15.gtx +vunits=m +type=crs"
_UTM = "+proj=utm +zone=36 +datum=WGS84 +units=m +no_defs"
_ORB = f"{seeds.ORBVIEW3}.pvl"

READERS = (
    Reader("rpc-text", "text", "one_RPC.TXT", _sample("scene_RPC.TXT"), read_rpc_text),
    Reader("rpb", "text", "one.RPB", _written(lambda path: write_rpb(seeds.rpc(), path)), read_rpc_text),
    Reader("dimap-rpc", "xml", "RPC_X.XML", lambda folder: seeds.rpc_xml(seeds.rpc()).encode(), read_rpc_text),
    Reader("otb-geom", "text", "one.geom", lambda folder: seeds.rpc_geom(seeds.rpc()).encode(), read_rpc_text),
    Reader("rpc-option", "text", "given.txt", _with_image(_sample("scene_RPC.TXT")), _scene(rpc=None)),
    Reader("rpc-tag", "tiff", "one.tif", _tiff(seeds.image), _tagged),
    Reader("dimap-polynomials", "xml", "DIM_X.XML", _text(seeds.dimap_text()), read_dimap_pushbroom),
    Reader("dimap-lists", "xml", "DIM_X.XML", _text(seeds.dimap_text(listed=True)), read_dimap_pushbroom),
    Reader("dimap-bundle", "xml", "DIM_X_MS.XML", _bundle_seed, _bundle),
    Reader("geolocation", "xml", "one.vrt", _geolocation_seed, _opened),
    Reader("csm-line-scanner", "json", "one.json", _csm_seed, read_csm),
    Reader("csm-frame", "json", "one.json", _csm_frame_seed, read_csm),
    Reader("asp-pinhole", "text", "one.tsai", _text(products.tsai_text()), _tsai),
    Reader("asp-adjust", "text", "one.adjust", _text("0.3 -0.5 0.02\n1.0 -5e-7 -4e-7 -9e-6\n"), read_adjust),
    Reader("asp-aster", "xml", "one.xml", _text(products.aster_text()), read_aster),
    Reader("enmap-metadata", "xml", "one-METADATA.XML", _enmap_seed, _enmap),
    Reader("stac-item", "json", "one.json", _text(products.STAC_ITEM), _stac_item),
    Reader("stac-collection", "json", "one.json", _text(products.STAC_COLLECTION), _stac_collection),
    Reader("stac-heights", "json", "one.json", _text(products.STAC_HEIGHTS), _stac_heights),
    Reader("planet-item", "json", "one_metadata.json", _text(products.PLANET), read_item),
    Reader("sar-extended", "json", "one_extended.json", _text(products.capella_text()), read_extended),
    Reader("maxar-isd", "xml", "one.XML", _maxar_seed, _maxar),
    Reader("spot-metadata", "xml", "METADATA.DIM", _text(products.spot_text()), _spot),
    Reader("spot-detectors", "xml", "METADATA.DIM", _text(products.spot_text(every=True, corrected=True)), _spot),
    Reader("ikonos-metadata", "text", _PO, _sample("ikonos", _PO), read_metadata),
    Reader("ikonos-header", "text", "po_39001_hdr.txt", _ikonos_header, read_header),
    Reader("orbview3-label", "text", _ORB, _sample("orbview3", _ORB), read_product),
    Reader("cartosat-met", "text", "BANDA_MET.TXT", _beside("BANDA.tif", "cartosat", "BANDA_MET.TXT"), _cartosat),
    Reader("bilsat-survey", "text", "bilsat_survey.txt", _beside("bilsat.tif", "bilsat", "bilsat_survey.txt"), _survey),
    Reader(
        "frame-table", "text", "exterior.csv", _frame_seed(seeds.FRAME_TABLE),
        _frame("camera.json", "exterior.csv", crs="EPSG:32636"),
    ),
    Reader(
        "frame-camera", "json", "camera.json", _frame_seed(seeds.CAMERA),
        _frame("camera.json", "exterior.csv", crs="EPSG:32636"),
    ),
    Reader("opensfm", "json", "reconstruction.json", _frame_seed(seeds.OPENSFM),
           _frame("reconstruction.json", "reconstruction.json")),
    Reader("photo-xmp", "xml", "xmp.xml", _text(packet(DJI).partition("?>\n")[2]), _photo, of_files=False),
    Reader("points-csv", "text", "p.csv", _sample("gcps.csv"), _points(), unknown=True),
    Reader("points-geojson", "json", "p.geojson", _sample("gcps.geojson"), _points(), unknown=True),
    Reader("points-matched", "text", "p.csv", _text(seeds.MATCHED), _points(), unknown=True),
    Reader("points-matched-json", "json", "p.geojson", _text(seeds.MATCHED_JSON), _points(), unknown=True),
    Reader("points-qgis", "text", "p.points", _text(seeds.QGIS), _points(), unknown=True),
    Reader("points-odm", "text", "gcp_list.txt", _text(seeds.ODM), _points(None, "ellipsoid"), unknown=True),
    Reader("points-envi", "text", "p.pts", _text(seeds.ENVI), _points(None, "ellipsoid"), unknown=True),
    Reader("points-asp", "text", "p.gcp", _text(seeds.ASP), _points(None, "ellipsoid"), unknown=True),
    Reader("points-pci", "text", "p.txt", _text(seeds.PCI), _points(), unknown=True),
    Reader("points-links", "text", "links.txt", _text(seeds.LINKS), _points("EPSG:32636", None), unknown=True),
    Reader("block-csv", "text", "rays.csv", _text(seeds.RAYS), _block, unknown=True),
    Reader("block-geojson", "json", "rays.geojson", _text(seeds.RAYS_JSON), _block, unknown=True),
    Reader("model-rpc", "json", "m_model.json", _correction, _model),
    Reader("model-pushbroom", "json", "m_model.json", _pushbroom, _model),
    Reader("model-frame", "json", "m_model.json", _frame_model, _model),
    Reader("report", "json", "one_report.json", _report_seed, _report),
    Reader("pipeline-file", "json", "pipeline.yaml", _yaml_seed, _yaml),
    Reader("stack-list", "text", "list.csv", _text("file,date\na.tif,2020-01-05\nb.tif,2020-03-01\n"), read_list),
    Reader("stack-pair", "json", "a__b.json", _text(seeds.STACK_PAIR), lambda path: read_matches(path).arrays,
           of_files=False),
    Reader("run-record", "json", "one.json", _record_seed, _record, of_files=False),
    Reader("result", "json", "one.json", _record_seed, state.read_result, of_files=False),
    Reader("lease", "json", "one.json", state.lease, state.read_lease, of_files=False),
    Reader("kept-record", "json", "one.json", state.kept_record, state.read_kept_record, of_files=False),
    Reader("renames", "json", "one.json", state.renames, state.read_renames, of_files=False),
    Reader("journal", "json", "one.json", functools.partial(state.journal, False), state.read_journal),
    Reader("project", "json", "one.json", functools.partial(state.journal, True), state.read_project),
    Reader("acquired", "text", "time.txt", _text("2005-08-03T08:12:31Z"), _time, of_files=False),
    Reader("crs-wkt", "text", "crs.txt", _text(_WKT), _system, of_files=False),
    Reader("crs-proj", "text", "crs.txt", _text(_UTM), _system, of_files=False),
    Reader("crs-grids", "text", "crs.txt", _text(_GRIDS), _system, of_files=False),
    Reader("dem", "tiff", "dem.tif", _tiff(seeds.dem), _dem),
    Reader("reference", "tiff", "ortho.tif", _tiff(seeds.dem), _reference),
    Reader("image", "tiff", "one.tif", _tiff(seeds.image), _image),
    Reader("vrt", "xml", "one.vrt", _with_image(seeds.vrt), _image),
    Reader("geoid-grid", "binary", "geoid.gtx", lambda folder: seeds.geoid_gtx(), _grid, of_files=False),
    Reader("geoid-tiff", "tiff", "geoid.tif", _tiff(seeds.geoid_tiff), _grid, of_files=False),
)  # fmt: skip
BY_NAME = {reader.name: reader for reader in READERS}
