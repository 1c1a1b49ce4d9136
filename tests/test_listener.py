"""Robots in closed loop with a controller in C++ on Fast DDS: lockstep, clock and pause.

The references are the loop closed in Python by the same equation, and the bag read by the MCAP project.
"""

# ruff: noqa: E402

import functools
import json
import re
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import SECOND
from harness import wait_until
from mcap.reader import make_reader
from nodes import ended, environment, published, recorded, stamp_of
from tools import needs

needs("cyclonedds")

import twodof
from twodof.cli.main import main
from twodof.errors import PublishError
from twodof.ros.network import network_of_environment

GAINS = {2: (2.0, 0.2), 7: (60.0, 8.0)}
GOALS = {2: (0.9, -0.6), 7: (0.3, -0.4, 0.2, -1.8, 0.1, 1.6, 0.5)}


def pd(sample: twodof.Sample, n: int) -> list[float]:
    """The effort of the controller in C++."""
    return answer(n, sample.q, sample.v)


def answer(n: int, q: Sequence[float], v: Sequence[float]) -> list[float]:
    kp, kd = GAINS[n]
    return [kp * (goal - q) - kd * v for goal, q, v in zip(GOALS[n], q, v)]


def control(n: int) -> list[str]:
    return ["--control", "/joint_states", "/joint_commands", *map(str, (*GAINS[n], *GOALS[n]))]


@pytest.fixture(scope="module")
def bare(tmp_path_factory, panda):
    """The bare plant of the default arm (2 joints) and of the Panda (7)."""
    folder = tmp_path_factory.mktemp("bare")

    @functools.cache
    def build(n: int) -> Path:
        options: dict[str, Any] = {"control": "effort", "native": True}
        if n == 7:
            (folder / "panda.urdf").write_text(panda)
            options |= {"urdf": folder / "panda.urdf", "frame": "panda_link8", "meshes": False}
        return twodof.build_fmu(folder / f"Bare{n}.fmu", twodof.FmuOptions(**options))

    return build


@pytest.fixture(scope="module")
def jointed(tmp_path_factory):
    """The default arm under joint control."""
    path = tmp_path_factory.mktemp("joint") / "Joint.fmu"
    return twodof.build_fmu(path, twodof.FmuOptions(control="joint", native=True))


def messages(bag: Path) -> list[tuple[str, int, bytes]]:
    """Topics, stamps and bytes; the division of the file into chunks depends on the wall clock."""
    with (bag / f"{bag.name}.mcap").open("rb") as file:
        return [(c.topic, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]


def closed(fmu: Path, n: int, steps: int, delay: Callable[[int], int]) -> Iterator[twodof.Sample]:
    """The loop closed in Python; the command of step k answers the sample a number of steps before."""
    past: list[list[float]] = []
    run = twodof.samples(fmu, step=0.01, stop_time=steps * 0.01)
    sample = next(run)
    while True:
        yield sample
        past.append(pd(sample, n))
        if sample.k == steps:
            return
        at = sample.k - delay(sample.k)
        sample = run.send({"tau_cmd": past[at]} if at >= 0 else None)


def test_lockstep_is_the_loop_closed_in_python_bit_for_bit(bare, tmp_path, number, listen, length):
    fmu, steps = bare(7), length(6000, 1000)
    node = listen(*control(7))
    bag = tmp_path / "bag"
    options = ["--lockstep", "--stamp-start", "1000", "--stop-time", str(steps / 100)]
    with published(number, fmu, *options, "--rate", "100", "-o", str(bag)) as process:
        out, err = ended(process)
    assert err == ""
    print(re.search("time .*", out))
    states = recorded(bag)["/joint_states"]
    assert [stamp_of(state[0]) for state in states] == [1000 * SECOND + k * SECOND // 100 for k in range(steps + 1)]
    truth = [[[*s.q], [*s.v]] for s in closed(fmu, 7, steps, lambda k: 0)]
    assert [state[2:4] for state in states] == truth
    node.leave()
    assert node.told[-1] == ["controlled", steps + 1] or node.told[-1][1] > steps  # first repeated


def test_lockstep_gives_the_same_bytes_each_time(bare, tmp_path, number, listen, length):
    fmu, contents = bare(2), []
    options = ["--lockstep", "--stamp-start", "1000", "--stop-time", "2", "--scene"]
    bag = tmp_path / "bag"
    for _ in range(length(10, 2)):
        node = listen(*control(2))
        with published(number, fmu, *options, "--overwrite", "-o", str(bag)) as process:
            assert ended(process)[1] == ""
        node.leave()
        provenance = json.loads((bag / "run.json").read_text())
        ((t, facts),) = provenance.pop("commanders")  # DDS gives each process a name of its own
        assert t == 0.0 and "guid" in facts
        contents.append((provenance, messages(bag)))
    assert all(content == contents[0] for content in contents)
    assert len(contents[0][0]["input_changes"]) > 160


def test_a_controller_in_real_time_misses_nothing(bare, tmp_path, number, listen, length):
    """Each step uses the answer to a recent sample; with the same delays, results are bit-identical."""
    fmu, steps = bare(7), 100 * length(60, 4)
    node = listen("/joint_states", *control(7))
    bag = tmp_path / "bag"
    options = ["--stop-time", str(steps / 100), "--timeout", "10", "-o", str(bag)]  # of a busy machine
    with published(number, fmu, *options) as process:
        _, err = ended(process)
    assert err == ""
    states = recorded(bag)["/joint_states"]
    node.sees(states[-1])
    heard = node.messages("/joint_states")
    assert heard == states[-len(heard) :] and len(heard) > 100  # all since it joined
    node.leave()
    assert node.told[-1] == ["controlled", len(heard)]
    answers = {tuple(answer(7, *state[2:4])): k for k, state in enumerate(states)}
    held: dict[str, float] = {}
    delays, applied = {}, []
    for t, values in json.loads((bag / "run.json").read_text())["input_changes"]:
        held |= values
        k = round(t * 100)
        delays[k] = k - answers[tuple(held[f"tau_cmd[{i + 1}]"] for i in range(7))]
        applied.append(k - delays[k])
    assert applied == sorted(set(applied))  # in their order, none twice
    assert min(delays.values()) >= 0
    print(f"{len(applied)} of {len(heard)} answers applied, delays {sorted({*delays.values()})}")
    first = min(delays)
    latest: dict[int, int] = {}
    for k in range(steps):
        latest[k] = k - delays[k] if k in delays else latest.get(k - 1, -1)
    truth = closed(fmu, 7, steps, lambda k: k - latest[k] if k >= first else k + 1)
    assert [state[2:4] for state in states] == [[[*s.q], [*s.v]] for s in truth]


@pytest.mark.parametrize(
    ("topics", "command", "missing"),
    [
        ((), "", "nobody publishes on /joint_commands"),
        (("/joint_commands=command",), "", "nobody subscribes to /joint_states"),
        (("/joint_commands=command", "/joint_states"), "", "the publisher on /joint_commands sends nothing"),
        (
            ("/joint_commands=command", "/joint_states"),
            "1 5000000007 joint1 - - 0.1",
            "the latest on /joint_commands is stamped 5.000000007 s, not 9.000000000 s;"
            " a command has the stamp of the state that it answers",
        ),
    ],
)
def test_lockstep_names_the_missing_node(bare, tmp_path, number, listen, topics, command, missing):
    node = listen(*topics) if topics else None

    def opened(publisher: twodof.Publisher) -> None:
        """Wait until both have found each other, as a timeout does not."""
        if node is None:
            return
        node.until(lambda: all(["matched", it.split("=")[0], 1] in node.told for it in topics))
        wait_until(lambda: publisher._listener.is_matched("/joint_commands"))
        if len(topics) > 1:
            wait_until(publisher._writers["/joint_states"].get_matched_subscriptions)
        if command:
            node.say(f"/joint_commands {command}")

    place, bag = network_of_environment(environment(number)), twodof.Bag(tmp_path / "bag")
    publisher = twodof.Publisher(place, lockstep=True, timeout=0.5, opened=opened)
    expected = rf"no command for the sample at t = 0 s in 0[.]\d+ s: {re.escape(missing)}"
    with pytest.raises(PublishError, match=expected):
        twodof.publish(bare(2), bag, publisher=publisher, stamp_start=9.0)
    assert len(recorded(tmp_path / "bag")["/joint_states"]) == 1


def test_a_controller_that_stalls_dies_and_returns(bare, tmp_path, number, listen):
    bag = tmp_path / "bag"
    with published(number, bare(2), "--effort", "-o", str(bag)) as process:
        watch = listen("/joint_states")
        node = listen(*control(2))

        def efforts() -> list[float]:
            return [abs(m[4][0]) + abs(m[4][1]) for m in watch.messages("/joint_states")]

        watch.until(lambda: efforts() and efforts()[-1] > 0.0)
        node.process.send_signal(signal.SIGSTOP)
        watch.until(lambda: efforts()[-1] == 0.0)
        node.process.send_signal(signal.SIGCONT)
        watch.until(lambda: efforts()[-1] > 0.0)
        node.process.kill()
        node.leave()
        watch.until(lambda: efforts()[-1] == 0.0)
        listen(*control(2))
        watch.until(lambda: efforts()[-1] > 0.0)
        process.send_signal(signal.SIGINT)
        _, err = ended(process, 130)
    assert err.count("no command for 0.5 s: efforts go to 0") == 1
    tau = np.array([state[4] for state in recorded(bag)["/joint_states"]])
    silent = np.flatnonzero((tau[1:] == 0).all(axis=1) & (tau[:-1] != 0).any(axis=1))
    assert len(silent) >= 2  # a busy machine has its own
    for k in silent:  # ramps: in equal steps, of which the last ends at 0
        np.testing.assert_allclose(np.diff(tau[k - 40 : k + 1], n=2, axis=0), 0.0, atol=1e-9)


def test_invalid_or_extreme_commands_end_no_run(bare, tmp_path, number, listen):
    """The former have one warning for each kind; a step with the latter is refused."""
    bag = tmp_path / "bag"
    node = listen("/joint_states", "/joint_commands=command")
    yesterday = time.time_ns() - 86_400 * SECOND
    slow = ("--set", "gravity=0", "--set", "damping=1")  # no joint reaches a stop, which withstands any effort
    with published(number, bare(2), "-o", str(bag), *slow) as process:
        node.hears()
        for _ in range(3):
            for line in (
                "1 0 joint1,joint2 - - nan,1.0",
                "1 0 elbow - - 1.0",
                "1 0 joint1,joint2 - - 1.0",
                f"1 {yesterday} joint1 - - 1.0",
                "1 0 joint1,elbow - - 0.25,1.0",
                "1 0 \udcff - - 1.0",  # no UTF-8
            ):
                node.say(f"/joint_commands {line}")
            node.hears()
        node.say("/joint_commands 1 0 joint1,joint2 - - 1e300,-1e300")
        node.hears(more=120)
        process.send_signal(signal.SIGINT)
        _, err = ended(process, 130)
    changes = json.loads((bag / "run.json").read_text())["input_changes"]
    first, *values = [values for _, values in changes]
    assert first == {"tau_cmd[1]": 0.25}
    for ramp in values:  # to 0, where no command comes in time
        assert ramp.keys() == {"tau_cmd[1]"} and 0.0 <= ramp["tau_cmd[1]"] <= 0.25
    assert np.isfinite([state[2:4] for state in recorded(bag)["/joint_states"]]).all()
    found = sorted(line.removeprefix("WARNING: a command on /joint_commands ") for line in err.splitlines())
    expected = [
        "WARNING: no command for 0.5 s",
        "WARNING: step ",
        "cannot be read",
        "has 1 efforts for 2 joints",
        "has a stamp 8.64e+04 s older than its sample",
        "is not finite",
        "names joints that this robot does not have",
        "names no joint of this robot: 'elbow'",
    ]
    assert len(found) == len(expected)
    for line, text in zip(found, expected):
        assert line.startswith(text)


def test_a_flood_of_commands_holds_nothing_up(jointed, tmp_path, number, listen):
    """Some 10,000 arrive in a second; the newest applies."""
    bag = tmp_path / "bag"
    node = listen("/joint_states", "/joint_commands=command")
    with published(number, jointed, "-o", str(bag)) as process:
        node.hears()
        command = "0 joint2,joint1 0.1,0.2 - -"
        node.insists(f"/joint_commands 1 {command}", lambda: node.messages("/joint_states")[-1][2][0] > 0.1)
        node.say(f"/joint_commands 5000 {command}")
        node.say("/joint_commands 1 0 joint2,joint1 0.3,0.4 - -")
        node.until(lambda: np.allclose(node.messages("/joint_states")[-1][2], (0.4, 0.3), atol=1e-2))
        process.send_signal(signal.SIGINT)
        ended(process, 130)
    changes = json.loads((bag / "run.json").read_text())["input_changes"]
    targets = [(v["q_des[1]"], v["q_des[2]"]) for _, v in changes]
    assert targets == [(0.2, 0.1), (0.4, 0.3)]


def test_names_of_topics(jointed, number, listen):
    """A namespace applies to names without a leading slash."""
    options = ["--namespace", "left", "--state-topic", "/robot_joint_states", "--scene", "--clock"]
    node = listen("/robot_joint_states=state", "/clock=clock", "/left/arm/command=command")
    with published(number, jointed, *options, "--command-topic", "arm/command") as process:
        node.hears("/robot_joint_states")
        node.hears("/clock")
        node.until(lambda: ["matched", "/left/arm/command", 1] in node.told)
        topics = process.told[0].split(maxsplit=1)[1].strip().split(", ")
    assert {*topics} == {
        "/robot_joint_states",
        "/clock",
        "/left/tf",
        "/left/tf_static",
        "/left/robot_description",
        "/left/end_effector",
    }


def test_several_robots_are_in_step_and_apart(bare, jointed, tmp_path, number, listen):
    """All share a clock and its stamps; a command moves only its robot."""
    robots = [f"left={jointed}", f"right={jointed}", str(bare(2))]
    names = ("left", "right", "Bare2")
    topics = [f"/{name}/joint_states" for name in names]
    node = listen(*(f"{t}=state" for t in topics), "/clock=clock", "/right/joint_commands=command")
    bag = tmp_path / "bag"
    with published(number, *robots, "--clock", "-o", str(bag), "--stop-time", "6") as process:  # type: ignore[arg-type]
        node.hears("/Bare2/joint_states", more=50)
        command = "/right/joint_commands 1 0 joint1,joint2 0.9,-0.6 0,0 -"
        node.insists(command, lambda: node.messages("/right/joint_states")[-1][2][0] > 0.5)
        _, err = ended(process)
    assert err.startswith("WARNING: no command for 0.5 s: the last one is held")
    assert err.count("WARNING") == 1
    bags = [recorded(bag)[topic] for topic in topics]
    stamps = [stamp_of(state[0]) for state in bags[0]]
    assert len(stamps) == 601 and all([stamp_of(s[0]) for s in b] == stamps for b in bags)
    for topic, states in zip(topics, bags):
        heard = node.messages(topic)
        assert len(heard) > 300 and heard == states[-len(heard) :]
    arrivals = [[it[2] for it in node.told if it[:2] == ["message", t]][-300:] for t in topics]
    apart = np.ptp(arrivals, axis=0)
    usual, most = np.quantile(apart, (0.5, 0.99)) / 1e6
    print(f"three robots within {usual:.3f} ms, 99 % within {most:.3f} ms")
    ends = [state[-1][2] for state in bags]
    assert np.abs(np.subtract(ends[1], [0.9, -0.6])).max() < 0.2  # it was 0.95
    alone = [[*s.q] for s in twodof.samples(jointed, step=0.01, stop_time=6.0)]
    assert [state[2] for state in bags[0]] == alone


@pytest.mark.parametrize("speed", [0.1, 10.0])
def test_the_clock_is_that_of_the_simulation(native_path, number, listen, speed):
    node = listen("/clock=clock", "/joint_states")
    end = 4 * speed
    options = ["--clock", "--speed", str(speed), "--stamp-start", "100"]
    begin = time.time_ns()
    with published(number, native_path, *options, "--stop-time", str(end)) as process:
        assert ended(process)[1] == ""
    told = [it for it in node.told if it[:2] == ["message", "/clock"]]
    stamps = [seconds * SECOND + rest for _, _, _, (seconds, rest) in told]
    points = [100 * SECOND + k * SECOND // 100 for k in range(round(end * 100) + 1)]
    states = [stamp_of(m[0]) for m in node.messages("/joint_states")]
    for heard in (stamps, states):  # at 1,000 a second a busy machine may lose some
        assert heard == sorted({*heard} & {*points}) and len(heard) > len(points) / 2
    assert (told[-1][2] - begin) / SECOND >= end / speed  # never ahead of the wall clock


def test_pause_and_step(native_path, number, listen):
    node = listen("/clock=clock", "/pause=bool", "/step=uint")

    def clock() -> list[int]:
        return [seconds * SECOND + rest for seconds, rest in node.messages("/clock")]

    def stands() -> bool:
        before = clock()[-1]
        time.sleep(0.6)
        return clock()[-1] == before

    with published(number, native_path, "--clock", "--stamp-start", "0") as process:
        node.hears("/clock")
        node.insists("/pause true", stands)
        paused = clock()[-1]
        node.insists("/step 3", lambda: clock()[-1] > paused)
        node.until(stands)
        paused = clock()[-1]
        node.say("/step 3")  # once, to one who is known to hear it
        node.until(lambda: clock()[-1] > paused)
        node.until(stands)
        assert clock()[-1] == paused + 3 * SECOND // 100
        before = len(clock())
        node.say("/pause false")
        node.hears("/clock", more=80)
        arrivals = [it[2] for it in node.told if it[:2] == ["message", "/clock"]][before:]
        assert arrivals[79] - arrivals[0] > 0.4 * SECOND  # what was missed is not made up for
        process.send_signal(signal.SIGINT)
        assert ended(process, 130)[1] == ""
    assert np.ptp(np.diff(clock())) == 0


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        (["--namespace", "a b"], "--namespace 'a b' is not a valid ROS 2 name"),
        (["--state-topic", "1st"], "--state-topic '1st' is not a valid ROS 2 name"),
        (["--command-topic", "joint_states"], "--command-topic '/joint_states' is a topic that"),
        (["--clock", "--state-topic", "/clock"], "'/clock' would be two topics"),
        (["--scene", "--state-topic", "tf"], "'/tf' would be two topics"),
        (["--clock", "--command-topic", "/pause"], "'/pause' would be two topics"),
        (["--speed", "0"], "--speed 0 must be > 0"),
        (["--speed", "inf"], "--speed inf must be > 0"),
        (["--timeout", "-1"], "--timeout -1 must be > 0 s"),
        (["--on-timeout", "ramp"], "--on-timeout 'ramp' is for control 'effort'"),
        (["--rate", "0"], "--rate 0: not a number of steps a second"),
        (["--rate", "nan"], "--rate nan"),
        (["--rate", "inf"], "--rate inf"),
        (["--overwrite"], "--overwrite has no effect without -o"),
        (["--stop-time", "0.005"], "the run of 0.005 s is not a whole number of steps of 0.01 s"),
        (["--on-timeout", "hold", "--lockstep"], "--on-timeout applies to joint commands without --lockstep"),
    ],
)
def test_options_that_cannot_be(jointed, capfd, options, culprit):
    usage = options[0] in ("--rate", "--overwrite")
    assert main(["publish", str(jointed), "--stop-time", "0.1", *options]) == (2 if usage else 1)
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"twodof: error: {culprit}"), line


def test_a_timeout_of_nothing(native_path, capfd):
    assert main(["publish", str(native_path), "--stop-time", "0.1", "--timeout", "1"]) == 1
    assert "--timeout applies to joint commands and to --lockstep only" in capfd.readouterr().err
