"""Commands of bags replayed into an FMU; rosbags writes the third-party bags."""

import html
import json
import tracemalloc
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from bags import STORE, header, joint_message, write_third_party
from rosbags.rosbag2 import StoragePlugin

import twodof
from twodof.bag import recorded_commands
from twodof.cli.main import main
from twodof.errors import InputError
from twodof.ros.messages import POINT

BEGIN = 1_700_000_000_000_000_000
STEP = 10_000_000  # ns


ONE = joint_message(0, ("joint1",), (), (), (1.0,))


def point(stamp: int, x: float, y: float) -> Any:
    place = STORE.types["geometry_msgs/msg/Point"](x, y, 0.0)
    return STORE.types[POINT](header(stamp, "world"), place)


@pytest.fixture(scope="module")
def effort(tmp_path_factory):
    """The bare default arm."""
    path = tmp_path_factory.mktemp("effort") / "Bare.fmu"
    return twodof.build_fmu(path, twodof.FmuOptions(control="effort", native=True))


def test_a_recorded_run_is_replayed_bit_for_bit(native_path, tmp_path):
    targets = {0: (0.1, 0.2), 70: (0.22, 0.05), 71: (0.2, 0.0), 150: (0.0, 0.25)}
    run = twodof.experiment(native_path, stop_time=2, step=0.01, settings={"Kp": 80})
    source = twodof.samples(run)
    with twodof.Bag(tmp_path / "first").begin(run) as bag:
        sample = next(source)
        while True:
            bag.write(sample)
            if sample.k == 200:
                break
            given = targets.get(sample.k)
            sample = source.send({"x_des": given} if given else None)
    options = ["--set", "Kp=80", "--stop-time", "2", "-o", str(tmp_path / "again")]
    assert main(["run", str(native_path), "--input", str(tmp_path / "first"), *options]) == 0
    first, again = (twodof.read_bag(tmp_path / name) for name in ("first", "again"))
    np.testing.assert_array_equal(first.q, again.q)
    np.testing.assert_array_equal(first.v, again.v)
    changes = [json.loads((b.path / "run.json").read_text())["input_changes"] for b in (first, again)]
    assert changes[0] == changes[1] and len(changes[0]) == 4


def test_a_run_without_changes_is_replayed_from_its_start(native_path, tmp_path, capfd):
    settings = {"x_des": (0.1, 0.2), "Kp": 80.0}
    twodof.simulate(native_path, twodof.Bag(tmp_path / "first"), stop_time=1, settings=settings)
    command = ["run", str(native_path), "--input", str(tmp_path / "first"), "--stop-time", "1"]
    assert main([*command, "-o", str(tmp_path / "again")]) == 0
    first, again = (twodof.read_bag(tmp_path / name) for name in ("first", "again"))
    np.testing.assert_array_equal(first.q, again.q)
    np.testing.assert_array_equal(first.target, again.target)
    assert main([*command, "-o", str(tmp_path / "other"), "--set", "x_des=0.2,0.1"]) == 0
    other = twodof.read_bag(tmp_path / "other")
    np.testing.assert_array_equal(other.target[0], (0.2, 0.1))  # what is said has the last word
    assert other.provenance["start_values"]["Kp[1]"] == 80.0


def test_a_change_of_a_vector_counts_for_each_element(native_path, tmp_path, monkeypatch):
    twodof.run(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.05, changes=[(0.01, {"x_des": 0.2})])
    file = tmp_path / "bag/run.json"
    content = json.loads(file.read_text())
    content["input_changes"] = [[0.01, {"x_des": 0.2}]]
    file.write_text(json.dumps(content))
    for room, fits in ((10, True), (9, False)):  # 8 for a change and 2 elements
        monkeypatch.setattr("twodof.bag.recorded_commands.MAX_HELD", room)
        with nullcontext() if fits else pytest.raises(InputError, match="has more than 9 values of inputs"):
            assert len(twodof.read_commands(native_path, tmp_path / "bag")) == 2


def test_a_run_of_another_control_is_not_replayed(native_path, effort, tmp_path, capfd):
    twodof.simulate(native_path, twodof.Bag(tmp_path / "first"), stop_time=0.1)
    command = ["run", str(effort), "--input", str(tmp_path / "first"), "-o", str(tmp_path / "a")]
    assert main(command) == 1
    assert "no variable 'x_des[1]': it belongs to control 'task' or" in capfd.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("storage", StoragePlugin)
def test_commands_of_another_writer(effort, tmp_path, storage):
    """Each applies from the first communication point at or after it, as on the network."""
    given = {0: (1.0, 0.5), 3: (-2.0, 0.25), 40: (0.5, -0.5)}
    states = [
        ("/joint_states", BEGIN + k * STEP, joint_message(0, ("joint1", "joint2"), (0.0, 0.0))) for k in range(100)
    ]
    commands = [
        ("/cmd", BEGIN + k * STEP - 7, joint_message(5, ("joint2", "joint1"), (), (), tau[::-1]))
        for k, tau in given.items()
    ]
    bag = write_third_party(tmp_path / "real", sorted(states + commands, key=lambda m: m[1]), storage_plugin=storage)
    model = tmp_path / "model"
    options = ["--stop-time", "0.99", "-o", str(model)]
    assert main(["run", str(effort), "--input", f"{bag}:/cmd", *options]) == 0
    source = twodof.samples(effort, stop_time=0.99)
    sample = next(source)
    for q in twodof.read_bag(model).q[1:]:
        tau = given.get(sample.k)
        sample = source.send({"tau_cmd": tau} if tau else None)
        assert tuple(q) == sample.q
    assert twodof.read_commands(effort, bag) == twodof.read_commands(effort, bag, "/cmd")


def test_points(native_path, tmp_path):
    goals = [(BEGIN, point(0, 0.1, 0.2)), (BEGIN + STEP, point(0, 0.2, 0.1))]
    bag = write_third_party(tmp_path / "bag", [("/goal", *goal) for goal in goals])
    assert twodof.read_commands(native_path, bag) == [
        (0.0, {"x_des[1]": 0.1, "x_des[2]": 0.2}),
        (0.01, {"x_des[1]": 0.2, "x_des[2]": 0.1}),
    ]


def test_commands_in_memory_are_bounded(native_path, tmp_path, monkeypatch):
    bag = write_third_party(tmp_path / "bag", [("/goal", BEGIN + i, point(0, 0.1, 0.2)) for i in range(10)])
    monkeypatch.setattr(recorded_commands, "MAX_COMMANDS_SIZE", 1000)
    with pytest.raises(InputError, match=r"more than \d+ messages or 0 MiB of them on /goal; cut it"):
        twodof.read_commands(native_path, bag)


def test_the_number_of_commands_is_bounded_by_the_size_of_the_bag(native_path, tmp_path, monkeypatch):
    """A command takes 0.08 ms, whereas a compressed one takes a few bytes; bags without compression are not refused."""
    goals = [("/goal", BEGIN + i, point(0, 0.1, 0.2)) for i in range(30)]
    bag = write_third_party(tmp_path / "bag", goals)
    monkeypatch.setattr(recorded_commands, "MAX_FREE_COMMANDS", 0)
    assert len(twodof.read_commands(native_path, bag)) == 30
    monkeypatch.setattr(recorded_commands, "MIN_COMMAND_PACKED", 10_000)
    with pytest.raises(InputError, match=r"more than \d messages or 384 MiB of them on /goal; cut it"):
        twodof.read_commands(native_path, bag)


@pytest.mark.parametrize(
    ("messages", "topic", "reason"),
    [
        ([("/a", BEGIN, point(0, 0.1, 0.2))], None, "no commands for this FMU, which follows"),
        ([("/joint_states", BEGIN, ONE)], None, "no commands for"),
        ([("/a", BEGIN, ONE)], "/b", "no commands on /b"),
        (
            [(name, BEGIN, ONE) for name in ("/a", "/b")],
            None,
            "several topics that can be commands: /a, /b; choose one",
        ),
        (
            [("/a", BEGIN, joint_message(0, ("joint1",), (), (), (float("nan"),)))],
            None,
            "the command at 0 s is not finite",
        ),
        ([("/a", BEGIN, joint_message(0, ["elbow"], (), (), (1.0,)))], None, "names no joint of this"),
    ],
)
def test_bags_that_cannot_be_replayed(effort, tmp_path, capfd, messages, topic, reason):
    bag = write_third_party(tmp_path / "bag", messages)
    given = f"{bag}:{topic}" if topic else str(bag)
    assert main(["run", str(effort), "--input", given, "-o", str(tmp_path / "none")]) == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("twodof: error: ") and reason in line
    assert not (tmp_path / "none").exists()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("last", [np.nan, np.inf])
def test_no_difference_is_printed_for_values_that_are_not_finite(tmp_path, capfd, last):
    """NumPy gives no warning either."""

    def bag(name: str, last: float) -> str:
        return str(
            write_third_party(
                tmp_path / name,
                [
                    ("/joint_states", BEGIN + k * STEP, joint_message(0, "ab", (a, 0.1)))
                    for k, a in enumerate((0.1, 0.1, last, last))
                ],
            )
        )

    bags = [bag("real", last), bag("model", 0.1)]
    assert main(["plot", *bags, "-o", str(tmp_path / "both.html")]) == 0
    said = f"; cannot be compared with 'real': a is not finite at {2 * STEP / 1e9:g} s\n"
    assert said in capfd.readouterr().out


def test_a_plot_of_two_bags_prints_their_largest_difference(tmp_path, capfd):
    """They have other sampling times, and different durations."""

    def bag(name: str, count: int, step: int, off: float) -> str:
        def q(k: int) -> tuple[float, float]:
            t = k * step / 1e9
            return (0.5 * t, 0.1 + off * t)

        return str(
            write_third_party(
                tmp_path / name,
                [("/joint_states", BEGIN + k * step, joint_message(0, "ab", q(k))) for k in range(count)],
            )
        )

    bags = [bag("real", 101, STEP, 0.0), bag("model", 80, 3 * STEP, 0.25)]
    assert main(["plot", *bags, "-o", str(tmp_path / "both.html")]) == 0
    text = "at most 0.25 from 'real', b at 1 s; RMS 0.145"
    assert f"; {text}\n" in capfd.readouterr().out
    assert text in html.unescape((tmp_path / "both.html").read_text())


def test_names_of_unknown_joints_take_little_memory(effort, tmp_path, caplog):
    """A message may name thousands of them."""
    names = ["joint1", *(f"stranger{i}" for i in range(2000))]
    message = joint_message(0, names, (), (), np.ones(len(names)))
    bag = write_third_party(tmp_path / "bag", [("/cmd", BEGIN + k * STEP, message) for k in range(100)])
    twodof.read_commands(effort, bag, "/cmd")  # imports
    tracemalloc.start()
    changes = twodof.read_commands(effort, bag, "/cmd")
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(changes) == 100 and held < 2 * 1024**2
    assert "joints that this robot does not have are ignored: 'stranger0, stranger1" in caplog.text
