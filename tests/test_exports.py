"""Exports of bags as tables and single files, by independent readers; compressed chunks."""

import csv
import io
import json
import shutil
import tempfile
import tracemalloc
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas
import pytest
from bags import SECOND, joint_message, write_third_party
from failures import fmu_of
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader, StoragePlugin

import twodof
from twodof.cli.main import main
from twodof.errors import BagError
from twodof.files import data_file


@pytest.fixture(scope="module")
def bag_path(native_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("bag") / "bag"
    changes = [(0.25, {"x_des": (0.1, 0.2)})]
    twodof.simulate(native_path, twodof.Bag(path, scene=True, effort=True), stop_time=0.5, changes=changes)
    return path


NAMES = [
    *("time", "joint1.position", "joint1.velocity", "joint1.effort"),
    *("joint2.position", "joint2.velocity", "joint2.effort", "x.x", "x.y", "x_des.x", "x_des.y"),
]
UNITS = ["s", *("rad", "rad/s", "N·m") * 2, *["m"] * 4]


def decoded(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return stamps, ns, and messages of each topic in an MCAP file, by the readers of MCAP."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        for _, channel, message, content in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


def columns(bag: Path) -> np.ndarray:
    """Return the columns of a table of a bag by the readers of MCAP."""
    topics = decoded(bag / f"{bag.name}.mcap")
    points = [[(m.point.x, m.point.y) for _, m in topics[name]] for name in ("/end_effector", "/target")]
    stamps, states = zip(*topics["/joint_states"])
    joints = [[getattr(m, part)[i] for m in states] for i in range(2) for part in ("position", "velocity", "effort")]
    return np.column_stack([(np.array(stamps) - stamps[0]) / 1e9, *joints, *points])


@pytest.mark.parametrize("compress", ["", "zstd"])
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_pandas_and_duckdb_read_the_messages_of_a_bag_in_its_table(ending, compress, native_path, tmp_path):
    """All values are equal to the last bit."""
    bag, path = tmp_path / "bag", tmp_path / f"out.{ending}"
    sink = twodof.Bag(bag, scene=True, effort=True, compress=compress)
    twodof.simulate(native_path, sink, stop_time=0.5, changes=[(0.25, {"x_des": (0.1, 0.2)})])
    assert main(["export", str(bag), "-o", str(path)]) == 0
    headers, expected = [f"{name} [{unit}]" for name, unit in zip(NAMES, UNITS)], columns(bag)
    assert len(expected) == 51 and np.ptp(expected, axis=0).min() > 1e-3
    if ending == "csv":
        table = pandas.read_csv(path, float_precision="round_trip")
        other = duckdb.read_csv(str(path), header=True, all_varchar=True)
    else:
        table, other = pandas.read_parquet(path), duckdb.read_parquet(str(path))
        assert table.attrs["units"] == dict(zip(NAMES, UNITS))
    assert [*table.columns] == other.columns == (headers if ending == "csv" else NAMES)
    for found in (table.to_numpy(), np.array(other.fetchall(), float)):
        assert np.array_equal(found, expected)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_one_mcap_file_has_all_messages(storage, native_path, tmp_path):
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag", storage=storage, scene=True), stop_time=0.3)
    path = twodof.export_bag(tmp_path / "bag", tmp_path / "out.mcap")
    with path.open("rb") as file:
        messages = make_reader(file).iter_messages()
        found = sorted((channel.topic, message.log_time, message.data) for _, channel, message in messages)
    with Reader(tmp_path / "bag") as reader:
        assert found == sorted((c.topic, stamp, bytes(data)) for c, stamp, data in reader.messages())
    assert [len(each) for each in decoded(path).values()].count(31) == 4
    single, whole = twodof.read_bag(path), twodof.read_bag(tmp_path / "bag")
    assert np.array_equal(single.q, whole.q) and single.provenance["urdf"] == whole.provenance["urdf"]


def test_a_lerobot_dataset_has_an_episode_for_each_bag(bag_path, native_path, tmp_path):
    """Columns and metadata are those of LeRobot 0.4.4; an action applies from its sample on."""
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.2)
    path = tmp_path / "arm.lerobot"
    assert main(["export", str(bag_path), str(tmp_path / "bag"), "-o", str(path)]) == 0
    file, bags = "chunk-000/file-000.parquet", [twodof.read_bag(bag) for bag in (bag_path, tmp_path / "bag")]
    found = duckdb.read_parquet(str(path / "data" / file)).order("index")
    counters = ["timestamp", "frame_index", "episode_index", "index", "task_index"]
    assert found.columns == ["observation.state", "action", *counters]
    assert [str(kind) for kind in found.types] == ["FLOAT[]", "FLOAT[]", "FLOAT", *["BIGINT"] * 4]
    states, actions, *rest = zip(*found.fetchall())
    assert np.array_equal(states, np.vstack([np.hstack([bag.q, bag.v]) for bag in bags]).astype(np.float32))
    assert np.array_equal(actions, np.array([*[(0.2, 0.05)] * 25, *[(0.1, 0.2)] * 26, *[(0.2, 0.05)] * 21], np.float32))
    k = [*range(51), *range(21)]
    assert np.allclose(rest[0], np.array(k) / 100) and rest[1:] == [
        (*k,),
        (0,) * 51 + (1,) * 21,
        (*range(72),),
        (0,) * 72,
    ]
    episodes = duckdb.read_parquet(str(path / "meta/episodes" / file))
    spans = episodes.project('episode_index, length, dataset_from_index, dataset_to_index, "data/file_index", tasks')
    assert spans.fetchall() == [(0, 51, 0, 51, 0, ["follow the target"]), (1, 21, 51, 72, 0, ["follow the target"])]
    info, stats = (json.loads((path / f"meta/{name}.json").read_text()) for name in ("info", "stats"))
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 100, 72)
    assert info["features"]["action"] == {"dtype": "float32", "shape": [2], "names": ["x_des.x", "x_des.y"]}
    assert stats["action"]["mean"] == pytest.approx(np.mean(actions, axis=0)) and stats["index"]["count"] == [72]
    with pytest.raises(twodof.TwoDofError, match="exists, and is not replaced"):
        twodof.export_bag(bag_path, path)


@pytest.mark.parametrize(
    ("control", "step", "name", "message"),
    [
        ("task", 0.01, "out.csv", "several become the episodes of a folder that ends in .lerobot"),
        ("task", 0.02, "out.lerobot", "differ in joints, target or rate"),
        ("task", 0.03, "out.lerobot", "no even rate of a whole number of Hz"),
        ("effort", 0.01, "out.lerobot", "neither targets nor efforts; record them with `effort`"),
    ],
)
def test_bags_of_no_dataset_are_refused(bag_path, tmp_path, control, step, name, message):
    twodof.simulate(fmu_of("arm", control), twodof.Bag(tmp_path / "bag"), step=step, stop_time=0.06)
    with pytest.raises(twodof.TwoDofError, match=message):
        twodof.export_bag([bag_path, tmp_path / "bag"], tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]


@pytest.mark.parametrize(
    ("name", "message"),
    [("out.xlsx", "ends in .csv, .parquet, .mcap or .lerobot"), ("none/out.csv", "cannot write '.*none/out.csv'")],
)
def test_an_impossible_export_is_refused(name, message, bag_path, tmp_path):
    with pytest.raises(twodof.TwoDofError, match=message):
        twodof.export_bag(bag_path, tmp_path / name)
    assert not [*tmp_path.iterdir()]


def test_an_mcap_file_is_written_without_the_bag_in_memory(tmp_path):
    states = (("/joint_states", k, joint_message(k, [*map(str, range(5000))], np.arange(5000))) for k in range(600))
    bag = write_third_party(tmp_path / "bag", states, storage_plugin=StoragePlugin.MCAP)
    tracemalloc.start()
    path = twodof.export_bag(bag, tmp_path / "out.mcap")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 0.5 * path.stat().st_size


def test_a_full_folder_for_temporary_files_is_named(disk, bag_path, tmp_path, monkeypatch):
    full = disk(64)
    monkeypatch.setattr(tempfile, "tempdir", str(full))
    with pytest.raises(BagError, match=f"write '.*bag.mcap': No space left on device in '{full}'"):
        twodof.export_bag(bag_path, tmp_path / "bag.mcap")


def test_an_export_does_not_replace_a_file_of_its_bag(bag_path, tmp_path):
    (tmp_path / "link").symlink_to(bag_path)
    before = {file: file.read_bytes() for file in bag_path.iterdir()}
    for folder in (bag_path, tmp_path / "link"):
        with pytest.raises(twodof.TwoDofError, match=r"is in the bag, whose files are not replaced"):
            twodof.export_bag(bag_path, folder / f"{bag_path.name}.mcap")
    assert before == {file: file.read_bytes() for file in bag_path.iterdir()}


def test_a_compressed_bag_is_smaller_and_equal_to_all_readers(native_path, tmp_path):
    """A robot at rest is included, whose messages compress a thousandfold."""
    for name, step in {"moving": 0.01, "resting": 0.001}.items():
        bags = [tmp_path / name, tmp_path / f"{name}.zstd"]
        for path, compress in zip(bags, ("", "zstd")):
            run = twodof.experiment(native_path, stop_time=10.0, stamp_start=1.0, step=step)
            twodof.simulate(run, twodof.Bag(path, scene=True, compress=compress))
        plain, packed = (path / f"{path.name}.mcap" for path in bags)
        assert packed.stat().st_size < 0.4 * plain.stat().st_size
        messages = []
        for path in (plain, packed):
            with path.open("rb") as file:
                found = make_reader(file).iter_messages()
                messages.append([(channel.topic, message.log_time, message.data) for _, channel, message in found])
        assert messages[0] == messages[1] and len(messages[0]) > 4000
        with Reader(bags[1]) as reader:
            assert sorted(data for _, _, data in reader.messages()) == sorted(data for _, _, data in messages[0])
        assert np.array_equal(twodof.read_bag(bags[1]).q, twodof.read_bag(bags[0]).q)
        assert twodof.recover(bags[1]).original is None
    with pytest.raises(twodof.TwoDofError, match="`compress` applies to storage mcap only"):
        twodof.Bag(tmp_path / "new", storage="sqlite3", compress="zstd")


def test_a_dataset_has_no_objects_for_each_sample(tmp_path):
    samples = 20_000
    states = (
        ("/joint_states", 10_000_000 * k, joint_message(10_000_000 * k, ["a"], [0.1 * k], [1.0], [2.0]))
        for k in range(samples)
    )
    bag = write_third_party(tmp_path / "bag", states, storage_plugin=StoragePlugin.MCAP)
    tracemalloc.start()
    twodof.export_bag(bag, tmp_path / "out.lerobot")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 400 * samples  # a NumPy array in an object column takes a kilobyte


FORMULAS = (
    "=cmd|' /C calc'!A0",
    "+1+1",
    "-1+1",
    "@SUM(1+1)",
    "\t=1+1",
    "a;=1+1",
    "b\n=1+1",
    'c,"=1+1',
    "＝1+1",
    "up-left",
)


def test_a_joint_is_no_formula_in_a_spreadsheet(tmp_path):
    """A spreadsheet divides a line at commas, or at semicolons or tabs, by its language."""
    states = (("/joint_states", k * SECOND, joint_message(k, FORMULAS, [0.0] * len(FORMULAS))) for k in range(1, 4))
    bag = write_third_party(tmp_path / "bag", states)
    text = twodof.export_bag(bag, tmp_path / "out.csv").read_text("utf-8")
    for separator in ",;\t":
        for quoting in (csv.QUOTE_MINIMAL, csv.QUOTE_NONE):
            cells = [
                cell for row in csv.reader(io.StringIO(text), delimiter=separator, quoting=quoting) for cell in row
            ]
            assert not [cell for cell in cells if cell.strip(' "\t').startswith((*"=+-@＝",))]
    assert text.count("1+1") == 8
    assert pandas.read_csv(tmp_path / "out.csv").columns[-1] == "up-left.position"


def test_an_export_by_a_robots_address_does_not_replace_a_file_of_its_bag(bag_path, tmp_path):
    pair = shutil.copytree(bag_path, tmp_path / "pair")
    shutil.copy(pair / "run.json", pair / "run.left.json")
    (pair / "run.json").rename(pair / "run.right.json")
    before = {file: file.read_bytes() for file in pair.iterdir()}
    with pytest.raises(twodof.TwoDofError, match=r"is in the bag, whose files are not replaced"):
        twodof.export_bag(f"{pair}:left", pair / "bag.mcap")
    assert before == {file: file.read_bytes() for file in pair.iterdir()}
    assert twodof.export_bag(f"{pair}:left", tmp_path / "out.mcap").stat().st_size


@pytest.mark.parametrize(
    "command",
    [
        "build arm.urdf -o link.urdf --overwrite",
        "page arm.html -o ./arm.html",
        "run arm.fmu --input bag -o bag --overwrite",
        "run arm.fmu --input bag:/topic -o bag --overwrite",
        "run bag/arm.fmu -o bag --overwrite",
        "run arm.fmu --input bag/table.csv -o bag --overwrite",
        "plot bag --urdf arm.png -o arm.png",
        "view bag --fmu arm.html --export arm.html",
        "publish left=bag/arm.fmu -o bag --overwrite",
        "export bag/bag.mcap -o bag/bag.mcap",
    ],
)
def test_an_output_replaces_no_input(command, bag_path, native_path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(bag_path, "bag")
    shutil.copy(data_file("urdf", "2dof.urdf"), "arm.urdf")
    for name in ("arm.fmu", "arm.html", "arm.png", "bag/arm.fmu", "bag/table.csv"):
        shutil.copy(native_path, name)
    (tmp_path / "link.urdf").symlink_to("arm.urdf")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    assert main(command.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "would replace the input '" in line
    assert before == {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}


def test_a_run_may_replace_a_bag_that_is_none_of_its_inputs(native_path, tmp_path, monkeypatch):
    """A robot may have the name of the bag."""
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert main(["run", str(native_path), "-o", "bag", "--overwrite", "--stop-time", "0.02"]) == 0
    assert main(["run", "none.ssp", "--robot", "bag", "-o", "bag", "--overwrite"]) == 1
