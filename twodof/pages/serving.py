"""A server thread for one page and its websocket, or for a websocket only.

It answers only requests from its own page and from named origins, so that other websites in the browser cannot read it.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import re
import secrets
import socket
import stat
import struct
from collections.abc import Awaitable, Callable, Collection
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from threading import Event, Thread

from ..errors import PageError
from ..version import needing

with needing(PageError, "show a page", "view"):
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.frames import DATA_OPCODES, Frame
    from websockets.http11 import Request, Response
    from websockets.protocol import Event as Received
    from websockets.protocol import State
    from websockets.typing import Subprotocol

HOST, PORT = "127.0.0.1", 8080
SLOW = 60.0  # s for the transfer of a page to a browser
CLOSING = 1.0  # s
LARGEST = 64 * 1024  # bytes of a message from a browser, or of its requests before a websocket is open
MOST_CONNECTIONS = 64
MOST_FRAGMENTS = 1000  # fragments of a message from a browser
PIECE = 64 * 1024  # bytes of a page that wait for a slow browser
LOOPBACK = ("127.0.0.1", "::1", "localhost")
REFUSED = "open this page at the printed address; the argument host gives it another address or name\n"
OTHER_USER = "only programs of the user who runs twodof are answered\n"
HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Connection": "close",
}
NOT_GET = b"HTTP/1.1 405 Method Not Allowed\r\nAllow: GET\r\nContent-Length: 0\r\n\r\n"
ANYWHERE = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}
"""Address of this machine in the URL of a server that listens on all addresses."""
Connection = ServerConnection
Talk = Callable[[Connection], Awaitable[None]]

_silent = logging.getLogger(__name__)  # log entries for foreign requests would confuse the user
_silent.setLevel(logging.CRITICAL + 1)


class Server:
    """A page that is served during the context.

    Args:
        page: HTML of the page; None: no page, and a websocket on any path.
        host, port: address to listen on; port 0: any free port.
        talk: handler of each websocket that the page opens; None: the page opens none.
        origins: other origins whose requests are answered.
        token: token that requests must have in their query; "": none.
        private: refuse other users of this machine, also without a token.
        protocol: subprotocol of the websocket.

    Attributes:
        url: URL of the page.

    Raises:
        PageError: the port is in use, or the host is not an address of this machine.
    """

    def __init__(
        self,
        page: bytes | None,
        host: str = HOST,
        port: int = PORT,
        talk: Talk | None = None,
        *,
        origins: Collection[str] = (),
        protocol: str | None = None,
        token: str = "",
        private: bool = False,
    ) -> None:
        self._query = f"token={token}" if token else ""
        self._private = private or bool(token)
        self._page, self._host, self._talk = page, host, talk
        self._origins, self._protocols = origins, protocol and [Subprotocol(protocol)]
        self._started = Event()
        self._socket, self._address = _listen(host, port)
        shown = ANYWHERE.get(self._address) or (f"[{host}]" if ":" in host else host)
        self.url = f"http://{shown}:{self._socket.getsockname()[1]}"
        self.url += f"/?{self._query}" if token else ""

    def __enter__(self) -> Server:
        self._thread = Thread(target=asyncio.run, args=(self._serve(),), daemon=True)
        self._thread.start()
        self._started.wait()
        return self

    def __exit__(self, *exception: object) -> None:
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join()

    async def _serve(self) -> None:
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        server = await serve(
            self._talked,
            sock=self._socket,
            process_request=self._answer,
            logger=_silent,
            compression=None,
            max_size=LARGEST,
            open_timeout=SLOW,
            close_timeout=SLOW,
            create_connection=_Answering,
            subprotocols=self._protocols or None,
        )
        self._started.set()
        await self._ended.wait()
        server.close()
        await asyncio.wait([asyncio.ensure_future(server.wait_closed())], timeout=CLOSING)

    async def _talked(self, connection: Connection) -> None:
        if self._talk is not None:
            with suppress(ConnectionClosed):
                await self._talk(connection)

    async def _answer(self, connection: Connection, request: Request) -> Response | None:
        if not _is_own(request, self._host, self._address, self._origins):
            return connection.respond(HTTPStatus.FORBIDDEN, REFUSED)
        if self._private and _is_of_another_user(connection):
            return connection.respond(HTTPStatus.FORBIDDEN, OTHER_USER)
        if self._page is None:
            return None
        path, _, query = request.path.partition("?")
        if self._query and not secrets.compare_digest(query.encode(errors="surrogateescape"), self._query.encode()):
            return connection.respond(HTTPStatus.FORBIDDEN, REFUSED)
        path = path if self._query else request.path
        if path == "/socket" and self._talk is not None:
            return None
        if path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "there is one page, /\n")
        await self._send_page(self._page, connection)
        return None

    async def _send_page(self, page: bytes, connection: Connection) -> None:
        """Send the page in pieces, so that a slow browser takes no memory, and wait for the end of the connection."""
        headers, pieces = Headers(HEADERS), memoryview(page)
        headers["Content-Length"] = str(len(page))
        connection.transport.write(Response(HTTPStatus.OK.value, "OK", headers).serialize())
        for k in range(0, len(page), PIECE):
            await connection.drain()
            if connection.transport.is_closing():
                return
            connection.transport.write(pieces[k : k + PIECE])
        connection.transport.write_eof()
        await connection.wait_closed()


class _Answering(ServerConnection):
    """A connection that answers requests which the websockets library would drop."""

    _asked = False
    _size = 0  # bytes of requests
    _answers = 0  # bytes of answers to pings that wait for a slow client
    _fragments = 0  # of the message that is being received

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Open a connection; if there are too many, end the oldest one that is not yet an open websocket."""
        super().connection_made(transport)
        present = [it for it in self.server.handlers if not it.transport.is_closing()]
        if len(present) > MOST_CONNECTIONS:
            next(it for it in present if it.state is State.CONNECTING).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Receive data, which begins with a request of limited size."""
        self._size += len(data) if self.state is not State.OPEN else 0
        if self._size > LARGEST:
            self.transport.abort()
        elif self._asked or b"GET ".startswith(data[:4]):
            self._asked = True
            waiting = self.transport.get_write_buffer_size()
            super().data_received(data)
            grown = self.transport.get_write_buffer_size() - waiting
            self._answers = self._answers + grown if waiting else grown
            if self.state is State.OPEN and self._answers > LARGEST:
                self.transport.abort()
        else:
            self.transport.write(NOT_GET)
            self.transport.close()

    def process_event(self, event: Received) -> None:
        """Receive a frame; end a connection whose message has too many fragments, which may be empty."""
        if isinstance(event, Frame) and event.opcode in DATA_OPCODES:
            self._fragments = 0 if event.fin else self._fragments + 1
            if self._fragments > MOST_FRAGMENTS:
                self.transport.abort()
                return
        super().process_event(event)


def user_token() -> str:
    """Return the user's stored token, which later servers use too; if it cannot be stored, return a new one."""
    with suppress(OSError, RuntimeError):
        home = os.environ.get("XDG_STATE_HOME") or Path("~/.local/state").expanduser()
        path, private = Path(home, "twodof", "token"), partial(os.open, mode=0o600)
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with suppress(FileExistsError), open(path, "x", opener=private) as file:
            file.write(secrets.token_urlsafe(32))
        with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)) as file:
            state, kept = os.fstat(file.fileno()), file.read(100)
        own = stat.S_ISREG(state.st_mode) and state.st_uid == os.getuid()
        if own and not state.st_mode & 0o077 and re.fullmatch(r"[\w-]{43}", kept, re.ASCII):
            return kept
    return secrets.token_urlsafe(32)


def _is_own(request: Request, host: str, address: str, others: Collection[str] = ()) -> bool:
    """Return whether a request is for this page, by its Host and Origin.

    A website can let its own name resolve to this machine (DNS rebinding); its Origin then equals the Host. Therefore
    only known names are accepted. A numeric address is not resolved, so a server on all addresses accepts any address.

    Args:
        host, address: the given host to listen on, and its resolved address.
        others: other permitted origins.
    """
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    foreign = any(it not in others and it.partition("://")[2] not in hosts for it in origins)
    if len(hosts) != 1 or foreign:
        return False
    name = re.sub(r":\d+$", "", hosts[0].lower()).strip("[]")
    listening = ip_address(address)
    if listening.is_unspecified:
        return name in (*LOOPBACK, socket.gethostname().lower()) or _is_address(name)
    return name in (host.lower(), address) or (listening.is_loopback and name in LOOPBACK)


def _is_of_another_user(connection: Connection) -> bool:
    """Return whether a request comes from another user of this machine, who may know the token.

    A browser is started with the page's URL on its command line, which every user of the machine can read. Linux lists
    the owner of each socket, and inode 0 after its program has closed it. Root counts as the same user, and if this
    process runs as root, every user does: in a container, root serves the desktop's user. Source: proc_net_tcp(5).
    """
    user, rows = os.geteuid(), list[list[str]]()
    for table in ("tcp", "tcp6"):
        with suppress(OSError):  # not Linux, or no IPv6
            rows += [line.split() for line in Path("/proc/net", table).read_text("ascii").splitlines()[1:]]
    if user == 0 or not rows:
        return False
    (peer, peers), (_, own) = (_listed(*end[:2]) for end in (connection.remote_address, connection.local_address))
    owners = [(int(row[7]), row[9]) for row in rows if row[1] in peers and row[2] in own]
    closed = not owners and peer.is_loopback
    return closed or any(owner not in (0, user) or inode == "0" for owner, inode in owners)


def _listed(host: str, port: int) -> tuple[IPv4Address | IPv6Address, Collection[str]]:
    """Return an address without its zone, as IPv4 if it is mapped, and its forms in Linux's lists of sockets."""
    address = ip_address(host.partition("%")[0])
    address = getattr(address, "ipv4_mapped", None) or address
    forms = (address.packed, bytes(10) + b"\xff\xff" + address.packed)
    return address, [
        f"{''.join(f'{word:08X}' for (word,) in struct.iter_unpack('=I', form))}:{port:04X}" for form in forms
    ]


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _listen(host: str, port: int) -> tuple[socket.socket, str]:
    """Return a bound socket, and its address."""
    if not 0 <= port <= 65535:
        raise PageError(f"port {port} is not in 0…65535")
    if not host:  # an empty host would mean all addresses
        raise PageError("`host` is empty; 0.0.0.0 is all addresses of this machine")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        bound = socket.socket(family, kind, protocol)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen()
    except UnicodeError as error:
        raise PageError(f"cannot listen on {host}:{port}: {error}") from error
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise PageError(
                f"port {port} of {host} is in use; choose another with `port`, or 0 for any that is free"
            ) from error
        raise PageError(f"cannot listen on {host}:{port}: {error.strerror or error}") from error
    return bound, str(address[0])
