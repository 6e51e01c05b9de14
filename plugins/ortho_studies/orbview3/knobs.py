"""The settings of the OrbView-3 experiment, where their values come from, and the rows that they were fitted to."""

from __future__ import annotations

from ortho_studies.orbview3 import rendering
from ortho_studies.orbview3 import truth as simulated
from ortho_studies.simulation.tables import Knob

KNOBS = (
    Knob(
        "SCENES",
        {name: seconds for name, (seconds, _) in simulated.SCENES.items()},
        "s from the closest approach",
        "fitted",
        "Time of each scene. The difference of the times gives the paper's height-to-base ratio of 1.4. The ratio of "
        "the times is that of the errors of 3D affine in Y, which are proportional to the distance along the track.",
        ("1|affine3d|* Y",),
    ),
    Knob(
        "SIDE",
        simulated.SIDE,
        "m",
        "chosen",
        "Distance of the area from the track: not directly below the orbit, but not too far away.",
    ),
    Knob(
        "LINES",
        simulated.LINES,
        "",
        "paper",
        "Length of a scene, from the 11 m between its width in the middle and the mean of its widths at both ends.",
    ),
    Knob(
        "TURNING, YAW_RATE",
        [simulated.TURNING, simulated.YAW_RATE],
        "as a share (0 to 1); rad/s",
        "fitted",
        "How much the scan keeps its angular speed while the range changes, and the turning rate of the line of "
        "pixels. The paper mentions both, but not their size.",
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
        "Position of every second point, so that some have neighbours within 600 m.",
    ),
    Knob(
        "SIGMA_IMAGE",
        simulated.SIGMA_IMAGE,
        "px per axis",
        "fitted",
        "Pointing noise: the root mean square of the four relative accuracies.",
        ("1|RPC affine, relative|*",),
    ),
    Knob("SIGMA_GROUND", simulated.SIGMA_GROUND, "m per axis", "chosen", "A GPS survey; it has no influence."),
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
        "Attitude: drift towards an end of the scene, each higher polynomial degree, and yaw at the ends of the line; "
        "from the residuals (root mean square) of shift and affine correction.",
        ("1|RPC shift|*", "1|RPC affine|*"),
    ),
    Knob(
        "DEGREES",
        simulated.DEGREES,
        "",
        "chosen",
        "Highest polynomial degree of the attitude error over a scene: periods down to some kilometres.",
    ),
    Knob(
        "ENHANCEMENT",
        rendering.ENHANCEMENT,
        "of the difference to the mean of 3 x 3 pixels",
        "chosen",
        "Strength of the vendor's edge enhancement; only the two statements on edges depend on it.",
    ),
    Knob(
        "QUICKBIRD",
        simulated.QUICKBIRD["side"],
        "m",
        "chosen",
        "Distance of the area from QuickBird's track; its altitude of 450 km is published.",
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
        "Drift and wobble of its attitude, from the residuals of a shift of the RPC compared with the improved "
        "3D affine model.",
        ("3.1|RPC shift|*",),
    ),
    Knob(
        "QuickBird's scan",
        "against the flight",
        "",
        "fitted",
        "From the simple 3D affine model, which is worse in Y than in X.",
        ("3.1|affine3d|*",),
    ),
)
