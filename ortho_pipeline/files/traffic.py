"""What this process has read over the network, by GDAL and by the client of stores."""

from __future__ import annotations

import json
import os
import threading

#: GDAL's switch for its counts.
_COUNTING = "CPL_VSIL_NETWORK_STATS_ENABLED"
_lock = threading.Lock()
_own = [0]


def count(size: int) -> None:
    """Note bytes that GDAL does not know of."""
    with _lock:
        _own[0] += size


def count_gdal() -> None:
    """Let GDAL count, unless the environment says otherwise.

    GDAL reads its switch at the first request of a process, which may have been made for others: it has to read again.
    """
    from osgeo import gdal

    with _lock:
        if _COUNTING not in os.environ:
            os.environ[_COUNTING] = "YES"
            _own[0] += _of_gdal()
            gdal.NetworkStatsReset()


def bytes_read() -> int:
    """Return how many bytes have been read so far. GDAL does not count each of the requests that it sends together."""
    with _lock:
        return _own[0] + _of_gdal()


def _of_gdal() -> int:
    from osgeo import gdal

    methods = json.loads(gdal.NetworkStatsGetAsSerializedJSON() or "{}").get("methods", {})
    return sum(int(method.get("downloaded_bytes", 0)) for method in methods.values())
