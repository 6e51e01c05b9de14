"""Whether the predicted accuracy of an ortho is true: simulated scenes whose errors are known, and what is predicted.

    python benchmarks/accuracy.py --scenes 1000      four sensors, shift and affine in turn; 20 minutes on one core

Each scene has 10 to 30 control points with noise, and a DEM with smooth errors of 1 to 12 m (50 m to 3 km long). Of 60
pixels of its ortho the true ground is where the true camera's ray meets the true terrain (tests/layers/erring.py). A
line for each sensor and correction: the spread of errors over their predicted standard deviations east and north, which
is 1 if these are right, and the share of errors within the predicted ce90, which is 0.9.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "layers"))
from erring import SENSORS, Trial, pooled, trial


def line(name: str, trials: list[Trial]) -> str:
    """Return what trials come to."""
    found = pooled(trials)
    return (
        f"{name:20s} {len(trials):5d} scenes  east {found['east']:.3f}  north {found['north']:.3f}  "
        f"within ce90 {100 * found['within']:.1f} %"
    )


def main() -> None:
    """Print a line for each sensor and correction, and for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene of each sensor")
    options = parser.parse_args()
    everything: list[Trial] = []
    for sensor in SENSORS:
        made = [trial(sensor, options.first + k) for k in range(options.scenes // len(SENSORS))]
        # Even seeds are shifts.
        even = options.first % 2
        for name, some in (("shift", made[even::2]), ("affine", made[1 - even :: 2])):
            print(line(f"{sensor}, {name}", some), flush=True)
        everything += made
    print(line("all", everything))


if __name__ == "__main__":
    main()
