"""A Dask cluster that runs already. Only this module imports Dask, and only where it is asked for."""

from __future__ import annotations

import logging
from importlib.metadata import version
from typing import Any

from .errors import UserError

#: What a machine lacks that cannot speak to a cluster.
INSTALL = "needs Dask: pip install 'triline[cluster]'"
#: So long is waited for a scheduler to answer, s.
CONNECT_S = 15.0


def connect(address: str, name: str, timeout_s: float | None = None) -> tuple[Any, Any]:
    """The module `distributed`, and a client of it.

    Parameters
    ----------
    address : of the scheduler, ``tcp://HOST:PORT``
    name : of the client, for the cluster's own log
    timeout_s : for which an answer is waited for; None is `CONNECT_S`

    Raises
    ------
    UserError : Dask is not installed, nobody answers there, or the workers have another triline
    """
    try:
        import distributed
        from distributed.comm import parse_address, registry
    except ImportError:
        raise UserError(f"--scheduler {address}: {INSTALL}") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is said here
    wait_s = CONNECT_S if timeout_s is None else timeout_s
    try:
        registry.get_backend(parse_address(address)[0])  # a client that cannot begin waits long before it ends
        client: Any = distributed.Client(address, timeout=wait_s, set_as_default=False, name=name)
    except (OSError, ValueError) as error:  # what takes too long is an OSError, too
        what = "nobody answers there" if isinstance(error, OSError) else str(error)
        raise UserError(f"--scheduler {address}: {what}, wanted a Dask scheduler") from None
    try:
        wanted = version("triline")
        for worker, held in client.run(_version).items():
            if held != wanted:
                has = f"triline {held}" if held else "no triline"
                raise UserError(f"--scheduler {address}: worker {worker} has {has}, wanted {wanted} as here")
    except BaseException:
        client.close(timeout=3)
        raise
    return distributed, client


def current_worker() -> Any:
    """The worker that runs what asks."""
    from distributed import get_worker

    return get_worker()


def _version() -> str:
    """The version of triline on a worker, "" without one."""
    try:
        return version("triline")
    except Exception:
        return ""
