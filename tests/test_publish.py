"""A published run, received and commanded by a node on Fast DDS with its own IDL.

The reference is the bag recorded at the same time, read by the MCAP project's reader. All traffic stays on the loopback
interface, or in network namespaces without a route out.
"""

# ruff: noqa: E402

import json
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from bags import SECOND, assert_consistent
from harness import python, wait_until
from nodes import CABLE, COMMANDS, LATCHED, STREAMS, ended, environment, isolated, published, recorded, stamp_of
from tools import needs

needs("cyclonedds")

import twodof
from twodof.cli.main import main
from twodof.errors import InputError
from twodof.files import data_file
from twodof.plots.track import read_tracks
from twodof.ros.network import LAST_DOMAIN, Network, network_of_environment

HASHES = {
    "sensor_msgs JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "std_msgs String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "tf2_msgs TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "geometry_msgs PointStamped": ("4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897"),
}
"""Hashes of types, as 'ros2 topic info --verbose' shows them."""
TYPES = dict(
    joint_states="sensor_msgs JointState",
    robot_description="std_msgs String",
    tf="tf2_msgs TFMessage",
    tf_static="tf2_msgs TFMessage",
    target="geometry_msgs PointStamped",
    end_effector="geometry_msgs PointStamped",
)


def test_fast_dds_receives_every_field_of_the_bag(native_path, tmp_path, number, listen, length):
    """Names, types and type hashes are those of ROS 2; stamps are those of the wall clock."""
    seconds, before = length(60, 2), 4  # in which a busy machine finds the node
    node = listen(*STREAMS, *LATCHED)
    bag = tmp_path / "bag"
    options = ["--scene", "--effort", "--stop-time", str(seconds + before), "-o", str(bag)]
    with published(number, native_path, *options) as process:
        out, err = ended(process)
    assert err == ""
    truth = recorded(bag)
    for topic in STREAMS:
        node.sees(truth[topic][-1], topic)
    assert len(truth["/joint_states"]) == 100 * (seconds + before) + 1
    for topic in STREAMS:
        heard = node.messages(topic)
        assert len(heard) >= 100 * seconds + 1
        assert heard == truth[topic][-len(heard) :], topic  # none is lost since the first
    for topic in LATCHED:
        assert node.messages(topic) == truth[topic]
    state = truth["/joint_states"][0]
    assert state[1] == ["joint1", "joint2"] and len(state[4]) == 2  # names, efforts
    assert re.search(rf"deadlines +\d+ of {100 * (seconds + before) + 1} missed, worst [\d.]+ ms", out)
    writers = {topic: rest for event, topic, *rest in node.told if event == "writer"}
    for topic, kind in TYPES.items():
        name = kind.replace(" ", "::msg::dds_::") + "_"
        assert writers.pop(f"rt/{topic}") == [name, f"typehash=RIHS01_{HASHES[kind]};"]
    assert not writers
    states = [it for it in node.told if it[:2] == ["message", "/joint_states"]]
    delays = [it[2] - stamp_of(it[3][0]) for it in states]
    assert 0 < min(delays) < 0.02 * SECOND  # of those that a busy machine did not hold up


def test_the_network_has_what_the_sensors_measure(tmp_path, number, listen):
    """The true states are on a topic of their own, in the bag as well."""
    options = twodof.FmuOptions(control="effort", native=True)
    fmu, bag = twodof.build_fmu(tmp_path / "bare.fmu", options), tmp_path / "bag"
    settings = {"gravity": "0", "q_start": "0.5,0.25", "q_noise": "0.1", "v_noise": "1"}
    given = [part for name, value in settings.items() for part in ("--set", f"{name}={value}")]
    node = listen("/joint_states", "/joint_states_true")
    with published(number, fmu, *given, "--stop-time", "4", "-o", str(bag)) as process:
        ended(process)
    truth = recorded(bag)
    for topic in ("/joint_states", "/joint_states_true"):
        node.sees(truth[topic][-1], topic)
        heard = node.messages(topic)
        assert heard == truth[topic][-len(heard) :]
    assert {(*state[2], *state[3]) for state in truth["/joint_states_true"]} == {(0.5, 0.25, 0.0, 0.0)}
    noise = np.array([state[2] for state in truth["/joint_states"]]) - [0.5, 0.25]
    assert 0.08 < noise.std() < 0.12 and np.std([state[3] for state in truth["/joint_states"]]) > 0.8


def test_a_late_subscriber_receives_latched_messages_and_the_last_sample_before_a_signal(
    native_path, tmp_path, number, listen, length
):
    bag = tmp_path / "bag"
    with published(number, native_path, "--scene", "-o", str(bag)) as process:
        time.sleep(length(45, 1))
        node = listen(*LATCHED, "/joint_states")
        node.until(lambda: all(map(node.messages, LATCHED)))
        node.hears(more=30)
        process.send_signal(signal.SIGTERM)
        out, err = ended(process, 130)
    assert err == ""
    truth = recorded(bag)
    for topic in LATCHED:
        assert node.messages(topic) == truth[topic]
    assert '<link name="EndEffector"' in truth["/robot_description"][0][0]
    states = truth["/joint_states"]
    node.sees(states[-1])
    heard = node.messages("/joint_states")
    assert heard == states[-len(heard) :]
    assert assert_consistent(bag, "mcap") == sum(map(len, truth.values()))
    assert "stopped" in out and f"{len(states)} messages" in out


def test_a_point_is_the_target_within_two_steps(native_path, tmp_path, number, listen):
    bag, step = tmp_path / "bag", 0.2  # long: what the machine does beside this is not tested
    points = {(0.125, 0.17): "world", (0.13, 0.16): "", (0.14, 0.15): "world", (0.15, 0.14): ""}
    node = listen("/target", *COMMANDS)
    options = ["--scene", "--rate", str(1 / step), "-o", str(bag), "--set", "Kp=80"]
    delays = []
    with published(number, native_path, *options) as process:
        node.hears("/target", 1)
        for topic, (xy, frame) in zip(sorted(COMMANDS * 2), points.items()):
            for _ in range(8):  # one that comes before the run has discovered its sender is lost
                node.point(topic, frame, *xy, 0.9)
                node.hears("/target", 3)
                heard = [m for m in node.messages("/target") if m[1] == [*xy, 0]]
                if heard:
                    break
            sent = [it[2] for it in node.told if it[0] == "sent"]
            late = [stamp_of(heard[0][0]) - t for t in sent]
            delays.append(min(delay for delay in late if delay > 0))
        process.send_signal(signal.SIGINT)
        ended(process, 130)
    assert max(delays) <= 2 * step * SECOND
    changes = json.loads((bag / "run.json").read_text())["input_changes"]
    assert [tuple(values.values()) for _, values in changes] == [*points]
    states = recorded(bag)["/joint_states"]
    # the FMU had it: its own trajectory with those targets from those steps on
    told = {round(t / step): values for t, values in changes}
    assert max(told) < len(states) - 1
    run = twodof.samples(native_path, step=step, stop_time=(len(states) - 1) * step, settings={"Kp": 80})
    sample = next(run)
    for state in states:
        assert state[2:4] == [list(sample.q), list(sample.v)]
        if sample.k < len(states) - 1:
            sample = run.send(told.get(sample.k))


def test_invalid_or_unreachable_points_end_no_run(native_path, tmp_path, number, listen):
    """The robot stops, and follows the next valid target; there is one warning for each kind."""
    node = listen("/joint_states", "/target", *COMMANDS)
    options = ["--scene", "-o", str(tmp_path / "bag"), "--set", "Kn=5"]
    with published(number, native_path, *options) as process:
        node.leads("/clicked_point", 0.2, 0.06, 0.0)
        node.leads("/target_command", 0.21, 0.05, 0.0)
        before = len(node.messages("/target"))
        for _ in range(3):
            node.point("/clicked_point", "world", float("nan"), 0.1, 0.0)
            node.point("/target_command", "", 0.1, float("inf"), 0.0)
            node.point("/clicked_point", "odom", 0.1, 0.1, 0.0)
            node.point("/target_command", "map", 0.1, 0.1, 0.0)
            node.point("/target_command", "\udcff", 0.1, 0.1, 0.0)  # no UTF-8
            node.hears("/target")
        assert all(xyz == [0.21, 0.05, 0] for _, xyz in node.messages("/target")[before:])
        for x in (1e308, -1e308, 1e200, 1e30):
            node.point("/target_command", "world", x, 1e308, 0.0)
            node.hears("/target", 10)
        node.point("/target_command", "world", 0.25, 0.0625, 0.0)
        node.until(lambda: node.messages("/target")[-1][1] == [0.25, 0.0625, 0])
        node.hears("/joint_states", 300)
        process.send_signal(signal.SIGINT)
        _, err = ended(process, 130)
    warnings = (
        r"WARNING: a point on /target_command cannot be read .*",
        r"WARNING: a point on /\S+ is in frame '(odom|map)', not in 'world': .*",
        r"WARNING: a point on /\S+ is not finite: .*",  # whichever topic's was heard first
        r"WARNING: step \d+ at t = .*: the robot is stopped, and its target is .*",
    )
    lines = err.splitlines()
    assert len(lines) == len(warnings)
    for warning in warnings:
        assert [bool(re.fullmatch(warning, line)) for line in lines].count(True) == 1
    states = np.array([state[2] + state[3] for state in recorded(tmp_path / "bag")["/joint_states"]])
    assert np.isfinite(states).all()
    bag = twodof.read_bag(tmp_path / "bag")
    np.testing.assert_allclose(bag.x[-1], (0.25, 0.0625), atol=1e-2)
    (track,) = read_tracks([bag])
    assert track.task is not None and bag.received is not None
    expected = np.linalg.norm(bag.x - bag.received.points[:, :2], axis=1)
    np.testing.assert_allclose(track.task.error, expected, rtol=1e-9, atol=1e-12)


def test_a_subscriber_that_stalls_leaves_or_returns_holds_nothing_up(native_path, tmp_path, number, listen):
    bag = tmp_path / "bag"
    with published(number, native_path, "--scene", "-o", str(bag)) as process:
        stalled, killed = listen(*STREAMS, *LATCHED), listen(*STREAMS)
        stalled.hears()
        killed.hears()
        stalled.process.send_signal(signal.SIGSTOP)
        killed.process.kill()
        killed.leave()
        back = listen(*STREAMS)
        back.hears(more=200)
        stalled.process.send_signal(signal.SIGCONT)
        stalled.hears(more=50)
        process.send_signal(signal.SIGINT)
        out, err = ended(process, 130)
    assert err == ""
    stamps = np.array([stamp_of(state[0]) for state in recorded(bag)["/joint_states"]])
    assert len(stamps) > 200 and (np.diff(stamps) == SECOND // 100).all()
    assert re.search(rf"\d+ of {len(stamps)} missed", out)


def test_two_publishers_on_one_topic_are_both_received(native_path, tmp_path, number, listen):
    node = listen("/joint_states")
    bags = [tmp_path / "one", tmp_path / "two"]
    runs = [["--stop-time", "4", "--set", f"Kp={gain}", "-o"] for gain in (50, 90)]
    with (
        published(number, native_path, *runs[0], str(bags[0])) as one,
        published(number, native_path, *runs[1], str(bags[1])) as two,
    ):
        node.hears()
        assert ended(one)[1] == ended(two)[1] == ""
    for bag in bags:
        truth = recorded(bag)["/joint_states"]
        node.until(partial(lambda last: last in node.messages("/joint_states"), truth[-1]))
        mine = [message for message in node.messages("/joint_states") if message in truth]
        assert len(mine) > 100 and mine == truth[-len(mine) :]


def test_without_a_network_the_run_goes_on(native_path, tmp_path, number):
    bag = tmp_path / "bag"
    options = ["--stop-time", "0.5", "-o", str(bag)]
    inside = isolated("true")
    with published(number, native_path, *options, inside=inside, ROS_LOCALHOST_ONLY="") as process:
        assert "end       after 0.5 s, or Ctrl-C\n" in process.told
        _, err = ended(process)
    assert err.splitlines() == ["WARNING: there is no network interface: no other program can receive the run"]
    assert len(recorded(bag)["/joint_states"]) == 51


def packets(process: subprocess.Popen[str]) -> int:
    """Return the number of packets that left the cable's end in the network of a process."""
    command = ["nsenter", "--net", "--target", str(process.pid), "ip", "-j", "-s", "link"]
    links = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    (link,) = [link for link in links if link["ifname"] == "cable0"]
    return int(link["stats64"]["tx"]["packets"])


@pytest.mark.parametrize(
    ("options", "variables", "reach", "local", "outside"),
    [
        ([], {}, "lo, cable0, range LOCALHOST (this host only; --subnet opens it)", True, False),
        ([], {"ROS_LOCALHOST_ONLY": "1"}, "lo, loopback only (ROS_LOCALHOST_ONLY)", True, False),
        ([], {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "cable0, range OFF (nobody)", False, False),
        (["--subnet"], {}, "cable0, range SUBNET (other hosts too)", True, True),
        (
            [],
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"},
            "cable0, range SYSTEM_DEFAULT (other hosts too)",
            True,
            True,
        ),
    ],
)
def test_range(native_path, number, listen, options, variables, reach, local, outside):
    """A node with ROS 2's default range receives the run; packets leave the host, or not."""
    variables = {"ROS_LOCALHOST_ONLY": "", **variables}
    inside = isolated(CABLE)
    with published(number, native_path, *options, inside=inside, **variables) as process:
        assert f"on {reach}\n" in process.told[1], process.told
        if outside:
            wait_until(lambda: packets(process) > 0)
        else:
            time.sleep(1.5)
            assert packets(process) == 0
        node = listen("--any", "/joint_states", inside=("nsenter", "--net", "--target", str(process.pid)))
        if local:
            node.hears()
        else:
            time.sleep(3.0)
            assert not node.messages("/joint_states")
        process.send_signal(signal.SIGINT)
        assert ended(process, 130)[1] == ""


LISTENER = """
import sys, time
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from twodof.ros.messages import STREAM
from twodof.ros.network import dds_qos, dds_type

number, configuration = int(sys.argv[1]), sys.argv[2]
domain = Domain(number, f"<CycloneDDS><Domain>{configuration}</Domain></CycloneDDS>")
participant = DomainParticipant(number)
name = "sensor_msgs/msg/JointState"
topic = Topic(participant, "rt/joint_states", dds_type(name))
reader = DataReader(participant, topic, dds_qos(STREAM, name))
end, heard = time.monotonic() + 120.0, 0
while heard < 50 and time.monotonic() < end:
    heard += len(reader.take(10))
    time.sleep(0.01)
print(heard)
"""
JAZZY = """<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>{}</Discovery>"""
SHELLS = (  # of its ranges LOCALHOST and SUBNET
    "<General><AllowMulticast>false</AllowMulticast></General>"
    + JAZZY.format('<Peers><Peer address="localhost"/></Peers>'),
    JAZZY.format(""),
)


@pytest.mark.parametrize("variables", [{}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}])
def test_cyclone_dds_as_jazzy_configures_it_receives(native_path, number, variables):
    variables = {"ROS_LOCALHOST_ONLY": "", **variables}
    with published(number, native_path, inside=isolated(CABLE), **variables) as process:
        enter = ["nsenter", "--net", "--target", str(process.pid)]
        command = [*enter, sys.executable, "-c", LISTENER, str(number)]
        shells = [subprocess.Popen([*command, it], stdout=subprocess.PIPE) for it in SHELLS]
        assert min(int(shell.communicate()[0]) for shell in shells) >= 50
        process.send_signal(signal.SIGINT)
        ended(process, 130)


def test_an_interface_can_be_chosen(native_path, number):
    chosen = (
        "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='cable0'/></Interfaces>"
        "</General></Domain></CycloneDDS>"
    )
    variables = {"ROS_LOCALHOST_ONLY": "", "CYCLONEDDS_URI": chosen}
    with published(number, native_path, inside=isolated(CABLE), **variables) as process:
        assert "on cable0, range LOCALHOST" in process.told[1]
        process.send_signal(signal.SIGINT)
        assert ended(process, 130)[1] == ""


def test_an_interface_that_goes_and_comes_back(native_path, tmp_path, number, listen):
    bag = tmp_path / "bag"
    options, inside = ["-o", str(bag)], isolated(CABLE)
    with published(number, native_path, *options, inside=inside, ROS_LOCALHOST_ONLY="") as process:
        enter = ("nsenter", "--net", "--target", str(process.pid))
        node = listen("--any", "/joint_states", inside=enter)
        node.hears()
        for state in ("down", "up"):
            subprocess.run([*enter, "ip", "link", "set", "cable0", state], check=True)
            time.sleep(1.0)
        node.hears()
        process.send_signal(signal.SIGINT)
        assert ended(process, 130)[1] == ""
    stamps = np.array([stamp_of(state[0]) for state in recorded(bag)["/joint_states"]])
    assert len(stamps) > 200 and (np.diff(stamps) == SECOND // 100).all()


MEMORY = """
import sys
import twodof
from sinks import Memory
from twodof.simulation.pace import RealTime
from twodof.ros.publisher import Publisher

steps, paced = int(sys.argv[2]), sys.argv[3] == "paced"
run = twodof.experiment(sys.argv[1], stop_time=steps / 100)
publisher, memory = Publisher(scene=True), Memory(steps // 10)
pace = RealTime() if paced else None
summary = twodof.simulate(run, publisher, memory, pace=pace)
assert summary.last.k == steps
print(memory.growth)
"""


@pytest.mark.long
@pytest.mark.needs("linux")
def test_an_hour_has_flat_memory(native_path, number, listen, length):
    """The run has no pace; in full, it takes an hour in real time."""
    steps = length(360_000, 5_000)
    listen("/joint_states", "/tf", "/robot_description")
    arguments, paced = ["-c", MEMORY, native_path, str(steps)], "paced" if steps == 360_000 else ""
    done = python(*arguments, paced, cwd=Path(__file__).parent, env=environment(number), check=True, timeout=7200)
    print(f"{steps} samples: memory grew by {int(done.stdout) / 2**20:.1f} MiB")
    assert int(done.stdout) <= min(10e6, 250 * steps)


@pytest.mark.parametrize(
    ("variables", "place"),
    [
        ({}, Network()),
        ({"ROS_DOMAIN_ID": "", "ROS_LOCALHOST_ONLY": "0"}, Network()),
        ({"ROS_DOMAIN_ID": str(LAST_DOMAIN)}, Network(LAST_DOMAIN)),
        ({"ROS_STATIC_PEERS": "10.0.0.5;localhost;"}, Network(peers=("10.0.0.5", "localhost"))),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, Network(range="OFF")),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, Network(range="SUBNET")),
        ({"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, Network(loopback=True)),
    ],
)
def test_the_environment_of_ros_2(variables, place):
    assert network_of_environment(variables) == place


@pytest.mark.parametrize(
    ("variables", "culprit"),
    [
        ({"ROS_DOMAIN_ID": "233"}, "ROS_DOMAIN_ID is '233', not a number from 0 to 232"),
        ({"ROS_DOMAIN_ID": "-1"}, "ROS_DOMAIN_ID is '-1'"),
        ({"ROS_DOMAIN_ID": "²"}, "ROS_DOMAIN_ID is '²'"),
        ({"ROS_LOCALHOST_ONLY": "yes"}, "ROS_LOCALHOST_ONLY is 'yes', not 0 or 1"),
        (
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"},
            "ROS_AUTOMATIC_DISCOVERY_RANGE is 'localhost', not one of LOCALHOST, SUBNET, OFF",
        ),
        (
            {
                "CYCLONEDDS_URI": "<CycloneDDS><Domain><General><Interfaces>"
                '<NetworkInterface name="nope0"/></Interfaces></General></Domain></CycloneDDS>'
            },
            r"nope0: does not match an available interface.*CYCLONEDDS_URI .*: lo",
        ),
        ({"CYCLONEDDS_URI": "<CycloneDDS></Domain>"}, "parser error.*correct CYCLONEDDS_URI"),
        ({"CYCLONEDDS_URI": "<Größe/>"}, "cannot be opened.*correct CYCLONEDDS_URI"),
        (
            {"CYCLONEDDS_URI": "<Domain><General><Transport>udp6</Transport></General></Domain>"},
            "127.0.0.1: unknown address; correct CYCLONEDDS_URI",
        ),
        ({"ROS_STATIC_PEERS": "127.0.0.1;a b"}, "ROS_STATIC_PEERS: 'a b' is not found"),
        ({"ROS_STATIC_PEERS": "127.0.0.1;::1"}, "ROS_STATIC_PEERS: '::1' is not found as an IPv4 host"),
    ],
)
def test_a_network_that_cannot_be(native_path, monkeypatch, capfd, variables, culprit):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert main(["publish", str(native_path), "--stop-time", "0.1"]) == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert re.match(f"twodof: error: .*{culprit}", line), line


def test_without_cyclone_dds_it_names_the_package_to_install(native_path):
    missing = "import sys; sys.modules['cyclonedds'] = None; "
    code = missing + "from twodof.__main__ import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "publish", str(native_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "install the extra 'ros': " in line


def test_options_beside_an_experiment_are_refused(native_path):
    run = twodof.experiment(native_path, stop_time=0.02)
    with pytest.raises(InputError, match="stop_time would have no effect with an experiment"):
        twodof.publish(run, stop_time=1.0)


def test_a_publisher_sends_each_run_its_own_settings(native_path, number, listen):
    """The second run may have another robot."""
    publisher = twodof.Publisher(network_of_environment(environment(number)), scene=True)
    run = twodof.experiment(native_path, stop_time=0.02)
    twodof.publish(run, publisher=publisher)
    node = listen("/robot_description", "/joint_states")

    def heard() -> bool:
        return bool(node.messages("/robot_description"))

    twodof.publish(twodof.experiment(native_path), publisher=publisher, stop=heard)
    node.until(heard)


def test_robots_whose_fmus_would_be_one_file_are_refused(tmp_path, monkeypatch, capsys):
    """Otherwise the second would run as both."""
    monkeypatch.chdir(tmp_path)
    shipped = data_file("urdf", "2dof.urdf").read_text()
    for maker, mass in (("one", "0.18"), ("other", "9.18")):
        Path(maker).mkdir()
        Path(maker, "arm.urdf").write_text(shipped.replace('mass value="0.18', f'mass value="{mass}'))
    robots = ["a=one/arm.urdf", "b=other/arm.urdf"]
    assert main(["publish", *robots, "--stop-time", "0.01"]) == 1
    assert "'arm.fmu' is another FMU, and is not replaced" in capsys.readouterr().err
    assert main(["publish", *robots, "--stop-time", "0.01", "--overwrite", "-o", "bag"]) == 2
    told = "the FMU of 'other/arm.urdf' would be 'arm.fmu' as the robot before it is"
    assert told in capsys.readouterr().err


def test_the_name_of_a_robot_is_printed_as_given(native_path, capsys):
    assert main(["publish", f"1={native_path}", "--stop-time", "0.01"]) == 1
    assert "NAME=FMU '1' is not a valid ROS 2 name" in capsys.readouterr().err
    run = twodof.experiment(native_path, stop_time=0.1)
    with pytest.raises(InputError, match="`robots` '1' is not a valid ROS 2 name"):
        twodof.publish_together({"1": run})
