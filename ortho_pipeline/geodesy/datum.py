"""Datum and unit of the heights of a DEM: its declaration, checked against the options of the user."""

from __future__ import annotations

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import DatumError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.geodesy.crs import VERTICAL_FORMS, Vertical
from ortho_pipeline.geodesy.declared_vertical import DeclaredVertical

_SURVEY_FOOT = 1200 / 3937
#: Length in metres of the units of heights, by name without blanks and punctuation.
UNITS = (
    dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0)
    | dict.fromkeys(("cm", "centimetre", "centimeter"), 0.01)
    | dict.fromkeys(("ft", "foot", "feet", "internationalfoot"), 0.3048)
    | dict.fromkeys(("ussurveyfoot", "ussurveyfeet", "usft", "ftus", "footus"), _SURVEY_FOOT)
)


def named_unit(text: str) -> float | None:
    """Return the length in metres of the unit of heights with this name; None if no unit has it.

    >>> named_unit("US survey foot") == named_unit("ftUS")
    True
    """
    return UNITS.get("".join(c for c in text.lower() if c.isalpha()))


def dem_vertical_remedy(first: str = "") -> str:
    """Return the advice to state the height datum by option, after another advice if there is one."""
    option = Text("give the height datum with ", Setting("surface.vertical"), f" ({VERTICAL_FORMS})")
    return Text(first, "; or ", option) if first else option


def dem_vertical(
    declared: DeclaredVertical | None, option: Vertical | None, override: bool
) -> tuple[Vertical, list[str]]:
    """Return the height datum to use for a DEM, and what the user ought to know about it.

    Parameters
    ----------
    declared : DeclaredVertical or None
        Datum that the CRS of the DEM states.
    option : Vertical or None
        Datum that the user gives.
    override : bool
        Use the user's datum even against an authority code.

    Raises
    ------
    DatumError
        If neither states the datum, or if they contradict each other.
    """
    if declared is None:
        if option is None:
            raise DatumError(
                "this DEM does not state its height datum",
                field="surface.vertical",
                remedy=dem_vertical_remedy(),
            )
        return option, []
    if option is None:
        if declared.vertical is None:
            raise DatumError(
                f"unknown height datum {declared.name!r} in this DEM",
                field="surface.vertical",
                remedy=dem_vertical_remedy(),
            )
        by_name = Notice(
            "dem-datum-by-name",
            f"the height datum {declared.vertical.label} of the DEM was recognised only by its name, {declared.name!r}",
            declared=declared.name,
        )
        return declared.vertical, [] if declared.certain else [by_name]
    if option == declared.vertical:
        return option, []
    stated, setting = f"the DEM states the height datum {declared.name!r}", Setting("surface.vertical")
    used = Text(f"{stated}; {option.label} was used instead (", setting, ")")
    warning = Notice("dem-datum-overridden", used, declared=declared.name, used=option.name)
    # A grid file is how a user brings the geoid of a declared datum whose own grid is not installed.
    realises = declared.vertical is not None and not declared.vertical.is_ellipsoid and ":" not in option.name[:5]
    realises = realises and not option.is_ellipsoid
    if declared.certain and not override and not realises:
        raise DatumError(
            Text(f"{stated}, but ", setting, f" gives {option.label}"),
            field="surface.vertical",
            remedy=Text(
                "leave the option out, or override the datum of the file with ", Setting("surface.override_vertical")
            ),
        )
    return option, [warning]


def dem_unit(text: str, declared: DeclaredVertical | None, option: Vertical | None = None) -> float:
    """Return the length in metres of the unit of a DEM's heights.

    Parameters
    ----------
    text : str
        Unit type of the band, as GDAL gives it; may be empty.
    option : Vertical, optional
        Datum that the user gives. Its unit counts if the file states none.

    Raises
    ------
    DatumError
        If the unit is unknown, or if two of the band, the CRS and a datum in feet contradict each other.
    """
    stated = named_unit(text)
    if text and stated is None:
        raise DatumError(
            f"unknown unit of heights {text!r}",
            field="unit",
            remedy="state metres or feet, such as `gdal_edit.py -units m FILE`",
        )
    # Two-dimensional systems have no unit of heights; promoted 3D ones always state metres.
    axis = declared.metres_per_unit if declared else None
    if stated is not None and axis is not None and abs(stated - axis) > 1e-3:
        raise DatumError(
            f"the units of the heights differ: {text!r} in the band, {axis:.6g} m in the CRS",
            field="unit",
            remedy="correct the unit of the band (`gdal_edit.py -units m FILE`), or assign another CRS",
        )
    unit, given = axis or stated, 1.0 if option is None else option.metres_per_unit
    # People give a datum in metres, such as egm96, for a DEM whose band states feet.
    if option is not None and given != 1.0 and unit is not None and abs(unit - given) > 1e-3:
        raise DatumError(
            Text(
                f"the units of the heights differ: {unit:.6g} m in the file, {given:.6g} m in {option.label} (",
                Setting("surface.vertical"),
                ")",
            ),
            field="surface.vertical",
            remedy="give the vertical CRS of this datum that has the unit of the file",
        )
    return unit or given
