"""One bag of several robots: each robot's part equals a bag of that robot alone."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Barrier
from typing import Any

import numpy as np
import pytest
from bags import PERIOD, START, STORAGES, read_ends
from harness import wait_until
from rosbags.rosbag2 import Reader

import twodof
from twodof.bag.provenance import robots_of
from twodof.bag.reader import read_bag
from twodof.bag.recovery import recover
from twodof.cli.main import main
from twodof.errors import BagError, InputError
from twodof.simulation.experiments import Experiment, experiment
from twodof.simulation.master import Member, simulate_together

NAMES = {"left": "effort", "fleet/right": "task", "fleet_right": "pose"}


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    return {
        name: twodof.build_fmu(folder / f"{control}.fmu", twodof.FmuOptions(control=control, native=True))
        for name, control in NAMES.items()
    }


def runs(fmus: dict[str, Path], stop_time: float = 0.5) -> dict[str, Experiment]:
    return {name: experiment(fmu, stop_time=stop_time, step=0.01, stamp_start=START) for name, fmu in fmus.items()}


def messages_of(bag: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Stamps and bytes by topic, by rosbags."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    with Reader(bag) as reader:
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append((stamp, bytes(data)))
    return found


def steered(turn: Iterator[int]) -> dict[str, Any] | None:
    return {"x_des": (0.1, 0.2)} if next(turn) == 20 else None


def logged(fmus: dict[str, Path], path: Path, **options: Any) -> Path:
    """A bag of three robots, one of which receives new inputs."""
    steer = {"fleet/right": partial(steered, iter(range(10**6)))}
    bag = twodof.Bag(path, **options)
    simulate_together([Member(run, [bag.of(name)], steer.get(name, lambda: None)) for name, run in runs(fmus).items()])
    return path


@pytest.fixture(scope="module")
def three(fmus, tmp_path_factory):
    """A bag of three robots for reading."""
    return logged(fmus, tmp_path_factory.mktemp("three") / "bag", scene=True)


@pytest.mark.parametrize("storage", STORAGES)
def test_each_robot_has_its_topics_as_if_it_were_alone(fmus, tmp_path, storage):
    """By rosbags, they are bit-identical to those of a separate bag."""
    together = messages_of(logged(fmus, tmp_path / "bag", storage=storage, scene=True, effort=True))
    topics = set()
    for name, run in runs(fmus).items():
        alone = twodof.Bag(tmp_path / name, scene=True, effort=True)
        steer = partial(steered, iter(range(1000)))
        twodof.simulate(run, alone, steer=steer if name == "fleet/right" else dict)
        for topic, messages in messages_of(alone.path).items():
            assert together[f"/{name}{topic}"] == messages
            topics.add(f"/{name}{topic}")
    assert set(together) == topics and len(topics) == 17  # an effort has no target


def test_a_robot_is_read_by_its_address(fmus, three, tmp_path, capsys):
    bag = three
    for name, fmu in fmus.items():
        run = read_bag(f"{bag}:{name}")
        assert run.provenance["fmu"]["file"] == fmu.name
        changes = run.provenance["input_changes"]
        if name == "fleet/right":
            assert changes == [[0.2, {"x_des[1]": 0.1, "x_des[2]": 0.2}]]
            assert run.target[[0, 20, 21]].tolist() == [[0.2, 0.05], [0.2, 0.05], [0.1, 0.2]]
        else:
            assert changes == []
            expected = [s.q for s in twodof.samples(fmu, step=0.01, stop_time=0.5)]
            assert np.array_equal(run.q, expected)
        assert main(["info", "--json", f"{bag}:{name}"]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert (facts["joint_states"], facts["fmu"]["file"]) == (51, fmu.name)
        assert {topic["name"].startswith(f"/{name}/") for topic in facts["topics"]} == {True}
    assert main(["info", "--json", str(bag)]) == 0
    several = json.loads(capsys.readouterr().out)["robots"]
    assert [facts["path"] for facts in several] == [f"{bag}:{name}" for name in sorted(NAMES)]
    assert main(["plot", str(bag), "-o", str(tmp_path / "plot.png")]) == 0
    said = capsys.readouterr().out
    assert said.count("reached: ") == 2  # of those that have a target
    # what one robot was told, another is told again
    again = tmp_path / "again"
    options = ["--input", f"{bag}:fleet/right", "--stop-time", "0.5", "--step", "0.01"]
    assert main(["run", str(fmus["fleet/right"]), *options, "-o", str(again)]) == 0
    assert np.array_equal(read_bag(again).q, read_bag(f"{bag}:fleet/right").q)


def test_the_robot_of_a_bag_must_be_named(fmus, three, tmp_path, capsys):
    bag = three
    there = f"'{bag}:fleet/right', '{bag}:fleet_right', '{bag}:left'"
    for of, reason in (("", "is of several robots; give one"), (":no", "has no robot 'no'")):
        with pytest.raises(BagError, match=reason) as refusal:
            read_bag(f"{bag}{of}")
        assert there in str(refusal.value)
    assert main(["view", str(bag), "--export", str(tmp_path / "page.html")]) == 1
    assert there in capsys.readouterr().err and not (tmp_path / "page.html").exists()
    only = twodof.Bag(tmp_path / "only").of("left")
    twodof.simulate(runs(fmus)["left"], only)
    assert np.array_equal(read_bag(only.path).q, read_bag(only.address).q)
    alone = twodof.Bag(tmp_path / "alone")
    twodof.simulate(runs(fmus)["left"], alone)
    with pytest.raises(BagError, match="has one robot; leave ':left' out"):
        read_bag(f"{alone.path}:left")
    (alone.path / "run.old.json").write_bytes((alone.path / "run.json").read_bytes())
    assert np.array_equal(read_bag(alone.path).q, read_bag(only.path).q)  # a copy is no robot


def test_a_robot_in_anothers_namespace_has_its_own_topics(fmus, tmp_path, caplog):
    experiments, bag = runs(fmus), twodof.Bag(tmp_path / "bag")
    outer, inner = experiments["left"], experiments["fleet/right"]
    simulate_together([Member(outer, [bag.of("a")]), Member(inner, [bag.of("a/b")])])
    for name in ("a", "a/b"):
        topics = read_bag(f"{bag.path}:{name}").topics
        assert [topic.name for topic in topics] == [f"/{name}/joint_states"]
        assert [topic.name for topic in read_ends(f"{bag.path}:{name}").topics] == [f"/{name}/joint_states"]
    assert not caplog.records
    (file,) = bag.path.glob("*.mcap")
    alone = file.rename(tmp_path / "alone.mcap")  # without what says whose topics are whose
    for read in (read_bag, read_ends):
        caplog.clear()
        assert read(alone).joints == ("joint1", "joint2")
        (warning,) = caplog.messages
        assert "has several topics of joint states, /a/joint_states, /a/b/joint_states" in warning


@pytest.mark.parametrize("names", [("a", "/a"), ("", "a"), ("a", "")])
def test_robots_need_names_that_differ(fmus, tmp_path, names):
    run = runs(fmus)["left"]
    bag = twodof.Bag(tmp_path / "bag")
    members = [Member(run, [bag.of(name) if name else bag]) for name in names]
    with pytest.raises(BagError, match="need namespaces that differ"):
        simulate_together(members)
    with pytest.raises(InputError, match="'1st' is not a valid ROS 2 name"):
        bag.of("1st")


def test_no_robot_joins_a_bag_late(fmus, tmp_path):
    run = runs(fmus)["left"]
    bag = twodof.Bag(tmp_path / "bag")
    early, late = bag.of("early").begin(run), bag.of("late").begin(run)
    with early:
        for sample in twodof.samples(run):
            early.write(sample)
        with pytest.raises(BagError, match="accepts no further robot"), late:
            raise AssertionError
    assert read_bag(f"{bag.path}:early").count == 51


def test_a_robot_that_does_not_begin_costs_no_bag(fmus, tmp_path):
    kept = logged(fmus, tmp_path / "bag")
    before = (kept / "bag.mcap").read_bytes()
    bag = twodof.Bag(kept, overwrite=True)
    left, right, _ = runs(fmus).values()
    wrong = replace(right, given={**right.given, "rtol": -1.0})
    with pytest.raises(twodof.TwoDofError, match="rtol"):
        simulate_together([Member(left, [bag.of("left")]), Member(wrong, [bag.of("right")])])
    assert (kept / "bag.mcap").read_bytes() == before


@pytest.mark.needs("cyclonedds")
def test_a_sink_is_of_a_robot_that_there_is(fmus):
    with pytest.raises(InputError, match="'lift', but the robots are left, fleet/right"):
        twodof.publish_together(runs(fmus, 0.02), sinks={"lift": []})


def test_a_robot_that_comes_after_the_others_replaces_none(fmus, tmp_path):
    run = runs(fmus)["left"]
    bag = twodof.Bag(tmp_path / "bag", overwrite=True)
    for _ in range(2):  # the same run again may replace itself
        twodof.simulate(run, bag.of("early"))
    with pytest.raises(BagError, match="accepts no further robot"):
        twodof.simulate(run, bag.of("late"))
    assert read_bag(f"{bag.path}:early").count == 51


LOGGER = """
import sys
import twodof
from twodof.simulation.experiments import experiment
from twodof.simulation.master import Member, simulate_together

path, *fmus = sys.argv[1:]
bag = twodof.Bag(path)
simulate_together(
    [Member(experiment(fmu, stop_time=1e5, step=0.01, stamp_start=0), [bag.of(f"robot{i}")],
            lambda: {"f_ext": (0.1, 0.0, 0.0)})
     for i, fmu in enumerate(fmus)],
    pace=twodof.RealTime(),
)
"""


def test_a_killed_bag_is_recovered_with_all_its_robots(fmus, tmp_path):
    bag = tmp_path / "bag"
    command = [sys.executable, "-c", LOGGER, str(bag), *map(str, fmus.values())]
    with subprocess.Popen(command) as process:
        file = bag / "bag.mcap"
        wait_until(lambda: file.exists() and file.stat().st_size > 30_000)  # some flushes
        process.send_signal(signal.SIGKILL)
    with pytest.raises(BagError, match=f"twodof recover {bag}'"):
        read_bag(f"{bag}:robot0")
    recover(bag)
    parts = [read_bag(f"{bag}:robot{i}") for i in range(3)]
    counts = [part.count for part in parts]
    assert min(counts) > 0 and max(counts) - min(counts) <= 100  # a second
    for part, fmu in zip(parts, fmus.values()):
        assert set(np.diff(part.stamps)) == {PERIOD}
        assert part.provenance["fmu"]["file"] == fmu.name
        assert part.provenance["input_changes"][0][1] == {"f_ext[1]": 0.1}
    metadata = (bag / "metadata.yaml").read_text()
    assert all(f"twodof/robot{i}:" in metadata for i in range(3))


def test_a_bag_of_several_is_replaced_when_asked_to(fmus, tmp_path):
    bag = logged(fmus, tmp_path / "bag")
    with pytest.raises(BagError, match="exists already"):
        twodof.Bag(bag)
    (bag / "metadata.yaml").unlink()  # its writer died
    twodof.simulate(runs(fmus)["left"], twodof.Bag(bag, overwrite=True))
    assert sorted(file.name for file in bag.iterdir()) == ["bag.mcap", "metadata.yaml", "run.json"]


def test_a_bag_that_is_not_open_takes_no_sample(native_path, tmp_path):
    """The sample would be lost."""
    run = experiment(native_path, stop_time=0.1)
    bag = twodof.Bag(tmp_path / "bag")
    bag.begin(run)
    sample, *rest = twodof.samples(run)
    with pytest.raises(BagError, match="is not open"):
        bag.write(sample)
    with bag:
        bag.write(sample)
    with pytest.raises(BagError, match="is not open"):
        bag.write(rest[0])
    assert read_bag(tmp_path / "bag").count == bag.count == 1


def test_a_copy_of_a_robots_provenance_is_no_robot(tmp_path):
    files = [f"run.{name}.json" for name in ("left", "a%2Fb", "left copy", "left (1)", "left.old")]
    for file in files:
        (tmp_path / file).touch()
    assert robots_of(tmp_path) == ["a/b", "left"]


def test_a_robot_without_messages_is_known_by_its_provenance(native_path, tmp_path):
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.1)
    (tmp_path / "bag/run.json").rename(tmp_path / "bag/run.old.json")
    for read in (read_bag, read_ends):
        with pytest.raises(BagError, match=r"no joint states of the robot of its run\.old\.json"):
            read(tmp_path / "bag")


def test_a_robots_bag_is_recovered_by_its_folder(three, tmp_path):
    bag = three
    with pytest.raises(BagError, match=rf"there is no bag '.*:left'; 'twodof recover {bag}' repairs"):
        recover(f"{bag}:left")
    with pytest.raises(BagError, match=r"there is no bag '[^']*none'; make one with 'twodof run'$"):
        recover(tmp_path / "none")


def test_each_robot_may_have_its_own_thread(native_path, tmp_path):
    """They open, begin and end at the same instant."""
    run, names = runs({"robot": native_path}, 0.1)["robot"], ("left", "right")
    samples = list(twodof.samples(run))
    for trial in range(3):
        bag, turn = twodof.Bag(tmp_path / f"{trial}"), Barrier(len(names))

        def log(name: str, bag: twodof.Bag = bag, turn: Barrier = turn) -> None:
            robot = bag.of(name).begin(run)
            turn.wait()
            with robot:
                turn.wait(20)
                for sample in samples:
                    robot.write(sample)
                turn.wait(20)

        with ThreadPoolExecutor(len(names)) as threads:
            list(threads.map(log, names))
        for name in names:
            assert read_bag(f"{bag.path}:{name}").q.tolist() == [list(s.q) for s in samples]
