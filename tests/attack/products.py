"""Valid metadata of products of many sensors, written from one flight as descriptions of the formats have them."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
from osgeo import gdal
from scipy.spatial.transform import Rotation
from seeds import dimap_text, rpc_xml, vrt

from ortho_pipeline.exchange.rpc_files import SCALARS, rpc_metadata
from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef, geocentric
from ortho_pipeline.models import RPC


def flight(times: np.ndarray, *, radius: float = 7.2e6, lon: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities (ECEF, relative to the turning Earth) of a circular orbit over 40° north."""
    turn, rate = 7.292115e-5, math.sqrt(3.986004418e14 / radius**3)

    def place(time: np.ndarray) -> np.ndarray:
        angle, node = math.radians(139.0) + rate * time, math.radians(lon) + math.radians(171.0) - turn * time
        tilt = math.radians(98.7)
        plane = np.stack([np.cos(angle), np.sin(angle) * math.cos(tilt), np.sin(angle) * math.sin(tilt)], axis=1)
        c, s = np.cos(node), np.sin(node)
        x, y = plane[:, 0], plane[:, 1]
        return radius * np.stack([c * x - s * y, s * x + c * y, plane[:, 2]], axis=1)

    step = 1e-2
    return place(times), (place(times + step) - place(times - step)) / (2 * step)


def spot_text(*, size: tuple[int, int] = (60, 50), every: bool = False, corrected: bool = False) -> str:
    """Return METADATA.DIM of level 1A: 10 m pixels, 20 degrees to the left, with the style of SPOT 1 to 4 or of 5."""
    columns, rows = size

    def moment(seconds: float) -> str:
        whole = round((12 * 3600 + seconds) * 1e6)
        clock = f"{whole // 3600000000:02d}:{whole // 60000000 % 60:02d}:{whole // 1000000 % 60:02d}"
        return f"1998-07-12T{clock}.{whole % 1000000:06d}"

    def three(names: str, values: np.ndarray, form: str) -> str:
        return "".join(f"<{name}>{value:{form}}</{name}>" for name, value in zip(names.split(), values, strict=True))

    times = np.arange(-240.0, 241.0, 60.0)
    points = "".join(
        f"<Point><TIME>{moment(t)}</TIME><Location>{three('X Y Z', p, '+.10e')}</Location>"
        f"<Velocity>{three('X Y Z', v, '+.10e')}</Velocity></Point>\n"
        for t, p, v in zip(times, *flight(times), strict=True)
    )
    detectors = np.arange(1, columns + 1) if every else np.array([1, columns])
    psi_y = 0.35 + 1.2e-5 * (detectors - 1) + 2e-9 * (detectors - 1) ** 2 * every
    looks = "".join(
        f"<Look_Angles><DETECTOR_ID>{d}</DETECTOR_ID><PSI_X>{0.01 + 1e-7 * d:.10e}</PSI_X><PSI_Y>{y:.10e}</PSI_Y>"
        "</Look_Angles>\n"
        for d, y in zip(detectors, psi_y, strict=True)
    )
    at = np.arange(-1.0, 1.01, 0.125)
    swing = np.stack([9e-4 + 3e-6 * at, -7e-4 + 1e-5 * np.sin(at), -1.6e-4 + 5e-6 * np.cos(at)], axis=1)

    def rows_of(name: str, values: np.ndarray) -> str:
        return "".join(
            f"<{name}><TIME>{moment(t)}</TIME>{three('YAW PITCH ROLL', v, '.10e')}<OUT_OF_RANGE>N</OUT_OF_RANGE>"
            f"</{name}>\n"
            for t, v in zip(at, values, strict=True)
        )

    speeds = rows_of("Angular_Speeds", np.stack([3e-6 + 0 * at, 1e-5 * np.cos(at), -5e-6 * np.sin(at)], axis=1))
    attitudes = "" if not corrected else (
        f"<Corrected_Attitudes><STAR_TRACKER_USED>Y</STAR_TRACKER_USED><Corrected_Attitude>{rows_of('Angles', swing)}"
        "</Corrected_Attitude></Corrected_Attitudes>"
    )  # fmt: skip
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<Dimap_Document name="METADATA.DIM"><Metadata_Id>'
        '<METADATA_FORMAT version="1.1">DIMAP</METADATA_FORMAT><METADATA_PROFILE>SPOTSCENE_1A</METADATA_PROFILE>'
        "</Metadata_Id><Dataset_Sources><Source_Information><Scene_Source><IMAGING_DATE>1998-07-12</IMAGING_DATE>"
        "<IMAGING_TIME>12:00:00</IMAGING_TIME><MISSION>SPOT</MISSION><MISSION_INDEX>"
        f"{5 if corrected else 1}</MISSION_INDEX><INSTRUMENT>HRV</INSTRUMENT><INSTRUMENT_INDEX>1</INSTRUMENT_INDEX>"
        "<SENSOR_CODE>P</SENSOR_CODE><INCIDENCE_ANGLE>+2.3e+01</INCIDENCE_ANGLE><SUN_AZIMUTH>+1.5e+02</SUN_AZIMUTH>"
        "<SUN_ELEVATION>+6.9e+01</SUN_ELEVATION></Scene_Source></Source_Information></Dataset_Sources>"
        f"<Raster_Dimensions><NCOLS>{columns}</NCOLS><NROWS>{rows}</NROWS><NBANDS>1</NBANDS></Raster_Dimensions>"
        '<Data_Access><DATA_FILE_FORMAT version="1.0">GEOTIFF</DATA_FILE_FORMAT><Data_File>'
        '<DATA_FILE_PATH href="IMAGERY.TIF"/></Data_File></Data_Access>'
        "<Raster_Encoding><NBITS>8</NBITS><DATA_TYPE>UNSIGNED</DATA_TYPE><BYTEORDER>I</BYTEORDER></Raster_Encoding>"
        "<Data_Processing><PROCESSING_LEVEL>1A</PROCESSING_LEVEL></Data_Processing><Data_Strip>"
        f"<Ephemeris><Points>\n{points}</Points></Ephemeris><Satellite_Attitudes><Raw_Attitudes><Aocs_Attitude>"
        f"<Angular_Speeds_List>{speeds}</Angular_Speeds_List></Aocs_Attitude></Raw_Attitudes>{attitudes}"
        "</Satellite_Attitudes><Sensor_Configuration><Time_Stamp><LINE_PERIOD>+1.5040000000e-03</LINE_PERIOD>"
        f"<SCENE_CENTER_TIME>{moment(0.0)}</SCENE_CENTER_TIME><SCENE_CENTER_LINE>{rows // 2}</SCENE_CENTER_LINE>"
        f"<SCENE_CENTER_COL>{columns // 2}</SCENE_CENTER_COL></Time_Stamp><Instrument_Look_Angles_List>"
        f"<Instrument_Look_Angles><BAND_INDEX>1</BAND_INDEX><Look_Angles_List>\n{looks}</Look_Angles_List>"
        "</Instrument_Look_Angles></Instrument_Look_Angles_List></Sensor_Configuration></Data_Strip></Dimap_Document>\n"
    )


def utc(seconds: float, day: str = "2021-02-01") -> str:
    """Return a time so many seconds after noon."""
    whole = round((12 * 3600 + seconds) * 1e6)
    clock = f"{whole // 3600000000:02d}:{whole // 60000000 % 60:02d}:{whole // 1000000 % 60:02d}"
    return f"{day}T{clock}.{whole % 1000000:06d}Z"


def view(places: np.ndarray, rates: np.ndarray, *, back_deg: float, left_deg: float) -> np.ndarray:
    """Return the axes (N, 3, 3) of a camera in ECEF: x to the left of the flight, y forward, z to the ground."""
    z = -places / np.linalg.norm(places, axis=1)[:, None]
    x = np.cross(rates, z)
    x /= np.linalg.norm(x, axis=1)[:, None]
    turn = Rotation.from_euler("XY", [back_deg, left_deg], degrees=True).as_matrix()
    return np.stack([x, np.cross(z, x), z], axis=2) @ turn


def isd_text(*, size: tuple[int, int] = (60, 50), start: float = 0.0, catalogue: str = "10200100A0000000",
             tiles: tuple[tuple[str, int, int, int, int], ...] = (), rpc: RPC | None = None, namespace: str = ""
             ) -> str:  # fmt: skip
    """Return the ISD XML of an image of 0.8 m pixels, 12 degrees backwards, 9 aside, whose first row is at `start`."""
    columns, rows = size
    times = np.arange(-0.3, 0.301, 0.02)
    places, rates = flight(times)
    axes = view(places, rates, back_deg=12.0, left_deg=9.0)
    # The vendor's x is forward, its y along the line the other way.
    quaternions = Rotation.from_matrix(np.stack([axes[:, :, 1], -axes[:, :, 0], axes[:, :, 2]], axis=2)).as_quat()

    def listed(name: str, values: np.ndarray) -> str:
        lines = "\n".join(
            f"<{name}>{k:.15e} {' '.join(f'{v:.15e}' for v in row)}</{name}>" for k, row in enumerate(values, 1)
        )
        return f"<{name}List>\n{lines}\n</{name}List>"

    def table(part: str, name: str, values: np.ndarray) -> str:
        return (
            f"<{part}><STARTTIME>{utc(times[0])}</STARTTIME><NUMPOINTS>{len(values)}</NUMPOINTS>"
            f"<TIMEINTERVAL>2.000000000000000e-02</TIMEINTERVAL>{listed(name, values)}</{part}>\n"
        )

    zeros = np.zeros((len(times), 10))
    files = "".join(
        f"<TILE><FILENAME>{name}</FILENAME><ULCOLOFFSET>{left}</ULCOLOFFSET><ULROWOFFSET>{top}</ULROWOFFSET>"
        f"<LRCOLOFFSET>{left + width - 1}</LRCOLOFFSET><LRROWOFFSET>{top + height - 1}</LRROWOFFSET></TILE>\n"
        for name, left, top, width, height in tiles
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<isd{namespace}><IMD><NUMROWS>{rows}</NUMROWS><NUMCOLUMNS>{columns}'
        "</NUMCOLUMNS><BANDID>P</BANDID><BITSPERPIXEL>8</BITSPERPIXEL><PRODUCTLEVEL>LV1B</PRODUCTLEVEL><IMAGE><SATID>WV01</SATID>"
        f"<SCANDIRECTION>Forward</SCANDIRECTION><CATID>{catalogue}</CATID><TLCTIME>{utc(start)}</TLCTIME><FIRSTLINETIME>{utc(start)}</FIRSTLINETIME>"
        f"<TLCLISTList><TLCLIST>0.0 0.0</TLCLIST><TLCLIST>{rows}.0 {rows * 1e-4:.15e}</TLCLIST></TLCLISTList>"
        "<MEANSUNEL>4.1e+01</MEANSUNEL><CLOUDCOVER>-9.99e+02</CLOUDCOVER></IMAGE></IMD>\n"
        f"{table('EPH', 'EPHEMLIST', np.hstack([places, rates, zeros[:, :6]]))}"
        f"{table('ATT', 'ATTLIST', np.hstack([quaternions, zeros]))}"
        f"<TIL><NUMTILES>{len(tiles)}</NUMTILES>{files}</TIL><GEO><PRINCIPAL_DISTANCE><PD>8.0e+03</PD></PRINCIPAL_DISTANCE>"
        "<OPTICAL_DISTORTION><POLYORDER>-1</POLYORDER></OPTICAL_DISTORTION><PERSPECTIVE_CENTER><CX>0.0</CX><CY>0.0</CY>"
        "<CZ>0.0</CZ></PERSPECTIVE_CENTER><CAMERA_ATTITUDE><QCS1>0.0</QCS1><QCS2>0.0</QCS2><QCS3>0.0</QCS3><QCS4>1.0</QCS4>"
        "</CAMERA_ATTITUDE><DETECTOR_MOUNTING><BAND_P><BANDID>P</BANDID><DETECTOR_ARRAY><DETORIGINX>0.05</DETORIGINX>"
        f"<DETORIGINY>{columns * 0.004}</DETORIGINY><DETROTANGLE>0.0</DETROTANGLE><DETPITCH>0.008</DETPITCH>"
        f"</DETECTOR_ARRAY></BAND_P></DETECTOR_MOUNTING></GEO>{_rpb(rpc)}</isd>\n"
    )


def reversed_scan(text: str, *, from_first_row: bool = False) -> str:
    """Return ISD XML of the same image with its last row on top: a scan against the flight, whose times decrease.

    Times count from the earliest row, or from the first row, where they are negative.
    """
    rows = int(re.search(r"<NUMROWS>(\d+)<", text)[1])
    at, times = np.array(re.findall(r"<TLCLIST>(\S+)\s+(\S+)</TLCLIST>", text), dtype=float).T
    ends = np.interp([rows - 1, 0], at, times)
    shift = ends[0] if from_first_row else 0.0
    listed = "".join(
        f"<TLCLIST>{row}.0 {time - shift:.15e}</TLCLIST>" for row, time in zip((0, rows - 1), ends, strict=True)
    )
    text = re.sub(r"(?s)(<TLCLISTList>).*(</TLCLISTList>)", rf"\g<1>{listed}\g<2>", text)
    began = np.datetime64(re.search(r"<TLCTIME>(.*?)Z?</TLCTIME>", text)[1], "us")
    for name, after in (("FIRSTLINETIME", ends[0]), ("TLCTIME", shift)):
        time = began + np.timedelta64(round(after * 1e6), "us")
        text = re.sub(rf"(<{name}>).*?(</{name}>)", rf"\g<1>{time}Z\g<2>", text)
    text = text.replace("<SCANDIRECTION>Forward", "<SCANDIRECTION>Reverse")

    def turned(found: re.Match[str]) -> str:
        return f"{found[1]}{' '.join(str(-float(term)) for term in found[2].split())}{found[3]}"

    text = re.sub(r"(<LINEOFFSET>)(.*?)(</LINEOFFSET>)", lambda m: f"{m[1]}{rows - 1 - float(m[2])!r}{m[3]}", text)
    return re.sub(r"(<LINENUMCOEF>)(.*?)(</LINENUMCOEF>)", turned, text)


def _rpb(rpc: RPC | None) -> str:
    if rpc is None:
        return ""
    fields = rpc_metadata(rpc)
    scalars = "".join(
        f"<{key.replace('_OFF', 'OFFSET').replace('_SCALE', 'SCALE')}>{fields[key]}"
        f"</{key.replace('_OFF', 'OFFSET').replace('_SCALE', 'SCALE')}>"
        for key in SCALARS
    )
    terms = "".join(
        f"<{tag}List><{tag}>{fields[key]}</{tag}></{tag}List>\n"
        for key, tag in (("LINE_NUM_COEFF", "LINENUMCOEF"), ("LINE_DEN_COEFF", "LINEDENCOEF"),
                         ("SAMP_NUM_COEFF", "SAMPNUMCOEF"), ("SAMP_DEN_COEFF", "SAMPDENCOEF"))
    )  # fmt: skip
    return f"<RPB><SPECID>RPC00B</SPECID><IMAGE>{scalars}\n{terms}</IMAGE></RPB>"


def til_text(tiles: tuple[tuple[str, int, int, int, int], ...]) -> str:
    """Return a .TIL file of tiles, as GDAL's driver of that name reads it."""
    groups = "".join(
        f'BEGIN_GROUP = TILE_{k}\n\tfilename = "{name}";\n\tULColOffset = {left};\n\tULRowOffset = {top};\n'
        f"\tLRColOffset = {left + width - 1};\n\tLRRowOffset = {top + height - 1};\nEND_GROUP = TILE_{k}\n"
        for k, (name, left, top, width, height) in enumerate(tiles, 1)
    )
    return f'bandId = "P";\nnumTiles = {len(tiles)};\ntileUnits = "Pixels";\ntileOverlap = 0;\n{groups}END;\n'


def tsai_text() -> str:
    """Return a pinhole camera of Ames Stereo Pipeline, 4 km above 30 east, 40 north, that looks down."""
    lon, lat = math.radians(30.0), math.radians(40.0)
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    turn = np.column_stack([east, -np.cross(up, east), -up])
    centre = 6.3735e6 * up
    return (
        "VERSION_4\nPINHOLE\nfu = 0.05\nfv = 0.05\ncu = 0.00024\ncv = 0.0002\nu_direction = 1 0 0\n"
        f"v_direction = 0 1 0\nw_direction = 0 0 1\nC = {' '.join(map(repr, centre.tolist()))}\n"
        f"R = {' '.join(map(repr, turn.ravel().tolist()))}\npitch = 8e-06\nNULL\n"
    )


def aster_text(size: tuple[int, int] = (60, 50), rpc: RPC | None = None) -> str:
    """Return the lattice of an ASTER camera and an RPC, of another place if none is given."""
    columns, rows = size
    at, lines = np.linspace(0.0, columns, 11), np.linspace(-20.0, rows + 20.0, 9)
    places, rates = flight(2.2e-3 * lines)
    axes = view(places, rates, back_deg=0.0, left_deg=-3.0)
    world_from_camera = np.stack([axes[:, :, 1], -axes[:, :, 0], axes[:, :, 2]], axis=2)
    own = np.column_stack([np.full(11, 4e-4), -(at - columns / 2) * 2.1e-5, np.ones(11)])
    own /= np.linalg.norm(own, axis=1)[:, None]
    world = np.einsum("rij,cj->rci", world_from_camera, own).reshape(-1, 3)
    points = np.stack(np.meshgrid(at, lines), axis=-1).reshape(-1, 2)

    def listed(name: str, values: np.ndarray) -> str:
        return f"<{name}>\n" + "\n".join(" ".join(map(repr, row)) for row in values.tolist()) + f"\n</{name}>\n"

    one = rpc or RPC(30, 25, 32, 40, 500, 60, 50, 0.1, 0.1, 500, *[np.eye(20)[k] for k in (1, 0, 2, 0)])
    return (
        f"<isd>\n{listed('LATTICE_POINT', points)}{listed('SIGHT_VECTOR', np.tile(own, (len(lines), 1)))}"
        f"{listed('WORLD_SIGHT_VECTOR', world)}{listed('SAT_POS', places)}<IMAGE_COLS>{columns}</IMAGE_COLS>"
        f"<IMAGE_ROWS>{rows}</IMAGE_ROWS>{_rpb(one)}</isd>\n"
    )


def dimap_product(folder: Path, rpc: RPC | None = None, ending: str = "TIF") -> tuple[Path, Path]:
    """Write DIM_A.XML, its RPC and two tiles of 200 and 100 columns, TIF or JP2; return the tiles."""
    names = [f"IMG_A_R1C{k}.{ending}" for k in (1, 2)]
    listed = "".join(
        f'<Data_File tile_R="1" tile_C="{k}"><DATA_FILE_PATH href="{name}"/></Data_File>'
        for k, name in enumerate(names, 1)
    )
    tiling = (
        "<NBANDS>1</NBANDS><Tile_Set><NTILES>2</NTILES><Regular_Tiling><NTILES_SIZE nrows='400' ncols='200'/>"
        "<NTILES_COUNT ntiles_R='1' ntiles_C='2'/><OVERLAP_ROW>0</OVERLAP_ROW><OVERLAP_COL>0</OVERLAP_COL>"
        "</Regular_Tiling></Tile_Set></Raster_Dimensions>"
        "<Raster_Encoding><DATA_TYPE>INTEGER</DATA_TYPE><NBITS>8</NBITS><SIGN>UNSIGNED</SIGN></Raster_Encoding>"
        "<Data_Access><DATA_FILE_ORGANISATION>BAND_COMPOSITE</DATA_FILE_ORGANISATION><DATA_FILE_FORMAT>image/"
        f"{'tiff' if ending == 'TIF' else 'jp2'}</DATA_FILE_FORMAT><DATA_FILE_TILES>true</DATA_FILE_TILES>"
        f"<Data_Files>{listed}</Data_Files></Data_Access>"
    )
    # First: GDAL deletes the metadata of an image that it writes anew.
    for name, width in zip(names, (200, 100), strict=True):
        dataset = gdal.GetDriverByName("MEM").Create("", width, 400)
        dataset.GetRasterBand(1).Fill(width // 2)
        driver, options = ("GTiff", []) if ending == "TIF" else ("JP2OpenJPEG", ["QUALITY=100", "REVERSIBLE=YES"])
        gdal.GetDriverByName(driver).CreateCopy(str(folder / name), dataset, options=options)
    (folder / "DIM_A.XML").write_text(dimap_text().replace("</Raster_Dimensions>", tiling))
    if rpc is not None:
        (folder / "RPC_A.XML").write_text(rpc_xml(rpc))
    return folder / names[0], folder / names[1]


def bundle_text(band: str, size: tuple[int, int]) -> str:
    """Return DIMAP metadata of one image of a bundle, without a rigorous model."""
    strip = "<SOURCE_ID>DS_PHR1A_1</SOURCE_ID><SOURCE_TYPE>Strip_Source</SOURCE_TYPE>"
    return (
        "<Dimap_Document><Metadata_Identification><METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE>"
        "</Metadata_Identification><Processing_Information><Product_Settings><SPECTRAL_PROCESSING>"
        f"{band}</SPECTRAL_PROCESSING></Product_Settings></Processing_Information><Dataset_Sources>"
        f"<Source_Identification>{strip}</Source_Identification></Dataset_Sources><Raster_Data><Raster_Dimensions>"
        f"<NROWS>{size[1]}</NROWS><NCOLS>{size[0]}</NCOLS></Raster_Dimensions><Data_Access><Data_Files><Data_File>"
        f'<DATA_FILE_PATH href="IMG_PHR1A_{band}_1_R1C1.TIF"/></Data_File></Data_Files></Data_Access></Raster_Data>'
        "</Dimap_Document>"
    )


def geolocation_text(folder: Path) -> str:
    """Return a VRT of `one.tif` in `folder` with geolocation arrays, which are written next to it."""
    for name, step in (("lon", (0.001, 1e-5)), ("lat", (2e-5, -0.001))):
        dataset = gdal.GetDriverByName("GTiff").Create(str(folder / f"{name}.tif"), 12, 10, 1, gdal.GDT_Float64)
        rows, columns = np.mgrid[0:10, 0:12]
        dataset.WriteArray((33.0 if name == "lon" else 38.0) + step[0] * columns + step[1] * rows)
        dataset = None
    text = (folder / "one.vrt").read_text() if (folder / "one.vrt").exists() else vrt(folder)
    fields = {"X_DATASET": "lon.tif", "Y_DATASET": "lat.tif", "X_BAND": 1, "Y_BAND": 1, "PIXEL_OFFSET": 0,
              "LINE_OFFSET": 0, "PIXEL_STEP": 4, "LINE_STEP": 3.5, "SRS": "EPSG:4326"}  # fmt: skip
    listed = "".join(f'<MDI key="{key}">{value}</MDI>' for key, value in fields.items())
    return text.replace("</VRTDataset>", f'<Metadata domain="GEOLOCATION">{listed}</Metadata></VRTDataset>')


def enmap_text(size: tuple[int, int], rpcs: tuple[RPC, ...]) -> str:
    """Return METADATA.XML of EnMAP level 1B: three visible bands and two infrared ones, each with its RPC."""

    def listed(number: int, rpc: RPC) -> str:
        fields = rpc_metadata(rpc)
        names = {key: key.replace("LINE_", "ROW_").replace("SAMP_", "COL_") for key in SCALARS}
        terms = {"LINE_NUM": "ROW_NUM", "LINE_DEN": "ROW_DEN", "SAMP_NUM": "COL_NUM", "SAMP_DEN": "COL_DEN"}
        parts = [f"<{name}>{fields[key]}</{name}>" for key, name in names.items()]
        for key, name in terms.items():
            values = fields[f"{key}_COEFF"].split()
            parts += [f"<{name}_{k:02d}>{value}</{name}_{k:02d}>" for k, value in enumerate(values, 1)]
        return f'<bandID number="{number}">{"".join(parts)}</bandID>\n'

    bands = "".join(listed(k, rpc) for k, rpc in enumerate(rpcs, 1))
    dimension = f"<dimension><columns>{size[0]}</columns><rows>{size[1]}</rows></dimension>"
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<level_X><base><level>L1B</level></base><specific><datatakeStart>'
        "2022-06-09T08:12:25.038918Z</datatakeStart></specific><product><image>"
        f"<vnir><channels>3</channels>{dimension}</vnir><swir><channels>2</channels>{dimension}</swir></image>"
        f"<navigation><RPC>\n{bands}</RPC></navigation></product></level_X>\n"
    )


PLANET = (
    '{"id": "20200101_081500_12_2401", "type": "Feature", "properties": {"acquired": "2020-01-01T08:15:00.12Z",\n'
    ' "cloud_cover": 0.01, "gsd": 3.7, "instrument": "PSB.SD", "item_type": "PSScene", "satellite_id": "2401",\n'
    ' "strip_id": "3000001", "sun_azimuth": 140.1, "sun_elevation": 41.5, "view_angle": 2.1}}\n'
)


def capella_text() -> str:
    """Return extended metadata of a geocoded image at 15 east, 40 north, seen 35 degrees from the vertical."""
    ground = np.array([[15.0015, 40.0, 120.0]])
    target = geocentric(ground)[0]
    east, north, up = enu_from_ecef(ground)[0]
    incidence = math.radians(35.0)
    satellite = target + 620e3 * (math.sin(incidence) * east + math.cos(incidence) * up)
    vectors = [
        {"time": f"2021-01-01T00:00:{k:02d}Z", "position": (satellite + 7600.0 * (k - 2) * north).tolist(),
         "velocity": (7600.0 * north).tolist()}
        for k in range(5)
    ]  # fmt: skip
    document = {
        "product_type": "GEC",
        "collect": {
            "platform": "capella-2", "start_timestamp": "2021-01-01T00:00:00Z", "state": {"state_vectors": vectors},
            "image": {"center_pixel": {"target_position": target.tolist()}},
        },
    }  # fmt: skip
    return json.dumps(document, indent=1)


#: A STAC item of an image whose RPC lies in another folder.
STAC_ITEM = """{"type": "Feature", "stac_version": "1.0.0", "id": "S", "geometry": null,
 "properties": {"datetime": "2024-01-01T00:00:00Z"}, "links": [{"rel": "self", "href": "./one.json"}],
 "assets": {"image": {"href": "./scene.tif", "type": "image/tiff; application=geotiff", "roles": ["data"]},
  "rpc": {"href": "./meta/scene_RPC.TXT", "type": "text/plain", "roles": ["metadata"]},
  "points": {"href": "./points.csv", "type": "text/csv"},
  "small": {"href": "https://host/small.png", "type": "image/png", "roles": ["thumbnail"]}}}
"""
#: A list of DEM items: one says where it lies by its geometry and its datum by a code, one by its box and a text.
STAC_HEIGHTS = """{"type": "FeatureCollection", "features": [
 {"type": "Feature", "stac_version": "1.0.0", "id": "a", "bbox": [0.0, 0.0, 1.0, 1.0],
  "geometry": {"type": "Polygon", "coordinates": [[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]]]},
  "properties": {"datetime": "2024-01-01T00:00:00Z", "proj:code": "EPSG:9707"},
  "assets": {"dem": {"href": "./a.tif", "type": "image/tiff; application=geotiff", "roles": ["data"]}}},
 {"type": "Feature", "stac_version": "1.0.0", "id": "b", "bbox": [1.0, 0.0, -9.0, 2.0, 1.0, 900.0], "geometry": null,
  "properties": {"datetime": null, "end_datetime": "2023-01-01T00:00:00Z"},
  "assets": {"elevation": {"href": "./b.tif", "proj:epsg": 9518, "proj:wkt2": "GEOGCRS[]"}}}],
 "links": []}
"""
#: A static collection with an item in it, and the way to one next to it that is not there.
STAC_COLLECTION = f"""{{"type": "Collection", "stac_version": "1.0.0", "id": "C", "features": [{STAC_ITEM}],
 "links": [{{"rel": "item", "href": "./items/T.json"}}, {{"rel": "root", "href": "../catalog.json"}}]}}
"""
