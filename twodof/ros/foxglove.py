"""A run for Foxglove, without ROS: the bag's messages over a WebSocket, and gains from there."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from threading import Lock
from typing import Any

from ..errors import InputError, PublishError
from ..plant.variables import GAINS
from ..simulation.experiments import Experiment, Value, check_going_on, resolve
from ..simulation.sample import Sample, Sink
from .cdr import Rows
from .messages import Messages, store_of

try:
    from foxglove import Channel, Context, Parameter, Schema, start_server
    from foxglove.websocket import Capability, ServerListener
except ImportError as missing:
    raise PublishError(
        f"cannot serve Foxglove: {missing}; install the package 'foxglove-sdk' (the extra"
        " 'foxglove')"
    ) from missing

LOG = logging.getLogger(__name__)
HOST, PORT = "127.0.0.1", 8765


class Foxglove(Sink):
    """A sink that serves each sample to Foxglove, on the loopback interface alone.

    The gains are its parameters, which a panel there shows and sets.

    Args:
        port: where it listens; 0: any that is free.
        scene: also the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.
        opened: told when it listens.

    Attributes:
        url: of the WebSocket, known when it listens.

    Raises:
        PublishError: the port cannot be listened on.
    """

    def __init__(
        self,
        port: int = PORT,
        *,
        scene: bool = False,
        effort: bool = False,
        opened: Callable[[Foxglove], None] = lambda server: None,
    ) -> None:
        self._port, self._opened, self.url = port, opened, ""
        self._scene, self._effort = scene, effort

    def begin(self, run: Experiment) -> Foxglove:
        """Take the experiment whose samples come.

        Raises:
            BagError: the FMU has not what is asked for.
        """
        self._messages = Messages(run, scene=self._scene, effort=self._effort)
        self._gains = _Gains(run)
        return self

    def __enter__(self) -> Foxglove:
        context = self._context = Context()  # which its channels do not keep
        self._channels = {}
        for name, said in self._messages.topics.items():
            text, _ = store_of(said.type).generate_msgdef(said.type, ros_version=2)
            schema = Schema(name=said.type, encoding="ros2msg", data=text.encode())
            self._channels[name] = Channel(
                name, schema=schema, message_encoding="cdr", context=context
            )
        try:
            self._server = start_server(
                name="twodof", host=HOST, port=self._port, context=context,
                capabilities=[Capability.Parameters], server_listener=self._gains,
            )  # fmt: skip
        except (RuntimeError, OSError, OverflowError) as error:
            reason = f"port {self._port} of {HOST} cannot be listened on: {error}"
            raise PublishError(f"cannot serve Foxglove: {reason}; choose another") from error
        self.url = f"ws://{HOST}:{self._server.port}"
        self._opened(self)
        return self

    def write(self, sample: Sample) -> None:
        """Send one sample; and what holds for the whole run to those who have just subscribed."""
        self._gains.held = sample.inputs
        if sample.k == 0:
            self._latched = self._messages.latched(sample.stamp)
        if self._gains.greet():
            self._send(self._latched, sample.stamp)
        self._send(self._messages.of(sample), sample.stamp)

    def _send(self, messages: Mapping[str, Rows], stamp: int) -> None:
        for name, rows in messages.items():
            self._channels[name].log(rows.tobytes(), log_time=stamp)

    def command(self) -> dict[str, Value]:
        """Gains that were set since the last call, as inputs of the FMU."""
        return self._gains.take()

    def __exit__(self, *exception: object) -> None:
        self._server.stop()


class _Gains(ServerListener):
    """The gains as parameters; its methods are called by threads of the server."""

    def __init__(self, run: Experiment) -> None:
        self._fmu = run.fmu
        self.held: Mapping[str, Value] = run.start_values
        groups = {group: run.fmu.vector(group) or [group] for group in GAINS}
        self._groups = {g: names for g, names in groups.items() if names[0] in run.fmu.variables}
        self._lock, self._asked, self._new = Lock(), dict[str, Value](), False

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Somebody listens to a topic from now on."""
        self._new = True

    def greet(self) -> bool:
        """Whether somebody has subscribed since the last call."""
        new, self._new = self._new, False
        return new

    def take(self) -> dict[str, Value]:
        """Values set since the last call."""
        with self._lock:
            asked, self._asked = self._asked, {}
        return asked

    def on_get_parameters(
        self, client: Any, param_names: list[str], request_id: str | None = None
    ) -> list[Any]:
        """Gains by name, all where none is named."""
        with self._lock:
            values = {**self.held, **self._asked}
        return [
            Parameter(group, value=[float(values[name]) for name in names])
            for group, names in self._groups.items()
            if not param_names or group in param_names
        ]

    def on_set_parameters(
        self, client: Any, parameters: list[Any], request_id: str | None = None
    ) -> list[Any]:
        """Take gains, one number for all elements or one each; and tell what then holds."""
        for parameter in parameters:
            try:
                if parameter.name not in self._groups:
                    raise InputError(f"'{parameter.name:.80}' is no gain of this FMU")
                asked = resolve(self._fmu, {parameter.name: _numbers(parameter.get_value())})
                check_going_on(self._fmu, asked, self.held)
            except InputError as error:
                LOG.warning("a parameter that Foxglove set is ignored: %s", error)
                continue
            with self._lock:
                self._asked |= asked
        return self.on_get_parameters(client, [parameter.name for parameter in parameters])


def _numbers(value: Any) -> Any:
    """Integers are numbers too; a list of one is for all elements."""
    if isinstance(value, list):
        return value[0] if len(value) == 1 else value
    return value
