"""Valid metadata of products of many sensors, written from one flight as descriptions of the formats have them."""

from __future__ import annotations

import math

import numpy as np


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
