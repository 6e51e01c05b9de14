"""Valid files of every format that is read: by the writers of the project, or as descriptions of a format have them."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
from osgeo import gdal, osr

from ortho_pipeline.exchange.rpc_files import COEFFICIENTS, SCALARS, read_rpc_text, rpc_metadata
from ortho_pipeline.models import RPC

SAMPLE = Path(__file__).resolve().parent.parent.parent / "sample_data"
ORBVIEW3 = "3v050620p0000443940a5200000000200m_001443940"
#: Columns and rows of the small image.
SIZE = (40, 30)


def rpc() -> RPC:
    """Return the RPC of the sample scene for the small image, which is its first corner."""
    return read_rpc_text(SAMPLE / "scene_RPC.TXT")


def rpc_xml(rpc: RPC) -> str:
    """Return an RPC as DIMAP, whose first centre is (1, 1)."""
    fields = rpc_metadata(replace(rpc, col_off=rpc.col_off + 1.0, row_off=rpc.row_off + 1.0))
    scalars = "".join(f"<{key}>{fields[key]}</{key}>\n" for key in SCALARS)
    terms = "".join(
        f"<{key}_{n}>{value}</{key}_{n}>\n" for key in COEFFICIENTS for n, value in enumerate(fields[key].split(), 1)
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<Dimap_Document><Metadata_Identification><METADATA_PROFILE>PHR_SENSOR'
        "</METADATA_PROFILE></Metadata_Identification><Rational_Function_Model><Global_RFM>"
        f"<Inverse_Model>\n{terms}</Inverse_Model><RFM_Validity>{scalars}</RFM_Validity></Global_RFM>"
        "</Rational_Function_Model></Dimap_Document>\n"
    )


def rpc_geom(rpc: RPC) -> str:
    """Return an RPC as keyword list of the Orfeo Toolbox."""
    fields = rpc_metadata(rpc)
    lines = ["polynomial_format:  B"]
    lines += [f"{key.lower().replace('long_', 'long_')}:  {fields[key]}" for key in SCALARS]
    lines += [f"{key.lower()}_{n:02d}:  {v}" for key in COEFFICIENTS for n, v in enumerate(fields[key].split())]
    return "\n".join(lines) + "\n"


def dimap_text(*, listed: bool = False) -> str:
    """Return metadata of version 2: a flight northwards over the equator at noon, 300 x 400 pixels."""
    points, quaternions = "", ""
    for seconds in range(-120, 121, 30):
        angle = 1.06e-3 * seconds
        place = f"{7.07e6 * math.cos(angle)!r} 0.0 {7.07e6 * math.sin(angle)!r}"
        total = 12 * 3600 + seconds
        moment = f"2020-06-01T{total // 3600:02d}:{total % 3600 // 60:02d}:{total % 60:02d}.000000Z"
        points += f"<Point><LOCATION_XYZ>{place}</LOCATION_XYZ><TIME>{moment}</TIME></Point>"
    for k in range(12):
        quaternions += f"<Quaternion><Q0>{0.70710678 + 1e-6 * (k - 5) * 0.01!r}</Q0><Q1>0.0</Q1><Q2>-0.70710678</Q2>"
        quaternions += f"<Q3>0.0</Q3><TIME>2020-06-01T12:00:00.{k:02d}0000Z</TIME></Quaternion>"
    parts = "".join(
        f"<Q{k}><DEGREE>1</DEGREE><COEFFICIENTS>{terms}</COEFFICIENTS></Q{k}>"
        for k, terms in enumerate(("0.70710678 1e-6", "0.0 0.0", "-0.70710678 0.0", "0.0 0.0"))
    )
    polynomials = f"<Polynomial_Quaternions><OFFSET>43200.05</OFFSET><SCALE>1.0</SCALE>{parts}</Polynomial_Quaternions>"
    attitude = f"<Quaternion_List>{quaternions}</Quaternion_List>" if listed else polynomials
    look = "<XLOS_0>-0.0001</XLOS_0><XLOS_1>7e-07</XLOS_1><YLOS_0>8e-05</YLOS_0>"
    swath = "<Swath_Range><FIRST_COL>1</FIRST_COL><LAST_COL>300</LAST_COL></Swath_Range>"
    calibration = f"{swath}<Polynomial_Look_Angles>{look}</Polynomial_Look_Angles>"
    if listed:
        calibration = (
            f"<Band_Calibration_List><Band_Calibration>{calibration}</Band_Calibration></Band_Calibration_List>"
        )
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document>
  <Metadata_Identification><METADATA_FORMAT version="2.0">DIMAP</METADATA_FORMAT>
    <METADATA_PROFILE>{"S6_SENSOR" if listed else "PHR_SENSOR"}</METADATA_PROFILE></Metadata_Identification>
  <Raster_Data><Raster_Dimensions><NROWS>400</NROWS><NCOLS>300</NCOLS></Raster_Dimensions></Raster_Data>
  <Geometric_Data><Refined_Model>
    <Time><Time_Range><START>2020-06-01T12:00:00.0000000Z</START><END>2020-06-01T12:00:00.0279300Z</END></Time_Range>
      <Time_Stamp><LINE_PERIOD>0.07</LINE_PERIOD></Time_Stamp></Time>
    <Ephemeris><Point_List>{points}</Point_List></Ephemeris>
    <Attitudes>{attitude}</Attitudes>
    <Geometric_Calibration><Instrument_Calibration>{calibration}
      <Instrument_Biases><YAW>0.0</YAW></Instrument_Biases></Instrument_Calibration></Geometric_Calibration>
  </Refined_Model></Geometric_Data>
</Dimap_Document>
"""


# -- rasters ---------------------------------------------------------------------------------------------------------


def image(path: Path, *, tag: bool = True) -> Path:
    """Write a small image, with the RPC of the sample scene in its TIFF tag."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *SIZE, 1, gdal.GDT_UInt16, ["COMPRESS=DEFLATE"])
    if tag:
        dataset.SetMetadata(rpc_metadata(rpc()), "RPC")
    dataset.WriteArray(np.arange(SIZE[0] * SIZE[1], dtype=np.uint16).reshape(SIZE[::-1]))
    dataset = None
    return path


def dem(path: Path) -> Path:
    """Write a small DEM with nodata, scale and offset."""
    system = osr.SpatialReference()
    system.ImportFromEPSG(32636)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 30, 20, 1, gdal.GDT_Float32)
    dataset.SetGeoTransform((500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0))
    dataset.SetSpatialRef(system)
    band = dataset.GetRasterBand(1)
    band.SetNoDataValue(-9999.0)
    band.SetScale(1.0)
    band.SetOffset(0.0)
    band.WriteArray(np.linspace(100, 900, 600, dtype=np.float32).reshape(20, 30))
    dataset = band = None
    return path


def vrt(folder: Path) -> str:
    """Return a VRT of the small image, which lies in `folder`."""
    gdal.GetDriverByName("VRT").CreateCopy(str(folder / "seed.vrt"), gdal.Open(str(folder / "one.tif")))
    return (folder / "seed.vrt").read_text()


def geoid_tiff(path: Path) -> Path:
    """Write the geoid grid of `geoid_gtx` as GeoTIFF."""
    system = osr.SpatialReference()
    system.ImportFromEPSG(4326)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 8, 8, 1, gdal.GDT_Float32, ["COMPRESS=DEFLATE"])
    dataset.SetGeoTransform((29.5, 1.0, 0.0, 40.5, 0.0, -1.0))
    dataset.SetSpatialRef(system)
    dataset.WriteArray(np.linspace(20.0, 40.0, 8 * 8, dtype=np.float32).reshape(8, 8)[::-1])
    dataset = None
    return path


def geoid_gtx() -> bytes:
    """Return a geoid grid of 1 degree in GTX: south, west, steps, rows, columns, floats, all big-endian."""
    heights = np.linspace(20.0, 40.0, 8 * 8).astype(">f4")
    return struct.pack(">ddddii", 33.0, 30.0, 1.0, 1.0, 8, 8) + heights.tobytes()


# -- points ----------------------------------------------------------------------------------------------------------

STACK_PAIR = json.dumps({
    "first": "b", "second": "a", "place": [[1.0, 2.0], [3.0, 4.0]], "shown": [[1.5, 2.0], [3.5, 4.0]],
    "sigma_px": [0.1, 0.1], "alike_px": 0.01, "tried": 4, "kept": 2,
})  # fmt: skip
QGIS = (
    "#CRS: EPSG:32636\nmapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n"
    "500100.5,4100000.25,10.5,-20.25,1,0,0,0\n500200,4100100,30.5,-40.5,1,0,0,0\n500300,4100300,5,-6,0,0,0,0\n"
)
ODM = (
    "EPSG:32636\n500100.5 4100000.25 850.5 10.5 20.25 one.tif a\n500200 4100100 851 30.5 40.5 one.tif b\n"
    "500300 4100200 852 3.5 4.5 one.tif\n"
)
ENVI = (
    "; ENVI Image to Map GCP File\n; projection info = {UTM, 36, North, WGS-84, units=Meters}\n"
    "; Map (x,y,elev), Image (x,y)\n500100.5 4100000.25 123.5 11.5 21.25\n500200 4100000 100 31 41\n"
)
ASP = (
    '# WKT: GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433],AXIS["Latitude",NORTH],AXIS["Longitude",EAST]]\n'
    "5 37.25 33.35 427.1 1.0 2.0 3.0 one.tif 124.5 19.7 1.0 0.5 two.tif 254.3 73.9 0.25 0.25\n"
    "6,37.26,33.36,-5,1,1,1,one.tif,10,20,1,1\n"
)
PCI = (
    "#CRS: EPSG:32636\n#vertical: ellipsoid\nID\tP\tL\tX\tY\tZ\tS\nG1\t10.5\t20.25\t500100.5\t4100000.25\t850.5\tG\n"
    "G2\t30.5\t40.5\t500200\t4100100\t851\tC\nG3\t3.5\t4.5\t500300\t4100200\t852\tI\n"
)
LINKS = "link table\n1 10.5 -20.25 500100.5 4100000.25\n2 30.5 -40.5 500200 4100100\n3 5 -6 500300 4100200\n"
RAYS = (
    "#CRS: EPSG:32636\n#vertical: ellipsoid\nid,image,col,row,x,y,h,role\n"
    "a,one.tif,10.5,20.25,500100.5,4100000.25,850,control\n"
    "a,two.tif,12.5,22.25,500100.5,4100000.25,850,control\nb,one.tif,30,40,,,,tie\nb,two.tif,31,41,,,,tie\n"
)
RAYS_JSON = json.dumps(
    {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": [33.35, 37.25, 850.0]},
                "properties": {"id": "a", "role": "control", "ji": {"one.tif": [10.0, 20.0], "two.tif": [12, 22]}},
            },
            {
                "type": "Feature",
                "geometry": None,
                "properties": {"id": "b", "ji": {"one.tif": [1, 2], "two.tif": [3, 4]}},
            },
        ],
    }
)

# -- cameras, surveys, pipeline files --------------------------------------------------------------------------------

FRAME_TABLE = (
    "filename,x,y,z,omega,phi,kappa\n"
    "one.tif,500100.5,4100000.25,1850.5,0.5,-0.25,90\ntwo.tif,500200,4100100,1851,0,0,0\n"
)
CAMERA = json.dumps(
    {
        "name": "a", "width": SIZE[0], "height": SIZE[1], "focal_length_mm": 50.0, "sensor_mm": [36.0, 27.0],
        "principal_point_mm": [0.1, -0.1], "distortion": {"k1": 0.01, "k2": 0.0, "k3": 0.0, "p1": 1e-4, "p2": 0.0},
    }
)  # fmt: skip
OPENSFM = json.dumps(
    [
        {
            "cameras": {
                "a": {
                    "projection_type": "brown", "width": SIZE[0], "height": SIZE[1], "focal_x": 0.9, "focal_y": 0.9,
                    "c_x": 0.0, "c_y": 0.0, "k1": 0.01, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0,
                }
            },
            "reference_lla": {"longitude": 33.35, "latitude": 37.25, "altitude": 900.0},
            "shots": {
                "one.tif": {
                    "rotation": [math.pi, 0.0, 0.0], "translation": [30.0, -20.0, 150.0], "camera": "a",
                }
            },
        }
    ]
)  # fmt: skip
MATCHED = """#CRS: EPSG:4979
#vertical: ellipsoid
id,col,row,x,y,h,role,sigma_image,var_col,var_row,cov_col_row,group
m1,10.5,20.25,32.9,39.9,900,control,,0.04,0.09,-0.02,0
m2,30.5,2.25,32.91,39.91,905,check,0.2,,,,0
m3,1.5,12.25,32.92,39.89,910,control,0.3,0.09,0.09,0.01,
"""
MATCHED_JSON = json.dumps(
    {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": {
                    "ji": [10.0, 20.0 + k], "id": f"m{k}", "var_col": 0.04, "var_row": 0.09, "cov_col_row": -0.02,
                    "group": k,
                },
                "geometry": {"type": "Point", "coordinates": [32.9, 39.9 + 0.01 * k, 900.0]},
            }
            for k in range(3)
        ],
    }
)  # fmt: skip
PIPELINE = json.dumps(
    {
        "output": "out",
        "defaults": {
            "surface": {"dem": "dem.tif", "vertical": "ellipsoid", "fill": "error"},
            "points": {"gcps": "gcps.csv", "crs": "EPSG:4979", "check": "every:3", "significance": 0.05},
            "output": {
                "crs": "EPSG:32636", "resolution": 5, "extent": [500000, 4000000, 500100, 4000100], "bands": [1],
                "creation_options": {"COMPRESS": "DEFLATE"}, "acquired": "2005-08-03T08:12:31Z", "tolerance": 0.01,
            },
        },
        "scenes": [
            {"images": ["*.tif", "**/*.tif"], "exclude": "dem.tif", "name": "{stem}"},
            {"image": "one.tif", "scene": {"rpc": "tag", "sensor_options": {"rpc": "tag"}}},
        ],
        "mosaic": {"format": "VRT", "seams": True},
    },
    indent=1,
)  # fmt: skip
