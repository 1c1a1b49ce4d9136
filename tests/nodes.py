"""Fast DDS nodes and ``twodof publish`` in their own processes, and the messages of a bag.

The nodes use another DDS implementation with its own IDL; the MCAP project's reader reads bags. All traffic stays on
the loopback interface, or in network namespaces without a route out.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from bags import SECOND
from harness import shared
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tools import missing, needs

HERE = Path(__file__).resolve().parent
TWODOF = [sys.executable, "-m", "twodof"]
STREAMS = ("/joint_states", "/tf", "/target", "/end_effector")
LATCHED = ("/robot_description", "/tf_static")
COMMANDS = ("/target_command", "/clicked_point")
TIMEOUT = 120.0  # s: a guard against hanging; a busy machine takes its time


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Fast DDS node, compiled once for all processes of the tests."""
    generator, compiler = needs("fastddsgen"), needs("g++")
    needs("fastdds")

    def make(folder: Path) -> None:
        for source in (HERE / "fastdds").iterdir():
            shutil.copy(source, folder)
        command = [generator, "-cs", "-t", str(folder), "ros.idl"]  # -t: for temporary files
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        sources = [f'#include "{path.name}"\n' for path in folder.glob("*.c[px][px]")]
        (folder / "all.cc").write_text("".join(sources))  # headers are read once
        command = [compiler, "-std=c++14", "-w", "-I.", "all.cc", "-lfastrtps", "-lfastcdr"]
        command += ["-o", "node"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    return shared(tmp_path_factory, "fastdds", make) / "node"


@pytest.fixture
def number() -> Iterator[int]:
    """A DDS domain that nothing else on this machine uses, claimed by a TCP port of its number."""
    needs("cyclonedds")
    first = os.getpid()
    for it in range(100):
        domain = 1 + (first + it) % 100
        with closing(socket.socket()) as claim:
            try:
                claim.bind(("127.0.0.1", 7400 + 250 * domain))
            except OSError:
                continue
            yield domain
            return
    raise AssertionError("every DDS domain is in use")


class Node:
    """A Fast DDS node that listens to topics, or writes to those of COMMANDS."""

    def __init__(self, program: Path, number: int, *topics: str, inside: tuple[str, ...] = ()):
        command = [*inside, str(program), str(number), *topics]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, errors="surrogateescape"
        )
        self.told: list[list[Any]] = []
        self._thread = Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.endswith("\n"):
                self.told.append(json.loads(line))

    def messages(self, topic: str) -> list[Any]:
        """Fields of the received messages of a topic."""
        return [it[3] for it in self.told if it[:2] == ["message", topic]]

    def until(self, condition: Callable[[], Any], timeout: float = TIMEOUT) -> None:
        end = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < end, self.told[-3:]
            time.sleep(0.02)

    def sees(self, last: Any, topic: str = "/joint_states") -> None:
        """Wait for a message that is the last so far."""
        self.until(lambda: self.messages(topic)[-1:] == [last])

    def hears(self, topic: str = "/joint_states", more: int = 5) -> None:
        """Wait for some more messages."""
        before = len(self.messages(topic))
        self.until(lambda: len(self.messages(topic)) >= before + more)

    def point(self, topic: str, frame: str, *xyz: float) -> None:
        """Send a point to a listener."""
        self.say(f"{topic} {frame or '-'} {' '.join(map(repr, xyz))}")

    def leads(self, topic: str, *xyz: float) -> None:
        """Send a point until /target follows it."""
        line = f"{topic} world {' '.join(map(repr, xyz))}"
        self.insists(line, lambda: self.messages("/target")[-1:] and self.messages("/target")[-1][1] == list(xyz))

    def insists(self, line: str, condition: Callable[[], Any]) -> None:
        """Send a message until a condition holds.

        A reader may discover a writer seconds after the writer has discovered the reader, and earlier messages are
        lost.
        """

        def holds() -> bool:
            self.say(line)
            end = time.monotonic() + 1.0
            while not condition() and time.monotonic() < end:
                time.sleep(0.02)
            return bool(condition())

        self.until(holds)

    def say(self, line: str) -> None:
        """Send a message to a listener on its topic."""
        self.until(lambda: ["matched", line.split()[0], 1] in self.told)
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def leave(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        try:
            self.process.wait(TIMEOUT)
        finally:
            self.process.kill()
            self._thread.join()
            self.process.wait()


@pytest.fixture
def listen(program: Path, number: int) -> Iterator[Callable[..., Node]]:
    nodes: list[Node] = []

    def begin(*topics: str, **options: Any) -> Node:
        nodes.append(Node(program, number, *topics, **options))
        return nodes[-1]

    yield begin
    for node in nodes:
        if node.process.poll() is None:
            node.process.send_signal(signal.SIGCONT)
            node.leave()


def environment(number: int, **variables: str) -> dict[str, str]:
    kept = {n: v for n, v in os.environ.items() if not n.startswith(("ROS_", "CYCLONEDDS"))}
    return {**kept, "ROS_DOMAIN_ID": str(number), "ROS_LOCALHOST_ONLY": "1", **variables}


class Publisher(subprocess.Popen[str]):
    told: list[str]


@contextmanager
def published(
    number: int, fmu: Path, *options: str, inside: tuple[str, ...] = (), **variables: str
) -> Iterator[Publisher]:
    """``twodof publish`` in its own process, once it reports that it is on the network."""
    process = Publisher(
        [*inside, *TWODOF, "publish", str(fmu), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(number, **variables),
    )
    try:
        assert process.stdout is not None
        process.told = []
        while not process.told or not process.told[-1].startswith("end "):
            process.told.append(process.stdout.readline())
            assert process.told[-1], process.communicate()
        yield process
    finally:
        process.kill()
        process.communicate()


def ended(process: subprocess.Popen[str], status: int = 0) -> tuple[str, str]:
    """Return the output at the end of the process."""
    out, err = process.communicate(timeout=TIMEOUT)
    assert process.returncode == status, err
    return out, err


def recorded(bag: Path) -> dict[str, list[Any]]:
    """Fields of all messages by topic."""
    found: dict[str, list[Any]] = {}
    with (bag / f"{bag.name}.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            fields = listed(decoded)
            found.setdefault(channel.topic, []).append(fields)
            if channel.topic in STREAMS:
                header = fields[0][0][0] if channel.topic == "/tf" else fields[0]
                assert stamp_of(header) == message.log_time
    return found


def listed(message: Any) -> Any:
    if hasattr(message, "__slots__"):
        return [listed(getattr(message, name)) for name in message.__slots__]
    return [listed(it) for it in message] if isinstance(message, list | tuple) else message


def stamp_of(header: Any) -> int:
    (seconds, nanoseconds), _frame = header
    return int(seconds) * SECOND + int(nanoseconds)


ISOLATED = ("unshare", "--net", "--mount", "sh", "-c")


def isolated(script: str) -> tuple[str, ...]:
    """Beginning of a command that runs in its own network and mounts, after a script."""
    needs("networks")
    needs("ip")
    if subprocess.run([*ISOLATED, "ip link"], capture_output=True, check=False).returncode != 0:
        missing("networks")
    return (*ISOLATED, f'{script}\nexec "$@"', "sh")


# a network of two interfaces that are each other's cable
CABLE = """
ip link set lo up
for which in all default; do echo 1 > /proc/sys/net/ipv6/conf/$which/disable_ipv6; done 2> /dev/null
ip link add cable0 type veth peer name cable1
ip address add 10.200.0.1/24 dev cable0
ip link set cable0 up
ip link set cable1 up
"""
