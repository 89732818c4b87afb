"""Whether an address is one of a Dask scheduler, asked before anything is built on it.

A ``distributed.Client`` waits for ever for the greeting of a program that takes the connection
and is no scheduler, and one that could not be made complains when it is collected.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from .errors import SchedulerError, need

__all__ = ["insist_on_scheduler"]

# What part of the time may pass before there is a connection; the rest is for an answer.
_CONNECTING = 0.8


def insist_on_scheduler(address: Any, seconds: float) -> None:
    """Insist that a scheduler answers at an address.

    Parameters
    ----------
    address : str
        Such as ``tcp://10.0.0.1:8786``.
    seconds : float
        After which nobody is waited for any longer.

    Raises
    ------
    SchedulerError
        If it is no address, nobody answers, or it is no scheduler that answers.
    InvalidInputError
        If distributed is not installed.
    """
    distributed = need("distributed", "a study on a cluster", "dask")
    _insist_on_form(address)
    # In a thread of its own: there may be an event loop in this one already.
    with ThreadPoolExecutor(1) as thread:
        try:
            identity = thread.submit(
                asyncio.run, _identity(distributed, address, seconds)
            ).result()
        except Exception as error:  # who knows what answers, and with what
            said = f"nothing came within {seconds:g} s" if (
                isinstance(error, TimeoutError) and not str(error)
            ) else str(error) or type(error).__name__
            raise SchedulerError(
                f"no Dask scheduler answers at {address!r} ({said}); start one with 'dask "
                "scheduler' and workers with 'dask worker ADDRESS --nthreads 1', and check the "
                "address."
            ) from error
    if "workers" not in identity:
        raise SchedulerError(
            f"a Dask {str(identity.get('type', 'program')).lower()} answers at {address!r}, not a "
            f"scheduler; give the scheduler's address"
            f"{', ' + repr(identity['scheduler']) if 'scheduler' in identity else ''}."
        )


def _insist_on_form(address: Any) -> None:
    from distributed.comm.addressing import parse_address, parse_host_port
    from distributed.comm.registry import get_backend

    try:
        if not isinstance(address, str):
            raise TypeError("it is no text")
        scheme, place = parse_address(address)
        get_backend(scheme)
        host, port = ("here", 1) if scheme == "inproc" else parse_host_port(place.partition("/")[0])
        if not host or not 0 < port < 65536:
            raise ValueError("host or port are missing")
    except (TypeError, ValueError) as error:
        raise SchedulerError(
            f"the scheduler's address is {address!r} ({error}); expected the one that 'dask "
            "scheduler' shows when it starts, such as tcp://10.0.0.1:8786."
        ) from error


async def _identity(distributed: Any, address: str, seconds: float) -> dict[str, Any]:
    async def asked() -> Any:
        arguments = distributed.Security().get_connection_args("client")
        async with distributed.rpc(
            address, timeout=_CONNECTING * seconds, connection_args=arguments
        ) as server:
            return await server.identity()

    answer = await asyncio.wait_for(asked(), seconds)
    return answer if isinstance(answer, dict) else {}
