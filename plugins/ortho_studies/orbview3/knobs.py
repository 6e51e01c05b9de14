"""The settings of the OrbView-3 experiment, where their values come from, and the rows that they were fitted to."""

from __future__ import annotations

from ortho_studies.orbview3 import rendering
from ortho_studies.orbview3 import truth as simulated
from ortho_studies.simulation.tables import Knob

KNOBS = (
    Knob(
        "SCENES",
        {name: seconds for name, (seconds, _) in simulated.SCENES.items()},
        "s from abeam",
        "fitted",
        "When the satellite took either scene. The difference is the paper's height to base of 1.4; the ratio is that "
        "of the errors of 3D affine in Y, which go with the distance along the track.",
        ("1|affine3d|* Y",),
    ),
    Knob(
        "SIDE",
        simulated.SIDE,
        "m",
        "chosen",
        "How far the area lies beside the track: not directly below the orbit, but not too far away.",
    ),
    Knob(
        "LINES",
        simulated.LINES,
        "",
        "paper",
        "Length of a scene, from the 11 m that the middle of a scene is off the linear width.",
    ),
    Knob(
        "TURNING, YAW_RATE",
        [simulated.TURNING, simulated.YAW_RATE],
        "(0 to 1), rad/s",
        "fitted",
        "How far the scan keeps its angular speed while the range changes, and how fast the line of pixels turns. The "
        "paper says that both happen, not how much.",
        ("1|affine3d|* X", "1|affine12|* X", "1|affine14|* X"),
    ),
    Knob(
        "FIELD and relief",
        list(simulated.FIELD),
        "m (east-west, north-south)",
        "fitted",
        "Extent of the 34 points, which the paper shows as a sketch, and how heights rise inland.",
        ("1|affine3d|* Y", "1|affine12|* Y"),
    ),
    Knob(
        "TOWN",
        [*simulated.TOWN, simulated.TOWN_RADIUS],
        "m (east, north, radius)",
        "chosen",
        "Where every second point lies, so that some have neighbours within 600 m.",
    ),
    Knob(
        "SIGMA_IMAGE",
        simulated.SIGMA_IMAGE,
        "px per axis",
        "fitted",
        "Noise of pointing: the root mean square of the four relative accuracies.",
        ("1|RPC affine, relative|*",),
    ),
    Knob("SIGMA_GROUND", simulated.SIGMA_GROUND, "m per axis", "chosen", "A GPS survey; it decides nothing."),
    Knob(
        "SIGMA_BIAS",
        simulated.SIGMA_BIAS,
        "m per axis",
        "paper",
        "Attitude: the circular error in the headers, 33 m at 90 %, which the paper divides by 2.3.",
    ),
    Knob(
        "SIGMA_DRIFT, SIGMA_WOBBLE, SIGMA_YAW",
        [simulated.SIGMA_DRIFT, simulated.SIGMA_WOBBLE, simulated.SIGMA_YAW],
        "m",
        "fitted",
        "Attitude: drift to an end of the scene, each higher degree, and yaw at the ends of the line; from the root "
        "mean squares of what shift and affine correction leave.",
        ("1|RPC shift|*", "1|RPC affine|*"),
    ),
    Knob(
        "DEGREES",
        simulated.DEGREES,
        "",
        "chosen",
        "Highest degree of the attitude error over a scene: periods down to some kilometres.",
    ),
    Knob(
        "ENHANCEMENT",
        rendering.ENHANCEMENT,
        "of the difference to the mean of 3 x 3 pixels",
        "chosen",
        "Strength of the vendor's edge enhancement, which only the two statements on edges rest upon.",
    ),
    Knob(
        "QUICKBIRD",
        simulated.QUICKBIRD["side"],
        "m",
        "chosen",
        "How far the area lies beside QuickBird's track; its altitude of 450 km is published.",
    ),
    Knob(
        "QUICKBIRD_NOISE",
        simulated.QUICKBIRD_NOISE,
        "px per axis",
        "fitted",
        "From the improved 3D affine model.",
        ("3.1|affine12|*",),
    ),
    Knob(
        "QUICKBIRD_ATTITUDE",
        simulated.QUICKBIRD_ATTITUDE,
        "of OrbView-3",
        "fitted",
        "Drift and wobble of its attitude, from what a shift of the RPC leaves beside the improved 3D affine model.",
        ("3.1|RPC shift|*",),
    ),
    Knob(
        "QuickBird's scan",
        "against the flight",
        "",
        "fitted",
        "From the simple 3D affine model being worse in Y than in X.",
        ("3.1|affine3d|*",),
    ),
)
