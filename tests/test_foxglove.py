"""A run served to Foxglove, as a client of its protocol sees it; schemas are read by mcap_ros2."""

from __future__ import annotations

import json
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from bags import SECOND
from harness import cannot_run, needs, wait_until
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from nodes import LATCHED, PATIENCE, STREAMS, ended, listed, published, recorded, stamp_of
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

import twodof
from twodof.errors import PublishError
from twodof.ros.foxglove import Foxglove


class Client:
    """All that comes from a server, once it has subscribed to all topics."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self.told: dict[str, list[tuple[int, Any]]] = {}
        self.answers: list[Any] = []
        self._decoders: dict[int, Callable[[bytes], Any]] = {}
        self.channels: dict[int, Any] = {}

    def say(self, **message: Any) -> None:
        self._connection.send(json.dumps(message))

    def listen(self, react: Callable[[Client], None]) -> Client:
        """Until the server leaves; ``react`` is called after each message."""
        try:
            for message in self._connection:
                self._take(message)
                react(self)
        except ConnectionClosed:
            pass
        return self

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            opcode, channel, stamp = struct.unpack_from("<BIQ", message)
            assert opcode == 1
            topic = self.channels[channel]["topic"]
            content = listed(self._decoders[channel](message[13:]))
            self.told.setdefault(topic, []).append((stamp, content))
            return
        answer = json.loads(message)
        self.answers.append(answer)
        if answer["op"] == "advertise":
            for channel in answer["channels"]:
                k, name = channel["id"], channel["schemaName"]
                assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
                schema = Schema(k, channel["schema"].encode(), "ros2msg", name)
                decoder = DecoderFactory().decoder_for("cdr", schema)
                assert decoder is not None
                self.channels[k], self._decoders[k] = channel, decoder
            self.say(
                op="subscribe", subscriptions=[{"id": k, "channelId": k} for k in self.channels]
            )


@contextmanager
def viewed(
    fmu: Path,
    bag: Path,
    seconds: float,
    react: Callable[[Client], None] = lambda client: None,
    step: float = 0.01,
) -> Iterator[Client]:
    """A client of a run, when both are at their end."""
    with ThreadPoolExecutor(1) as pool:
        listening = []

        def opened(server: Foxglove) -> None:
            client = Client(connect(server.url, subprotocols=["foxglove.sdk.v1"]))  # type: ignore[list-item]
            listening.append(pool.submit(client.listen, react))
            wait_until(lambda: len(client.channels) == len(STREAMS + LATCHED))

        viewer = Foxglove(0, scene=True, effort=True, opened=opened)
        twodof.simulate(
            fmu, viewer, twodof.Bag(bag, scene=True, effort=True), stop_time=seconds, step=step,
            pace=twodof.RealTime(), steer=viewer.command,
        )  # fmt: skip
        yield listening[0].result(PATIENCE)


def test_every_topic_is_that_of_the_bag_and_a_gain_is_in_the_fmu_within_two_steps(
    native_path: Path, tmp_path: Path
) -> None:
    asked: list[int] = []

    def react(client: Client) -> None:
        states = client.told.get("/joint_states", [])
        if len(states) == 8 and not asked:
            asked.append(states[-1][0])
            gains = [{"name": "Kp", "value": [80, 90.5]}, {"name": "Kn", "value": [3]}]
            client.say(op="setParameters", parameters=gains, id="set")

    step = 0.2  # long: what the machine does beside this is not tested
    with viewed(native_path, tmp_path / "bag", 4, react, step) as client:
        (answer,) = [it for it in client.answers if it["op"] == "parameterValues"]
        assert {it["name"]: it["value"] for it in answer["parameters"]} == {
            "Kp": [80.0, 90.5], "Kn": [3.0],
        }  # fmt: skip
        truth = recorded(tmp_path / "bag")
        assert {*client.told} == {*truth} == {*STREAMS, *LATCHED}
        for topic in STREAMS:
            heard = [content for _, content in client.told[topic]]
            assert len(heard) > 10 and heard == truth[topic][-len(heard) :]
        for topic in LATCHED:
            assert all([content] == truth[topic] for _, content in client.told[topic])
        for stamp, state in client.told["/joint_states"]:
            assert stamp == stamp_of(state[0])
    ((t, values),) = json.loads((tmp_path / "bag" / "run.json").read_text())["input_changes"]
    assert values == {"Kp[1]": 80.0, "Kp[2]": 90.5, "Kn": 3.0}
    first = twodof.read_bag(tmp_path / "bag").stamps[0]
    assert 0 <= t - (asked[0] - first) / SECOND <= 2 * step + 1e-9


def test_foxgloves_own_client_decodes_every_topic_and_sets_a_gain(
    native_path: Path, tmp_path: Path
) -> None:
    """The one of its viewer, in JavaScript; a gain is in the FMU within two steps there too."""
    client = Path(__file__).with_name("foxglove_client.js")
    node, packages = needs("node"), client.with_name("node_modules") / "@foxglove"
    if not packages.is_dir():
        cannot_run("Foxglove's packages are not in tests/node_modules")
    told, clients, step = tmp_path / "told", [], 0.2

    def opened(server: Foxglove) -> None:
        with told.open("wb") as out:
            clients.append(subprocess.Popen([node, str(client), server.url], stdout=out))
        by = time.monotonic() + PATIENCE
        while "advertised" not in told.read_text():
            assert time.monotonic() < by, "the client does not come"
            time.sleep(0.01)

    viewer, bag = Foxglove(0, scene=True, effort=True, opened=opened), tmp_path / "bag"
    twodof.simulate(
        native_path, viewer, twodof.Bag(bag, scene=True, effort=True), stop_time=5, step=step,
        pace=twodof.RealTime(), steer=viewer.command,
    )  # fmt: skip
    assert clients[0].wait(PATIENCE) == 0
    heard: dict[str, list[Any]] = {}
    for line in told.read_text().splitlines():
        topic, *content = json.loads(line)
        heard.setdefault(topic, []).extend(map(fields, content))
    ((gains,),) = [heard.pop("parameters")]
    assert [gain[::2] for gain in gains] == [["Kp", [80, 90.5]]]
    assert heard.pop("advertised") == []
    truth = recorded(bag)
    assert {*heard} == {*truth} == {*STREAMS, *LATCHED}
    for topic, messages in heard.items():
        assert messages == truth[topic][-len(messages) :]
        assert len(messages) >= 20 or topic in LATCHED
    ((t, values),) = json.loads((bag / "run.json").read_text())["input_changes"]
    assert values == {"Kp[1]": 80.0, "Kp[2]": 90.5}
    asked, first = heard["/joint_states"][7], truth["/joint_states"][0]
    assert 0 <= t - (stamp_of(asked[0]) - stamp_of(first[0])) / SECOND <= 2 * step + 1e-9


def fields(value: Any) -> Any:
    """What JSON has as ``listed`` gives it."""
    parts = [*value.values()] if isinstance(value, dict) else value
    return [*map(fields, parts)] if isinstance(parts, list) else parts


def test_the_command_line_tells_where_it_listens(native_path: Path, number: int) -> None:
    options = ["--foxglove", "--foxglove-port", "0", "--scene"]
    with published(number, native_path, *options) as process:
        assert process.stdout is not None
        url = process.stdout.readline().split()[-1]
        with connect(url, subprotocols=["foxglove.sdk.v1"]) as connection:  # type: ignore[list-item]
            assert json.loads(connection.recv())["capabilities"][0] == "parameters"
        process.send_signal(signal.SIGINT)
        assert ended(process, 130)[1] == ""


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("Kp", [-1.0, 2.0], "Kp[1] = -1 is less than 0"),
        ("Kp", [1.0, 2.0, 3.0], "Kp has 2 elements, 3 were given"),
        ("Kp", "many", "expected a number"),
        ("Kp", None, "expected a number"),
        ("x_des", 1.0, "'x_des' is no gain of this FMU"),
    ],
)
def test_what_is_no_gain_is_ignored(
    native_path: Path, caplog: pytest.LogCaptureFixture, name: str, value: Any, reason: str
) -> None:
    from foxglove import Parameter

    viewer = Foxglove(0).begin(twodof.experiment(native_path))
    viewer._gains.on_set_parameters(None, [Parameter(name, value=value)])
    assert viewer.command() == {}
    (record,) = caplog.records
    assert reason in record.message


def test_a_port_that_is_taken_is_named(native_path: Path) -> None:
    with closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        viewer = Foxglove(port).begin(twodof.experiment(native_path))
        with pytest.raises(PublishError, match=f"port {port} of 127.0.0.1 cannot be listened on"):
            viewer.__enter__()


def test_it_listens_on_the_loopback_interface_alone(native_path: Path) -> None:
    with Foxglove(0).begin(twodof.experiment(native_path)) as viewer:
        port = int(viewer.url.rpartition(":")[2])
        listening = Path("/proc/net/tcp").read_text().splitlines()[1:]
        (address,) = [line.split()[1] for line in listening if f":{port:04X} 00000000" in line]
        assert address.startswith("0100007F:")
