"""Photos with the tags of cameras, as files that GDAL reads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from osgeo import gdal

gdal.UseExceptions()

SPACES = {
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
    "Camera": "http://pix4d.com/camera/1.0",
    "senseFly": "http://ns.sensefly.com/Camera/1.0/",
    "DLS": "http://micasense.com/DLS/1.0/",
    "GPano": "http://ns.google.com/photos/1.0/panorama/",
}
EXIF = {
    "Make": "DJI",
    "Model": "FC6310R",
    "FocalLength": "(8.8)",
    "FocalLengthIn35mmFilm": "24",
    "PixelXDimension": "600",
    "PixelYDimension": "400",
    "DateTimeOriginal": "2019:04:11 11:01:21",
    "GPSLatitude": "(39) (30) (0)",
    "GPSLatitudeRef": "N",
    "GPSLongitude": "(33) (15) (36)",
    "GPSLongitudeRef": "E",
    "GPSAltitude": "(1000.5)",
    "GPSAltitudeRef": "0x00",
}
DJI = {
    "drone-dji:AbsoluteAltitude": "+1000.50",
    "drone-dji:RelativeAltitude": "+100.00",
    "drone-dji:GimbalRollDegree": "+0.00",
    "drone-dji:GimbalYawDegree": "+40.00",
    "drone-dji:GimbalPitchDegree": "-90.00",
}


def packet(xmp: Mapping[str, str]) -> str:
    """Return an XMP packet; every second value is an element, the others are attributes."""
    spaces = " ".join(f'xmlns:{prefix}="{uri}"' for prefix, uri in SPACES.items())
    names = list(xmp)
    attributes = " ".join(f'{name}="{xmp[name]}"' for name in names[::2])
    elements = "".join(f"<{name}>{xmp[name]}</{name}>" for name in names[1::2])
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {spaces} {attributes}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta>\n'
        '                    \n<?xpacket end="w"?>'
    )


def photo(
    path: Path, exif: Mapping[str, str] = EXIF, xmp: Mapping[str, str] | str = DJI, size: tuple[int, int] = (600, 400)
) -> Path:
    """Write a photo as GeoTIFF, whose metadata GDAL gives back as those of a JPEG."""
    made = gdal.GetDriverByName("GTiff").Create(str(path), *size, 1, options=["COMPRESS=DEFLATE"])
    made.SetMetadata({f"EXIF_{name}": value for name, value in exif.items()})
    made.SetMetadata([xmp if isinstance(xmp, str) else packet(xmp)], "xml:XMP")
    return path


def jpeg(path: Path, exif: Mapping[str, str] = EXIF, xmp: Mapping[str, str] = DJI) -> Path:
    """Write a photo as JPEG, with its XMP in a segment of its own as cameras do."""
    made = gdal.GetDriverByName("MEM").Create("", 600, 400, 3)
    made.SetMetadata({f"EXIF_{name}": value for name, value in exif.items()})
    gdal.GetDriverByName("JPEG").CreateCopy(str(path), made, options=["WRITE_EXIF_METADATA=YES"])
    data = path.read_bytes()
    body = b"http://ns.adobe.com/xap/1.0/\0" + packet(xmp).encode()
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:])
    return path
