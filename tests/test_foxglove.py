"""A run served to Foxglove, received by the client of Foxglove's viewer."""

import json
import os
import signal
import socket
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from bags import SECOND
from browser import NOBODY, UPGRADE, answer, connected
from harness import wait_until
from nodes import LATCHED, STREAMS, TIMEOUT, ended, published, recorded, stamp_of
from tools import needs
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

import twodof
from twodof.errors import PublishError
from twodof.pages.foxglove import Foxglove


def test_foxgloves_own_client_decodes_every_topic_and_sets_gains(native_path, tmp_path):
    """The client is the viewer's, in JavaScript; a gain reaches the FMU within two steps."""
    client = Path(__file__).with_name("foxglove_client.js")
    node = needs("node")
    needs("foxglove")
    told, clients, step = tmp_path / "told", [], 0.2  # long: what the machine does is not tested

    def opened(server: Foxglove) -> None:
        with told.open("wb") as out:
            clients.append(subprocess.Popen([node, str(client), server.url], stdout=out))
        wait_until(lambda: "advertised" in told.read_text())

    bag = tmp_path / "bag"
    viewer = Foxglove(0, scene=True, effort=True, set_gains=True, opened=opened)
    twodof.simulate(
        native_path, viewer, twodof.Bag(bag, scene=True, effort=True), stop_time=4, step=step, pace=twodof.RealTime()
    )
    assert clients[0].wait(TIMEOUT) == 0
    heard: dict[str, list[Any]] = {}
    for line in told.read_text().splitlines():
        topic, *content = json.loads(line)
        heard.setdefault(topic, []).append([fields(part) for part in content])
    ((gains,),) = heard.pop("parameters")
    assert [gain[::2] for gain in gains] == [["Kp", [80, 90.5]], ["Kn", [3]]]
    assert heard.pop("advertised") == [[]]
    truth = recorded(bag)
    assert {*heard} == {*truth} == {*STREAMS, *LATCHED}
    for topic, messages in heard.items():
        if topic in LATCHED:  # sent again if the client subscribes to a topic after the first sample
            assert all([it] == truth[topic] for it, _ in messages)
            continue
        assert [it for it, _ in messages] == truth[topic][-len(messages) :]
        assert len(messages) > 15
    states = heard["/joint_states"]
    assert all(int(stamp) == stamp_of(state[0]) for state, stamp in states)
    ((t, values),) = json.loads((bag / "run.json").read_text())["input_changes"]
    assert values == {"Kp[1]": 80.0, "Kp[2]": 90.5, "Kn": 3.0}
    asked, first = int(states[7][1]), stamp_of(truth["/joint_states"][0][0])
    assert 0 <= t - (asked - first) / SECOND <= 2 * step + 1e-9


def fields(value: Any) -> Any:
    """Return the fields of a JSON message as ``listed`` returns them."""
    parts = [*value.values()] if isinstance(value, dict) else value
    return [*map(fields, parts)] if isinstance(parts, list) else parts


def test_the_command_line_prints_the_address(native_path, number):
    options = ["--foxglove", "--foxglove-port", "0", "--scene"]
    with published(number, native_path, *options) as process:
        assert process.stdout is not None
        url = next(line for line in process.stdout if line.startswith("open")).split()[-1]
        with joined(url) as connection:
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
        ("x_des", 1.0, "'x_des' is not a gain of this FMU"),
    ],
)
def test_parameters_that_are_no_gains_are_ignored(native_path, caplog, name, value, reason):
    """There is one warning, however often it arrives."""
    viewer = Foxglove(0, set_gains=True).begin(twodof.experiment(native_path))
    asked = {"name": name} if value is None else {"name": name, "value": value}
    with viewer, joined(viewer.url) as connection:
        for _ in range(100):
            ask(connection, asked)
    assert viewer.command() == {}
    (record,) = caplog.records
    assert reason in record.message


def joined(url: str, **options: Any) -> Connection:
    """A connection by Foxglove's protocol."""
    return connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], **options)


def ask(connection: Connection, asked: dict[str, Any]) -> list[Any]:
    """Set a parameter; return the value in the answer."""
    connection.send(json.dumps({"op": "setParameters", "parameters": [asked], "id": "a"}))
    while True:
        text = connection.recv(timeout=TIMEOUT)
        if isinstance(text, str) and (answer := json.loads(text))["op"] == "parameterValues":
            return [it["value"] for it in answer["parameters"]]


def test_gains_are_set_where_asked_for_alone(native_path, caplog):
    for set_gains, held, taken in ((False, [50.0, 50.0], {}), (True, [1.0, 1.0], {"Kp[1]": 1.0, "Kp[2]": 1.0})):
        viewer = Foxglove(0, set_gains=set_gains).begin(twodof.experiment(native_path))
        with viewer, joined(viewer.url) as connection:
            assert ask(connection, {"name": "Kp", "value": 1.0}) == [held]
        assert viewer.command() == taken
    (record,) = caplog.records
    assert "Foxglove may not set gains; `set_gains=True` allows it" in record.message


def test_websites_but_foxgloves_own_are_refused(native_path):
    """Origin decides, and Host if a website's name resolves to this machine."""
    with Foxglove(0).begin(twodof.experiment(native_path)) as viewer:
        url, own = viewer.url.replace("ws:", "http:"), ("Host", viewer.url.removeprefix("ws://"))
        protocol = ("Sec-WebSocket-Protocol", "foxglove.sdk.v1")

        def status(*headers: tuple[str, str]) -> int:
            return answer(url, *headers, protocol, *UPGRADE)

        assert status(own) == 101
        for origin in ("https://app.foxglove.dev", "https://embed.foxglove.dev", "file://"):
            assert status(own, ("Origin", origin)) == 101
        for origin in (
            "https://evil.example",
            "null",
            "http://localhost:3000",
            "http://app.foxglove.dev",
            "https://app.foxglove.dev.evil.example",
            "https://evil.example/app.foxglove.dev",
        ):
            assert status(own, ("Origin", origin)) == 403
        for host in ("evil.example", "app.foxglove.dev"):
            assert status(("Host", host), ("Origin", f"https://{host}")) == 403
            assert status(("Host", host)) == 403


@pytest.mark.needs("linux")
@pytest.mark.parametrize(("set_gains", "status"), [(False, b"101"), (True, b"403")])
def test_other_users_cannot_set_gains(native_path, set_gains, status, monkeypatch):
    asked = ("Host", "localhost"), ("Sec-WebSocket-Protocol", "foxglove.sdk.v1"), *UPGRADE
    head = "".join(f"{name}: {value}\r\n" for name, value in asked)
    viewer = Foxglove(0, set_gains=set_gains).begin(twodof.experiment(native_path))
    with viewer, connected(viewer.url, "127.0.0.1") as one, monkeypatch.context() as patch:
        patch.setattr(os, "geteuid", lambda: NOBODY + 1)
        one.sendall(f"GET / HTTP/1.1\r\n{head}\r\n".encode())
        assert one.recv(100).split()[1] == status


@pytest.mark.needs("linux")
def test_the_server_behind_the_relay_answers_this_process_alone(native_path):
    """Every user sees the port of Foxglove's SDK in the kernel's list of sockets."""
    with Foxglove(0, set_gains=True).begin(twodof.experiment(native_path)) as viewer:
        own = {os.path.realpath(f"/proc/self/fd/{n}").rpartition("/")[2] for n in os.listdir("/proc/self/fd")}
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()]
        (inner,) = [
            (socket.inet_ntoa(bytes.fromhex(row[1][:8])[::-1]), int(row[1][9:], 16))
            for row in rows
            if f"socket:[{row[9]}]" in own and row[3] == "0A" and not row[1].startswith("0100007F")
        ]
        with socket.socket() as stranger, pytest.raises(TimeoutError):
            stranger.settimeout(1)
            stranger.connect(inner)
        with joined(viewer.url) as connection:
            assert json.loads(connection.recv(timeout=TIMEOUT))["op"] == "serverInfo"


def test_a_client_of_junk_prints_nothing(native_path, caplog):
    with Foxglove(0).begin(twodof.experiment(native_path)) as viewer:
        address = viewer.url.removeprefix("ws://").split(":")
        for _ in range(20):
            with socket.create_connection((address[0], int(address[1]))) as one:
                one.sendall(b"GARBAGE\r\n\r\n")
        with joined(viewer.url) as connection:
            for _ in range(200):
                connection.send("no JSON")
                connection.send(b"\xff\x00")
                connection.send('{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 9}]}')
            ask(connection, {"name": "Kp", "value": 1.0})  # by then it has read all of them
    assert [record.name for record in caplog.records] == ["twodof.pages.foxglove"]


def test_a_port_that_is_taken_is_named(native_path):
    with closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        viewer = Foxglove(port).begin(twodof.experiment(native_path))
        with pytest.raises(PublishError, match=f"port {port} of 127.0.0.1 is in use"):
            viewer.__enter__()


def test_it_listens_on_the_loopback_interface_alone(native_path):
    with Foxglove(0).begin(twodof.experiment(native_path)) as viewer:
        port = int(viewer.url.rpartition(":")[2])
        listening = Path("/proc/net/tcp").read_text().splitlines()[1:]
        (address,) = [line.split()[1] for line in listening if f":{port:04X} 00000000" in line]
        assert address.startswith("0100007F:")


def test_a_port_is_free_if_the_server_behind_it_does_not_start(native_path, monkeypatch):
    def failing(**options: object) -> None:
        raise RuntimeError("no server")

    with closing(socket.create_server(("127.0.0.1", 0))) as one:
        port = one.getsockname()[1]
    monkeypatch.setattr("twodof.pages.foxglove.start_server", failing)
    sink = Foxglove(port).begin(twodof.experiment(native_path))
    with pytest.raises(PublishError, match="cannot serve Foxglove: no server"):
        sink.__enter__()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), 5)
