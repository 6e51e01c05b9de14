"""What this process has read over the network, by GDAL and by the client of stores."""

from __future__ import annotations

import json
import threading

#: GDAL's switch for its counts.
COUNTING = {"CPL_VSIL_NETWORK_STATS_ENABLED": "YES"}
_lock = threading.Lock()
_own = [0]


def count(size: int) -> None:
    """Note bytes that GDAL does not know of."""
    with _lock:
        _own[0] += size


def bytes_read() -> int:
    """Return how many bytes have been read so far. GDAL does not count each of the requests that it sends together."""
    from osgeo import gdal

    methods = json.loads(gdal.NetworkStatsGetAsSerializedJSON() or "{}").get("methods", {})
    with _lock:
        return _own[0] + sum(int(method.get("downloaded_bytes", 0)) for method in methods.values())
