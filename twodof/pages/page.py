"""A page in the browser: a scene in 3D with a target and lines, controls, a readout, plots.

viser is a web server of its own thread; all of it is here. What is set on a page is shown in every
browser that has it open.
"""

from __future__ import annotations

import errno
import html
import re
import socket
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
from io import StringIO
from ipaddress import ip_address
from math import ceil, floor, log10, pi, tan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PageError

try:
    import viser
    import websockets.asyncio.server
except ImportError as missing:
    raise PageError(
        f"cannot show a page: {missing}; install the package 'viser' (the extra 'view')"
    ) from missing

Array = NDArray[np.float64]

HOST, PORT = "127.0.0.1", 8080
RATE = 30.0  # Hz, of what moves
PLOT_RATE = 4.0  # Hz, of what is drawn anew
TARGET, TRAIL, PATH = (213, 94, 0), (0, 114, 178), (170, 180, 190)
FIELD_OF_VIEW = 0.6  # rad, vertical
LOOPBACK = ("127.0.0.1", "::1", "localhost")
REFUSED = "open this page as twodof prints it; --host gives it another address or name\n"


class Page:
    """A page that is served as long as its context lasts.

    Args:
        title: of the control panel.
        host, port: where to listen; port 0: any that is free.

    Attributes:
        gui, scene: viser's interfaces to the control panel and to the 3D scene.

    Raises:
        PageError: the port is in use, or the host is not this machine's.
    """

    def __init__(self, title: str, host: str = HOST, port: int = PORT) -> None:
        address = _resolve(host, port)
        with _quiet(), _own_pages(host, address):  # viser prints a table
            self._server = _Server(host=host, port=port, label=_text(title), verbose=False)
        self.gui: Any = self._server.gui
        self.scene = self._server.scene
        if port and self._server.get_port() != port:  # taken since: viser has gone on to the next
            self.close()
            raise _in_use(host, port)
        shown = "127.0.0.1" if host in ("0.0.0.0", "") else f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._server.get_port()}"
        self.gui.configure_theme(
            control_width="large", show_logo=False, show_share_button=False, dark_mode=False
        )
        self.gui.main_panel.dock_right()
        self.scene.configure_environment_map(None)  # it is slow where the browser has no GPU
        self.scene.configure_default_lights(False)
        self.scene.world_axes.visible = False

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop serving."""
        with _quiet():
            self._server.stop()

    @property
    def viewers(self) -> int:
        """Number of browsers that have the page open."""
        return len(self._server.get_clients())

    def atomic(self) -> Any:
        """A context whose changes browsers show at once."""
        return self._server.atomic()

    def notify(self, title: str, text: str) -> None:
        """Tell all browsers, until it is read."""
        for client in self._server.get_clients().values():
            client.add_notification(title, _text(text), auto_close_seconds=8.0)

    def add_text(self, text: str) -> None:
        """Text in the control panel, whatever it holds: viser's markdown would be HTML."""
        self.gui.add_html(
            '<div style="font-size:12.5px;margin:2px 10px;overflow-wrap:anywhere">'
            f"{html.escape(_text(text))}</div>"
        )

    def frame(self, points: Array, axes: str, up: Sequence[float]) -> float:
        """Place the camera so that points (N × 3, m) fill the picture; the size of what is seen, m.

        Args:
            points: what must be seen.
            axes: the task axes; two of them are a plane, which is seen from the front.
            up: what points upwards, three values.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        size = max(float(np.linalg.norm(high - low)), 1e-3)
        centre = (low + high) / 2
        vertical = np.eye(3)[int(np.argmax(np.abs(up)))] * (np.sign(up)[np.argmax(np.abs(up))])
        plane = axes if len(axes) == 2 else ""
        if plane:
            front = np.eye(3)["xyz".index(({*"xyz"} - {*plane}).pop())]
            if not front @ vertical:
                right = np.cross(vertical, front)
                front *= 1.0 if right.sum() > 0 else -1.0  # the axis across points to the right
            else:
                front, vertical = vertical, np.eye(3)["xyz".index(plane[1])]
        else:
            across = np.roll(np.abs(vertical), 1)
            front = across * 1.0 - 1.0 * np.cross(vertical, across) + 0.55 * vertical
            front /= np.linalg.norm(front)
        self.scene.set_up_direction(tuple(vertical))
        distance = 0.62 * size / tan(FIELD_OF_VIEW / 2)
        camera = self._server.initial_camera
        camera.fov = FIELD_OF_VIEW
        camera.near = distance / 100
        camera.far = distance * 100
        camera.up = vertical
        camera.position = centre + distance * front
        camera.look_at = centre
        light = front + 0.6 * vertical - 0.5 * np.cross(vertical, front)
        self.scene.add_light_ambient("/ambient", intensity=1.3)
        self.scene.add_light_directional("/light", intensity=2.2, position=tuple(light))
        self._add_grid(centre, low, size, front if plane else vertical)
        return size

    def _add_grid(self, centre: Array, low: Array, size: float, normal: Array) -> None:
        cell = 0.5 * 10.0 ** floor(log10(size))
        k = int(np.argmax(np.abs(normal)))
        position = np.round(centre / cell) * cell
        position[k] = 0.0 if low[k] > -0.1 * size else low[k]
        position[k] -= np.sign(normal[k]) * 0.06 * size
        width = 8 * cell * max(1, ceil(size / cell))
        self.scene.add_grid(
            "/grid", width, width, plane=("yz", "xz", "xy")[k], position=tuple(position),
            cell_size=cell, section_size=2 * cell, cell_color=(222, 227, 232),
            section_color=(196, 204, 212), fade_distance=12 * size, shadow_opacity=0.0,
        )  # fmt: skip

    def add_target(self, size: float, axes: str, draggable: bool, turns: bool) -> Any:
        """The target's marker; where ``draggable``, with handles along the task axes.

        Where it ``turns``, it has axes of its own, and rings to turn it by.
        """
        active = ("x" in axes, "y" in axes, "z" in axes)
        handle: Any
        if draggable:
            handle = self.scene.add_transform_controls(
                "/target", scale=0.17 * size, active_axes=active, disable_rotations=not turns,
                depth_test=False, line_width=4.0, opacity=0.85,
            )  # fmt: skip
        else:
            handle = self.scene.add_frame("/target", show_axes=False)
        if turns:
            self.add_axes("/target/axes", size)
        front = np.zeros(3)
        circles = [(0, 1), (1, 2), (2, 0)]
        if len(axes) == 2:
            plane = ["xyz".index(axis) for axis in axes]
            circles = [(plane[0], plane[1])]
            if not draggable:  # what is across the plane is free: the marker is before the robot
                front[3 - sum(plane)] = 0.12 * size
        self.scene.add_icosphere(
            "/target/ball", 0.011 * size, color=TARGET, position=front, cast_shadow=False
        )
        angles = np.linspace(0.0, 2 * pi, 49)
        for i, (a, b) in enumerate(circles):
            circle = np.tile(front, (len(angles), 1))
            circle[:, a] += 0.035 * size * np.cos(angles)
            circle[:, b] += 0.035 * size * np.sin(angles)
            self.add_line(f"/target/circle{i}", TARGET, 3.0).show(circle)
        return handle

    def add_axes(self, name: str, size: float) -> None:
        """The axes x, y, z of a node of the scene, red, green, blue."""
        self.scene.add_frame(name, axes_length=0.1 * size, axes_radius=0.002 * size)

    def add_line(self, name: str, colour: tuple[int, int, int], width: float) -> Line:
        """A line through points that are yet to come; width in pixels."""
        return Line(self.scene, name, colour, width)

    def recording(self, frames: Iterator[float], title: str) -> bytes:
        """One HTML file that replays the scene offline.

        Args:
            frames: sets the scene for one frame after the other; gives each one's duration, s.
            title: of the window.
        """
        serializer = self._server.get_scene_serializer()
        for duration in frames:
            serializer.insert_sleep(duration)
        text: str = serializer.as_html()
        title = html.escape(_text(title))
        return text.replace("<title>Viser</title>", f"<title>{title}</title>").encode()


class _Server(viser.ViserServer):  # type: ignore[misc, unused-ignore]
    """viser's server, which pages cannot ask to become public."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class Line:
    """A line in the scene."""

    def __init__(
        self, scene: viser.SceneApi, name: str, colour: tuple[int, int, int], width: float
    ) -> None:
        nothing = np.zeros((1, 2, 3), dtype=np.float32)
        self._handle = scene.add_line_segments(
            name, nothing, colour, thickness=width, thickness_units="screen"
        )

    def show(self, points: Array) -> None:
        """Draw it through points, N × 3; a single one is nothing."""
        pairs = points if len(points) > 1 else np.repeat(points, 2, axis=0)
        self._handle.points = np.stack([pairs[:-1], pairs[1:]], axis=1).astype(np.float32)


# --- the server ---


@contextmanager
def _quiet() -> Iterator[None]:
    with redirect_stdout(StringIO()):
        yield


@contextmanager
def _own_pages(host: str, address: str) -> Iterator[None]:
    """Where viser begins to serve: its own page alone, and that to its own requests alone."""
    serve = websockets.asyncio.server.serve

    def guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if not _is_own(request, host, address):
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSED)
            return process_request(connection, request)

        return serve(*arguments, process_request=answer, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _is_own(request: Any, host: str, address: str) -> bool:
    """Whether a request is for the plain page, by what was asked to listen on, and not another's.

    Any website may have its own name resolve to this machine, and then its Origin is the Host that
    it asks for. An address is not resolved, so where all are listened on, any is good. And a link
    with parameters may have viser's page run the scripts of another server.

    Args:
        request: what is asked for.
        host, address: what was asked to listen on, and what that is resolved to.
    """
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    foreign = any(origin.partition("://")[2] not in hosts for origin in origins)
    if len(hosts) != 1 or foreign or "?" in request.path:
        return False
    name = re.sub(r":\d+$", "", hosts[0].lower()).strip("[]")
    listening = ip_address(address)
    if listening.is_unspecified:
        return name in (*LOOPBACK, socket.gethostname().lower()) or _is_address(name)
    return name in (host.lower(), address) or (listening.is_loopback and name in LOOPBACK)


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _resolve(host: str, port: int) -> str:
    """The address to listen on, as long as it is free.

    viser would try a thousand ports, one after the other, whatever is wrong.
    """
    if not 0 <= port <= 65535:
        raise PageError(f"port {port} is not in 0…65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as probe:
            if sys.platform != "win32":
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise _in_use(host, port) from error
        raise PageError(f"cannot listen on {host}:{port}: {error.strerror or error}") from error
    return str(address[0])


def _text(text: str) -> str:
    """A text as it can be sent; names of files need not be UTF-8."""
    return text.encode("utf-8", "replace").decode()


def _in_use(host: str, port: int) -> PageError:
    return PageError(
        f"port {port} of {host} is in use; choose another with `port`, or 0 for any that is free"
    )
