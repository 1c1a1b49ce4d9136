"""The bag of a run records all of its inputs; distance and closed form follow from them alone."""

import importlib.metadata
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from bags import both_storages, metadata, sample
from harness import wait_until
from sinks import Collector

import twodof
from twodof.bag.provenance import MAX_TAIL
from twodof.bounds import MIB
from twodof.errors import TwoDofError
from twodof.pages.loop import Loop
from twodof.plots.track import read_tracks

TARGETS = {0: (0.22, 0.08), 20: (0.15, 0.1), 45: (0.1, 0.2)}  # by the step that they hold from
STEPS = 80


def by_settings(fmu: Path, bag: Path, samples: Collector) -> None:
    settings = {"x_des": (0.15, 0.1), "Kp": 80.0, "Kd": (20.0, 30.0)}
    twodof.simulate(fmu, samples, twodof.Bag(bag), stop_time=STEPS / 100, settings=settings)


def by_csv(fmu: Path, bag: Path, samples: Collector) -> None:
    table = bag.with_suffix(".csv")
    rows = (f"{k / 100 - 0.004},{x},{y}\n" for k, (x, y) in TARGETS.items())  # between two steps
    table.write_text("time,x_des[1],x_des[2]\n" + "".join(rows))
    twodof.simulate(fmu, samples, twodof.Bag(bag), stop_time=STEPS / 100, input_file=table)


def by_steering(fmu: Path, bag: Path, samples: Collector) -> None:
    def steer() -> dict[str, tuple[float, float]] | None:
        target = TARGETS.get(samples[-1].k)
        return None if target is None else {"x_des": target}

    twodof.simulate(fmu, samples, twodof.Bag(bag), stop_time=STEPS / 100, steer=steer)


def by_sending(fmu: Path, bag: Path, samples: Collector, every: int = 1) -> None:
    run = twodof.experiment(fmu, stop_time=math.inf)
    steps = twodof.samples(run)
    with twodof.Bag(bag).begin(run) as sink:
        sample = next(steps)
        while sample.k <= STEPS:
            if sample.k % every == 0:
                samples.append(sample)
                sink.write(sample)
            target = TARGETS.get(sample.k)
            sample = steps.send(None if target is None else {"x_des": target})


def by_a_thinned_loop(fmu: Path, bag: Path, samples: Collector) -> None:
    by_sending(fmu, bag, samples, every=7)


def by_the_page(fmu: Path, bag: Path, samples: Collector) -> None:
    """Send the requests of the page's controls between updates; the recording starts midway."""
    run = twodof.experiment(fmu, stop_time=math.inf)
    loop = Loop(run, bag=str(bag))
    loop.viewers = 1
    ended = False
    thread = Thread(target=loop.play, args=(lambda: ended,))
    thread.start()

    def more(until: Callable[[int], bool]) -> None:
        wait_until(lambda: until(round(100 * loop.news()["t"])))

    def later(begin: list[int], k: int) -> bool:
        begin.append(k)
        return k > begin[0] + 15

    more(lambda k: k > 5)
    loop.tell("record", True)
    for target in TARGETS.values():
        more(partial(later, []))
        loop.tell("change", {"x_des": target})
    more(partial(later, []))
    ended = True
    thread.join()
    # the recording's own samples are not told: run again with what it says, by the master
    stored = twodof.read_bag(bag)
    changes = [(t, dict(values)) for t, values in stored.provenance["input_changes"]]
    assert len(changes) == len(TARGETS)
    start = stored.provenance["start_time"]
    again = twodof.experiment(
        fmu, start_time=start, stop_time=start + (len(stored.t) - 1) / 100, settings=stored.provenance["start_values"]
    )
    due = iter(changes)
    change: tuple[float, dict[str, Any]] | None = next(due)

    def steer() -> dict[str, float] | None:
        nonlocal change
        if change is None or samples[-1].t < change[0] - 1e-9:
            return None
        values, change = change[1], next(due, None)
        return values

    twodof.simulate(again, samples, steer=steer)
    np.testing.assert_array_equal([sample.q for sample in samples], stored.q)


WAYS = [by_settings, by_csv, by_steering, by_sending, by_a_thinned_loop, by_the_page]


@pytest.mark.parametrize("way", WAYS)
def test_the_distance_shown_is_that_of_the_samples(way, native_path, tmp_path):
    samples = Collector()
    way(native_path, tmp_path / "bag", samples)
    (track,) = read_tracks([tmp_path / "bag"])
    assert track.task is not None and track.task.off is not None
    x = np.array([sample.x for sample in samples])
    targets = np.array([[sample.inputs[f"x_des[{k}]"] for k in (1, 2)] for sample in samples])
    different = len(np.unique(targets, axis=0))  # an answer to a sample comes after its own target
    assert different == 1 if way is by_settings else different >= len(TARGETS)
    np.testing.assert_allclose(track.task.error, np.linalg.norm(x - targets, axis=1), rtol=1e-9)
    assert track.task.off.max() <= 1e-9


LOOP = """
import math, sys, time
import twodof

fmu, path = sys.argv[1:]
run = twodof.experiment(fmu, stop_time=math.inf)
pace = twodof.RealTime()
steps = twodof.samples(run, pace=pace)
with twodof.Bag(path).begin(run) as bag:
    sample = next(steps)
    print("begun", flush=True)
    while True:
        bag.write(sample)
        turn = 0.05 * sample.k
        sample = steps.send({"x_des": (0.15 + 0.05 * math.cos(turn), 0.1 + 0.05 * math.sin(turn))})
"""


def stored_changes(bag: Path) -> int:
    return len(json.loads((bag / "run.json").read_text())["input_changes"])


def test_so_it_is_after_a_kill_up_to_the_last_flush(native_path, tmp_path):
    bag = tmp_path / "bag"
    command = [sys.executable, "-c", LOOP, str(native_path), str(bag)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"begun\n"
        wait_until(lambda: stored_changes(bag) > 20)
        time.sleep(0.3)
        os.kill(process.pid, signal.SIGKILL)
    assert twodof.recover(bag).counts["/joint_states"] > 20
    (track,) = read_tracks([bag])
    assert track.task is not None and track.task.off is not None
    assert track.task.off.max() <= 1e-9
    assert len(track.recording.provenance["input_changes"]) >= len(track.t) - 1


def test_target_is_the_one_on_its_topic_where_the_provenance_has_none(native_path, tmp_path):
    """The run.json is lost, or had no room for all changes."""
    samples = Collector()
    run = twodof.experiment(native_path, stop_time=STEPS / 100)
    steps = twodof.samples(run)
    with twodof.Bag(tmp_path / "bag", scene=True).begin(run) as sink:
        for sample in steps:
            samples.append(sample)
            sink.write(sample)
            if sample.k in TARGETS:
                samples.append(steps.send({"x_des": TARGETS[sample.k]}))
                sink.write(samples[-1])
    text = (tmp_path / "bag/run.json").read_text().strip()
    expected = np.array([math.dist(sample.x, sample.target or ()) for sample in samples])
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(json.loads(text)["urdf"])
    (tmp_path / "bag/run.json").write_text(f'{text[:-1]},"inputs_known_until":0.6}}')
    (full,) = read_tracks([tmp_path / "bag"])
    (tmp_path / "bag/run.json").unlink()
    (lost,) = read_tracks([tmp_path / "bag"], urdf=urdf, frame="EndEffector")
    for track in (full, lost):
        assert track.task is not None
        np.testing.assert_allclose(track.task.error, expected, atol=1e-12)
        assert track.task.closed_form is None  # whose gains and changes are not known
    (other,) = read_tracks([tmp_path / "bag"], urdf=_renamed_root(urdf), frame="EndEffector")
    assert other.motion is not None and other.task is None  # the points are in another frame


def _renamed_root(urdf: Path) -> Path:
    other = urdf.with_name("other.urdf")
    root = ET.fromstring(urdf.read_text())
    children = {child.get("link") for child in root.iter("child")}
    name = next(str(link.get("name")) for link in root.iter("link") if link.get("name") not in children)
    other.write_text(urdf.read_text().replace(f'"{name}"', '"elsewhere"'))
    return other


def test_unknown_facts_are_not_shown(native_path, tmp_path):
    """The file of changes is full: no distance is shown after its end."""
    bag = tmp_path / "bag"
    by_sending(native_path, bag, Collector())
    text = (bag / "run.json").read_text().strip()
    assert text.endswith("]}")
    (bag / "run.json").write_text(f'{text[:-1]},"inputs_known_until":0.6}}')
    (track,) = read_tracks([bag])
    assert track.motion is not None and track.task is None


# --- the file ---


@both_storages
def test_provenance_is_complete(native_path, tmp_path, storage):
    inputs = tmp_path / "inputs.csv"
    inputs.write_text("time,x_des[1],x_des[2]\n0.02,0.25,0.1\n0.05,0.2,0.05\n")
    run = twodof.experiment(native_path, stop_time=0.1, step=0.005, settings={"Kp": 80.0}, input_file=inputs)
    command_line = "twodof run --set Kp=80 --input inputs.csv"
    bag = twodof.Bag(tmp_path / "bag", storage=storage, command_line=command_line)
    twodof.simulate(run, bag)

    with zipfile.ZipFile(native_path) as fmu:
        description = ET.fromstring(fmu.read("modelDescription.xml"))
        urdf = fmu.read("resources/robot.urdf").decode()
    starts: dict[str, float | bool] = {}
    for variable in description.iter("ScalarVariable"):
        if variable.get("causality") in ("input", "parameter"):
            text = variable[0].get("start", "")
            starts[variable.get("name", "")] = text == "true" if variable[0].tag == "Boolean" else float(text)
    assert {"x_des[1]", "Kd[2]", "tau_ext[1]", "Kn", "q_max[2]", "limit_effort"} <= set(starts)

    found = json.loads((tmp_path / "bag" / "run.json").read_text("utf-8"))
    versions = found.pop("versions")
    assert found.pop("verdict")["samples"] == 21
    assert versions.pop("twodof") == twodof.__version__
    assert set(versions) >= {"fmpy", "numpy", "pin", "rosbags"}
    assert versions == {name: importlib.metadata.version(name) for name in versions}
    assert found == {
        "format": 1,
        "fmu": {"name": "TwoDof", "guid": description.get("guid"), "file": native_path.name},
        "robot": "2dof",
        "frame": "EndEffector",
        "root": "world",
        "axes": "xy",
        "joints": ["joint1", "joint2"],
        "start_time": 0.0,
        "step": 0.005,
        "start_values": {**starts, "Kp[1]": 80.0, "Kp[2]": 80.0},
        "input_changes": [[0.02, {"x_des[1]": 0.25, "x_des[2]": 0.1}], [0.05, {"x_des[1]": 0.2, "x_des[2]": 0.05}]],
        "command_line": command_line,
        "urdf": urdf,
    }


ANSWERS: dict[int, Any] = {2: {"x_des": (0.1, 0.2)}, 4: {"Kp[2]": 80.0}, 5: {"Kp[2]": 80.0}}
CHANGES = [[0.02, {"x_des[1]": 0.1, "x_des[2]": 0.2}], [0.04, {"Kp[2]": 80.0}]]


@both_storages
def test_provenance_has_each_change_of_an_input_that_a_loop_sends(native_path, tmp_path, storage):
    """The bag has every third sample."""
    run = twodof.experiment(native_path, stop_time=math.inf)
    steps = twodof.samples(run)
    with twodof.Bag(tmp_path / "bag", storage=storage).begin(run) as bag:
        sample = next(steps)
        while sample.k < 9:
            if sample.k % 3 == 0:
                bag.write(sample)
            sample = steps.send(ANSWERS.get(sample.k))
    provenance = twodof.read_bag(tmp_path / "bag").provenance
    assert provenance == json.loads(metadata(tmp_path / "bag")["custom_data"]["twodof"])
    assert provenance["input_changes"] == CHANGES


def test_changes_of_inputs_are_stored_with_the_messages_that_they_caused(native_path, tmp_path):
    """They are written at each flush, so that they survive the death of the process."""
    run = twodof.experiment(native_path, stop_time=math.inf)
    steps = twodof.samples(run)
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        sample = next(steps)
        for k in range(9):
            bag.write(sample)
            sample = steps.send(ANSWERS.get(k))
        shutil.copytree(bag.path, tmp_path / "early")
        there = bag.path / "run.json"
        wait_until(lambda: json.loads(there.read_text())["input_changes"] == CHANGES)
    assert json.loads((tmp_path / "early" / "run.json").read_text())["input_changes"] in (
        CHANGES[:0],
        CHANGES[:1],
        CHANGES,
    )


def test_provenance_has_the_time_at_which_it_was_full(run, tmp_path, monkeypatch):
    monkeypatch.setattr("twodof.bag.provenance.MAX_PROVENANCE", MAX_TAIL + 20_000)
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        for k in range(1000):
            inputs = {"x_des[1]": k / 7}
            bag.write(sample(run, k)._replace(inputs=inputs, since=(k - 1) / 100))
            if k % 250 == 0:
                bag._store.flush()
    text = (tmp_path / "bag" / "run.json").read_text()
    provenance = json.loads(text)
    changes = provenance["input_changes"]
    assert len(text) <= MAX_TAIL + 20_000
    assert 0 < len(changes) < 999
    assert provenance["inputs_known_until"] == round(changes[-1][0] * 100 + 1) / 100


def test_changes_beyond_the_limit_of_a_reader_are_not_known(run, tmp_path):
    """Each of 4000 inputs changes once: a file of 100 kB has 8 million values in effect. A change counts 8 more."""
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        for k in range(5):
            bag.write(sample(run, k))
    file = tmp_path / "bag" / "run.json"
    provenance = json.loads(file.read_text())
    provenance["input_changes"] = [[k / 1e5, {f"x{k}": 1.0}] for k in range(4000)]
    file.write_text(json.dumps(provenance))
    read = twodof.read_bag(tmp_path / "bag").provenance
    known = len(read["input_changes"])
    assert sum(range(9, known + 9)) <= 5_000_000 < sum(range(9, known + 10))
    assert read["inputs_known_until"] == known / 1e5


def test_custom_data_leaves_out_changes_that_take_yaml_minutes(run, tmp_path):
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        for k in range(20_000):
            inputs = {"x_des[1]": k / 7}
            bag.write(sample(run, k)._replace(inputs=inputs, since=(k - 1) / 100))
    for remake in (lambda: None, lambda: recovered(tmp_path / "bag")):
        remake()
        custom = json.loads(metadata(tmp_path / "bag")["custom_data"]["twodof"])
        assert (custom["input_changes"], custom["inputs_known_until"]) == ([], 0.0)
        assert len(twodof.read_bag(tmp_path / "bag").provenance["input_changes"]) == 20_000


def recovered(bag):
    (bag / "metadata.yaml").unlink()
    return twodof.recover(bag)


def test_a_robot_that_takes_yaml_minutes_is_left_out_of_custom_data(run, tmp_path):
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        bag.write(sample(run, 0))
    file = tmp_path / "bag/run.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "urdf": " ' " * 2**20}))
    recovered(tmp_path / "bag")
    assert "twodof" not in (metadata(tmp_path / "bag")["custom_data"] or {})
    assert len(twodof.read_bag(tmp_path / "bag").provenance["urdf"] or "") == 3 * 2**20


def test_custom_data_is_the_provenance_wherever_yaml_breaks_its_lines(run, tmp_path):
    damaged = []
    for n in range(0, 80, 7):
        path = tmp_path / f"bag{n}"
        with twodof.Bag(path, command_line=f"{'x' * n} --set 'Kp=80'").begin(run) as bag:
            bag.write(sample(run, 0))
        custom = metadata(path)["custom_data"]["twodof"]
        try:
            equal = json.loads(custom) == json.loads((path / "run.json").read_text("utf-8"))
        except ValueError:
            equal = False
        if not equal:
            damaged.append(n)
    assert damaged == []


def test_a_provenance_that_no_reader_accepts_is_not_written(run, tmp_path, monkeypatch):
    monkeypatch.setattr("twodof.bag.provenance.MAX_PROVENANCE", MAX_TAIL + 1000)
    with (
        pytest.raises(TwoDofError, match=r"robot description, names and start values of .* at most 0 are stored"),
        twodof.Bag(tmp_path / "b").begin(run),
    ):
        pass
    assert not [*tmp_path.iterdir()]


def test_a_large_robot_description_is_stored_as_it_is(run, tmp_path):
    """JSON may not make 36 MB of 6 MB of spaces, which no reader would accept."""
    wide = run.fmu.urdf.replace("</robot>", f"<!--{' ' * (6 * MIB)}--></robot>")
    with patch.object(type(run.fmu), "urdf", wide), twodof.Bag(tmp_path / "b").begin(run) as bag:
        bag.write(sample(run, 0))
    assert (tmp_path / "b/run.json").stat().st_size < 7 * MIB
    assert twodof.read_bag(tmp_path / "b").provenance["urdf"] == wide


def test_provenance_is_there_before_the_first_message(run, tmp_path):
    file = tmp_path / "bag" / "run.json"
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        before = file.read_bytes()
        bag.write(sample(run, 0))
    assert json.loads(before)["fmu"]["guid"] == run.fmu.guid
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    "change, message",
    [
        ({"axes": "qq"}, "its axes 'qq' are not different letters of 'xyz'"),
        ({"inputs_known_until": "x"}, "it is damaged"),
    ],
)
def test_a_forged_value_of_the_provenance_is_refused(native_path, tmp_path, change, message):
    twodof.run(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.02)
    file = tmp_path / "bag/run.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(twodof.TwoDofError, match=message):
        twodof.read_bag(tmp_path / "bag")
