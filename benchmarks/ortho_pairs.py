"""Draw pairs of orthos of known truth, verify each, and count: errors, coverage of intervals, refusals, wrong results.

    python benchmarks/ortho_pairs.py --seeds 0:40 --out drawn.jsonl
    python benchmarks/ortho_pairs.py --seeds 0:60 --elsewhere --out elsewhere.jsonl
    python benchmarks/ortho_pairs.py --read drawn.jsonl

Each seed is an independent draw (`drawn` of tests/orthos/pairs.py). What calibrates a method and what tests it must be
different seeds: 1000 to 1999 calibrate, from 20000 on they test (5000 to 7059 tested an earlier state).
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT / "tests" / "matching"), str(ROOT / "tests" / "orthos")]

from drawn_trials import told, trial  # noqa: E402


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:20", help="first:last, the last not included")
    parser.add_argument("--elsewhere", action="store_true", help="references of other places: all must be refused")
    parser.add_argument("--out", type=Path, help="a line of JSON for each pair")
    parser.add_argument("--read", type=Path, nargs="*", help="only count what such files say")
    given = parser.parse_args()
    if given.read:
        rows = [json.loads(line) for path in given.read for line in path.read_text().splitlines()]
    else:
        first, last = map(int, given.seeds.split(":"))
        rows = []
        for seed in range(first, last):
            rows.append(trial(seed, elsewhere=given.elsewhere))
            if given.out:
                with given.out.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
    print(told(rows))


if __name__ == "__main__":
    main()
