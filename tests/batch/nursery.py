"""Workers as processes of their own, that begin at once: one process loads what they need and forks them.

fork {"file": …, "address": …, "shard": [1, 2], "patience": 2.0, "said": …}   prints the id of the process
wait ID                                                                       prints how it ended
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

from ortho_pipeline.batch import runner
from ortho_pipeline.batch.shared.run import SharedFolder


def work(given: dict[str, Any]) -> None:
    """Make the scenes of a part and say what came of each."""
    store = SharedFolder(given["address"], allow_network=True, patience=given["patience"])
    shard = None if given["shard"] is None else tuple(given["shard"])
    result = runner.run(
        given["file"], executor="sequential", threads=1, shard=shard, allow_network=True, store=store
    )  # fmt: skip
    with open(given["said"], "w", encoding="utf-8") as file:
        json.dump({one.name: one.status for one in result.scenes}, file)


def main() -> None:
    """Do what is asked, line by line."""
    for line in sys.stdin:
        order, _, rest = line.strip().partition(" ")
        if order == "wait":
            print(os.waitpid(int(rest), 0)[1], flush=True)
            continue
        process = os.fork()
        if not process:
            code = 1
            try:
                work(json.loads(rest))
                code = 0
            finally:
                sys.stderr.flush()
                os._exit(code)
        print(process, flush=True)


if __name__ == "__main__":
    main()
