"""Worker processes, and the connection to a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import threading
from typing import Any

#: time limits for a Dask cluster to answer, and to have a worker (s)
PATIENCE = 60


def end_with_parent() -> None:
    """End this worker with its parent: a worker that waits for jobs does not notice the parent's end."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def dask_client(address: str, error: type[Exception]) -> Any:
    """Return a client of a Dask cluster that has workers; failures are raised as `error`, in one line."""
    try:
        from distributed import Client
    except ImportError:
        raise ImportError("a Dask cluster needs dask: pip install 'knode-cosserat[dask]'") from None
    try:
        # not the default for whatever else in this process can use Dask, such as writing files
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as reason:
        raise error(f"no Dask scheduler answers at {address!r}: {reason}") from None
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError:
        client.close()
        raise error(f"the Dask cluster at {address!r} has no workers") from None
    return client
