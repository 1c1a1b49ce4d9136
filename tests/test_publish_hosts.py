"""The hosts and nodes that can command a published run: two network namespaces, and two controllers."""

# ruff: noqa: E402

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from harness import wait_until
from nodes import CABLE, Node, ended, isolated, published
from tools import needs

needs("cyclonedds")

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader

import twodof
from twodof.ros.listener import Commanders
from twodof.ros.messages import POINT, STREAM
from twodof.ros.network import Network, dds_qos, dds_topic, open_domain

FOREIGN = """
import sys, time
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.typesys import Stores, get_typestore
from twodof.ros.network import dds_qos, dds_type
from twodof.ros.messages import POINT, STREAM

number, peer = int(sys.argv[1]), sys.argv[2]
domain = Domain(number, f'''<CycloneDDS><Domain>
<General><AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><SPDPInterval>1 s</SPDPInterval>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer Address="{peer}"/></Peers>
</Discovery></Domain></CycloneDDS>''')
participant = DomainParticipant(number)
states = "sensor_msgs/msg/JointState"
topic = Topic(participant, "rt/joint_states", dds_type(states))
reader = DataReader(participant, topic, dds_qos(STREAM, states))
topic = Topic(participant, "rt/target_command", dds_type(POINT))
writer = DataWriter(participant, topic, dds_qos(STREAM, POINT))
store = get_typestore(Stores.ROS2_HUMBLE)
kinds = store.types
header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](0, 0), "world")
message = kinds[POINT](header, kinds["geometry_msgs/msg/Point"](0.12, 0.17, 0.0))
point = writer.data_type(bytes(store.serialize_cdr(message, POINT)))
end, heard = time.monotonic() + float(sys.argv[3]), 0
while heard < 50 and time.monotonic() < end:
    heard += len(reader.take(10))
    writer.write(point)
    time.sleep(0.01)
print(heard)
"""
ENTER = ("nsenter", "--net", "--target")


@contextmanager
def other_host(process: subprocess.Popen[str]) -> Iterator[int]:
    """A network namespace at the other end of a run's cable, as the process that holds it."""
    inside = ("unshare", "--net", "sh", "-c", "ip link set lo up; echo; exec sleep infinity")
    with subprocess.Popen(inside, stdout=subprocess.PIPE) as host:
        try:
            assert host.stdout is not None and host.stdout.readline()
            for pid, command in (
                (process.pid, f"link set cable1 netns {host.pid}"),
                (host.pid, "address add 10.200.0.2/24 dev cable1"),
                (host.pid, "link set cable1 up"),
            ):
                subprocess.run([*ENTER, str(pid), "ip", *command.split()], check=True)
            yield host.pid
        finally:
            host.kill()


@pytest.mark.parametrize(
    ("options", "variables", "said", "open_to"),
    [
        ([], {}, "(this host only; --subnet opens it)", False),
        ([], {"ROS_LOCALHOST_ONLY": "1"}, "loopback only (ROS_LOCALHOST_ONLY)", False),
        ([], {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "(nobody)", False),
        ([], {"ROS_STATIC_PEERS": "10.200.0.3"}, "(this host and 10.200.0.3; --subnet opens it)", False),
        (
            [],
            {"ROS_STATIC_PEERS": "10.200.0.3;10.200.0.2"},
            "(this host and 10.200.0.3, 10.200.0.2; --subnet opens it)",
            True,
        ),
        (["--subnet"], {}, "range SUBNET (other hosts too)", True),
    ],
)
def test_other_hosts_command_only_with_permission(native_path, tmp_path, number, options, variables, said, open_to):
    """One announces itself to each of the run's ports, listens and commands."""
    bag, inside = tmp_path / "bag", isolated(CABLE)
    variables = {"ROS_LOCALHOST_ONLY": "", **variables}
    options = [*options, "-o", str(bag)]
    with published(number, native_path, *options, inside=inside, **variables) as process, other_host(process) as host:
        assert said in process.told[1]
        command = [*ENTER, str(host), sys.executable, "-c", FOREIGN, str(number), "10.200.0.1"]
        seconds = "120" if open_to else "6"
        heard = subprocess.run([*command, seconds], stdout=subprocess.PIPE, check=True).stdout
        process.send_signal(signal.SIGINT)
        ended(process, 130)
    provenance = json.loads((bag / "run.json").read_text())
    assert (int(heard) >= 50) == open_to and (int(heard) > 0) == open_to
    assert bool(provenance["input_changes"]) == ("commanders" in provenance) == open_to


def test_nodes_that_command_are_recorded_and_two_at_once_reported(native_path, tmp_path, number, listen):
    """Each is recorded once, by DDS's facts about its participant."""
    bag = tmp_path / "bag"
    one, two = listen("/target_command"), listen("/target_command")
    with published(number, native_path, "-o", str(bag)) as process:
        wait_until((bag / "run.json").exists)

        def commanders() -> list[tuple[float, dict[str, str]]]:
            return list(json.loads((bag / "run.json").read_text()).get("commanders", []))

        def command(node: Node, x: float) -> None:
            """Until it is followed: a point before the run has discovered its sender is lost."""

            def followed() -> bool:
                node.point("/target_command", "world", x, 0.17, 0.0)
                return f'"x_des[1]":{x}' in (bag / "run.json").read_text()

            wait_until(followed)

        command(one, 0.11)
        command(two, 0.12)
        for x in (0.13, 0.14):
            one.point("/target_command", "world", x, 0.17, 0.0)
            two.point("/target_command", "world", x + 0.1, 0.17, 0.0)
        command(two, 0.15)
        process.send_signal(signal.SIGINT)
        _, err = ended(process, 130)
    (first, facts), (second, others) = commanders()
    assert 0.0 <= first < second  # the first may be there as the run begins
    for node, its in ((one, facts), (two, others)):
        assert its["process"] == str(node.process.pid) and its["host"]
        assert re.fullmatch(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", its["guid"])
    (line,) = err.splitlines()
    both = re.search("two nodes command the robot at once, (.*) and (.*): the newest wins", line)
    assert both and {both[1], both[2]} == {facts["guid"], others["guid"]}


def test_a_host_whose_own_name_nothing_resolves() -> None:
    """Cyclone DDS would abort the process there, as in a bare chroot without /etc/hosts."""
    opens = "from twodof.ros.network import *; print(open_domain(Network()).interface)"
    nameless = isolated("ip link set lo up\nmount --bind /dev/null /etc/hosts")
    assert subprocess.run([*nameless, "getent", "hosts", "localhost"], check=False).returncode == 2
    done = subprocess.run([*nameless, sys.executable, "-c", opens], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "lo"), done.stderr


def test_a_node_that_leaves_at_once_is_recorded(native_path, number):
    """DDS has forgotten its writer before its command is read."""
    run, _shared = twodof.experiment(native_path), open_domain(Network(number))
    own, quality = DomainParticipant(number), dds_qos(STREAM, POINT)
    reader, commanders = DataReader(own, dds_topic(own, "/target_command", POINT), quality), Commanders(own, run)

    def command() -> str:
        node = DomainParticipant(number)
        writer = DataWriter(node, dds_topic(node, "/target_command", POINT), quality)
        wait_until(lambda: bool(reader.get_matched_publications() and writer.get_matched_subscriptions()))
        writer.write(writer.data_type(b"\0\1\0\0" + bytes(8) + b"\1" + bytes(31)))
        return str(node.guid)

    guid = command()
    wait_until(lambda: not reader.get_matched_publications())
    (message,) = (one for one in reader.take(10) if one.sample_info.valid_data)
    commanders.note(message.sample_info.publication_handle, 1.0)
    ((t, facts),) = run.commanders
    assert (t, facts["guid"]) == (1.0, guid) and {*facts} == {"guid", "host", "process"}
