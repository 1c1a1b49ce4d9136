"""Pass messages between a websocket and a server of this process that no other process can reach."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import stat
import struct
import sys
from contextlib import suppress
from itertools import count, permutations

from ..errors import PageError
from ..version import needing

with needing(PageError, "relay messages", "foxglove"):
    from websockets.asyncio.client import connect
    from websockets.asyncio.connection import Connection
    from websockets.asyncio.server import ServerConnection
    from websockets.exceptions import ConnectionClosed

BURST, PAUSE = 20, 0.1  # messages that a relay takes from a client between two pauses, and a pause, s
TCP_MD5SIG_EXT = 32  # on Linux, from kernel 4.13
_silent = logging.getLogger(__name__)  # log entries for foreign messages would confuse the user
_silent.setLevel(logging.CRITICAL + 1)


def lock_port(address: tuple[str, int], key: bytes) -> bool:
    """Let only ``relay`` with this key connect to a port on which this process listens; return whether Linux can.

    Linux then drops all TCP segments without the signature of RFC 2385, also of accepted connections.
    """
    signed = []
    for number in map(int, os.listdir("/proc/self/fd") * 2 if sys.platform == "linux" else ()):  # the listener first
        with suppress(OSError):  # closed meanwhile
            if stat.S_ISSOCK(os.fstat(number).st_mode):
                with socket.socket(fileno=os.dup(number)) as one:
                    if one.family == socket.AF_INET and one.getsockname() == address:
                        signed.append(_sign(one, key))
    return all(signed) and bool(signed)


def _sign(one: socket.socket, key: bytes) -> bool:
    """Make a socket sign its segments and drop unsigned ones; return False if it cannot. Source: linux/tcp.h."""
    any_address = struct.pack("=H126x", socket.AF_INET)
    try:
        one.setsockopt(
            socket.IPPROTO_TCP, TCP_MD5SIG_EXT, any_address + struct.pack("=BBHi80s", 1, 0, len(key), 0, key)
        )
    except OSError:
        return False
    return True


async def relay(address: tuple[str, int], key: bytes, connection: ServerConnection) -> None:
    """Pass messages between a websocket and a server of this process, until one of them closes.

    Args:
        key: key with which ``lock_port`` has locked it; b"": not locked.
    """
    protocols = [connection.subprotocol] if connection.subprotocol else None
    inner = socket.socket()
    if key:
        _sign(inner, key)
    inner.connect(address)  # of this process: it does not wait
    url, taken = f"ws://{address[0]}:{address[1]}", count(1)
    async with connect(
        url, sock=inner, subprotocols=protocols, compression=None, max_size=None, proxy=None, logger=_silent
    ) as other:

        async def pump(source: Connection, sink: Connection) -> None:
            with suppress(ConnectionClosed):
                async for message in source:
                    await sink.send(message)
                    if sink is other and next(taken) % BURST == 0:  # a flood would delay the run
                        await asyncio.sleep(PAUSE)

        pumps = [asyncio.ensure_future(pump(*ends)) for ends in permutations((connection, other))]
        await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        for one in pumps:
            one.cancel()
