"""Serve a run to Foxglove without ROS: the bag's messages over a WebSocket, and gains as parameters.

Foxglove's SDK answers any website and user. Therefore it listens on a random address of the loopback network, where
the kernel drops all segments without the signature of this process. The server of ``serving``, which checks the origin
and the user of requests, answers Foxglove and relays the messages.
"""

from __future__ import annotations

import logging
import os
import secrets
import sys
from collections.abc import Callable, Mapping
from functools import partial
from threading import Lock

from ..errors import InputError, PageError, PublishError
from ..plant.variables import GAINS
from ..ros.cdr import Rows
from ..ros.commands import warner
from ..ros.messages import Messages, definition
from ..signatures import ignore, never
from ..simulation.experiments import Experiment
from ..simulation.input_values import Value, check_going_on, resolve
from ..simulation.pace import RealTime
from ..simulation.sample import Sample, Sink
from ..version import needing
from .relay import lock_port, relay
from .serving import HOST, Server

with needing(PublishError, "serve Foxglove", "foxglove"):
    from foxglove import Channel, Context, Parameter, Schema, start_server
    from foxglove.websocket import Capability, ServerListener

Parameters = list[Parameter]
LOG = logging.getLogger(__name__)
PORT = 8765
PROTOCOL = "foxglove.sdk.v1"
APPS = ("https://app.foxglove.dev", "https://embed.foxglove.dev", "file://")
"""Origins of Foxglove's web app, its embedded viewer and its desktop app."""
logging.getLogger("foxglove.websocket").setLevel(logging.CRITICAL + 1)  # it would log a line for each bad message


class Foxglove(Sink):
    """A sink that serves each sample to Foxglove, on the loopback interface only.

    The gains are parameters, which Foxglove's Parameters panel shows and, with ``set_gains``, sets.

    Args:
        port: port; 0: any free port.
        scene: add the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.
        set_gains: allow programs of this user to set the gains; programs of other users are refused on Linux.
        opened: called when the server listens.

    Attributes:
        url: URL of the WebSocket, known when the server listens.

    Raises:
        PublishError: the server cannot listen on the port.
    """

    def __init__(
        self,
        port: int = PORT,
        *,
        scene: bool = False,
        effort: bool = False,
        set_gains: bool = False,
        opened: Callable[[Foxglove], None] = ignore,
    ) -> None:
        self._port, self._opened, self.url = port, opened, ""
        self._scene, self._effort, self._set_gains = scene, effort, set_gains

    def begin(self, run: Experiment) -> Foxglove:
        """Receive the experiment of the following samples; BagError: the FMU lacks a requested output."""
        self._messages = Messages(run, scene=self._scene, effort=self._effort)
        self._gains = _Gains(run, self._set_gains)
        return self

    def __enter__(self) -> Foxglove:
        context = self._context = Context()  # a reference, which its channels do not hold
        self._channels = {}
        for name, topic in self._messages.topics.items():
            schema = Schema(name=topic.type, encoding="ros2msg", data=definition(topic.type).encode())
            self._channels[name] = Channel(name, schema=schema, message_encoding="cdr", context=context)
        hidden = f"127.{'.'.join(str(1 + secrets.randbelow(254)) for _ in range(3))}"
        private, key = self._set_gains, secrets.token_bytes(32)
        try:
            self._server = start_server(
                name="twodof",
                host=hidden,
                port=0,
                context=context,
                capabilities=[Capability.Parameters],
                server_listener=self._gains,
            )
            try:
                address = hidden, self._server.port
                locked = lock_port(address, key)
                if private and sys.platform == "linux" and os.geteuid() and not locked:
                    raise OSError(
                        "this kernel has no TCP_MD5SIG, so other users could set gains: leave out `set_gains=True`"
                    )
                talk = partial(relay, address, key if locked else b"")
                self._door = Server(None, HOST, self._port, talk, origins=APPS, protocol=PROTOCOL, private=private)
            except BaseException:
                self._server.stop()
                raise
        except (RuntimeError, OSError, PageError) as error:
            raise PublishError(f"cannot serve Foxglove: {error}") from error
        self._door.__enter__()
        self.url = self._door.url.replace("http:", "ws:")
        self._opened(self)
        return self

    def write(self, sample: Sample) -> None:
        """Send one sample, and latched messages to new subscribers."""
        self._gains.held = sample.inputs
        if sample.k == 0:
            self._latched = self._messages.latched(sample.stamp)
        if self._gains.greet():
            self._send(self._latched, sample.stamp)
        self._send(self._messages.of(sample), sample.stamp)

    def _send(self, messages: Mapping[str, Rows], stamp: int) -> None:
        for name, rows in messages.items():
            self._channels[name].log(rows.tobytes(), log_time=stamp)

    def command(self, stop: Callable[[], bool] = never, pace: RealTime | None = None) -> dict[str, Value]:
        """Return the gains that were set since the last call, as inputs of the FMU."""
        return self._gains.take()

    def __exit__(self, *exception: object) -> None:
        self._door.__exit__(*exception)
        self._server.stop()


class _Gains(ServerListener):
    """Gains as parameters; threads of the server call its methods."""

    def __init__(self, run: Experiment, control: bool) -> None:
        self._fmu, self._control, self._warn = run.fmu, control, warner(LOG)
        self.held: Mapping[str, Value] = run.start_values
        groups = {group: run.fmu.vector(group) or [group] for group in GAINS}
        self._groups = {g: names for g, names in groups.items() if names[0] in run.fmu.variables}
        self._lock, self._asked, self._new = Lock(), dict[str, Value](), False

    def on_subscribe(self, client: object, channel: object) -> None:
        """Register a subscription to a topic."""
        self._new = True

    def greet(self) -> bool:
        """Return whether anyone has subscribed since the last call."""
        new, self._new = self._new, False
        return new

    def take(self) -> dict[str, Value]:
        """Return values set since the last call."""
        with self._lock:
            asked, self._asked = self._asked, {}
        return asked

    def on_get_parameters(self, client: object, param_names: list[str], request_id: str | None = None) -> Parameters:
        """Return gains by name; without names, return all."""
        with self._lock:
            values = {**self.held, **self._asked}
        return [
            Parameter(group, value=[float(values[name]) for name in names])
            for group, names in self._groups.items()
            if not param_names or group in param_names
        ]

    def on_set_parameters(self, client: object, parameters: Parameters, request_id: str | None = None) -> Parameters:
        """Set gains, by one number for all elements or one for each; return the values in effect."""
        for parameter in parameters:
            try:
                if not self._control:
                    raise InputError("Foxglove may not set gains; `set_gains=True` allows it")
                if parameter.name not in self._groups:
                    raise InputError(f"'{parameter.name:.80}' is not a gain of this FMU")
                asked = resolve(self._fmu, {parameter.name: _numbers(parameter.get_value())})
                check_going_on(self._fmu, asked, self.held)
            except InputError as error:
                self._warn("parameter", f"a parameter that Foxglove set is ignored: {error}")
                continue
            with self._lock:
                self._asked |= asked
        return self.on_get_parameters(client, [parameter.name for parameter in parameters])


def _numbers(value: object) -> object:
    """Return a parameter's numbers; integers are accepted, and a single number applies to all elements."""
    if isinstance(value, list):
        return value[0] if len(value) == 1 else value
    return value
