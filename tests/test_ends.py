"""A run ends cleanly after signals, on a full disk, and when its folder or reader disappears."""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest
from bags import START, STORAGES, assert_consistent, both_storages, logging, read_with_rosbags

from twodof.bag.contents import read_messages, storage_files
from twodof.bag.records import DamageError, ReadBudget
from twodof.cli import info, signals
from twodof.cli.main import main

TWODOF = [sys.executable, "-m", "twodof"]
ENDLESS = ["--stop-time", "1e5", "--stamp-start", str(START)]


def begin(fmu: Path, bag: Path, *options: str) -> subprocess.Popen[str]:
    """Start a run, and wait for its first sample."""
    command = [*TWODOF, "run", str(fmu), "-o", str(bag), *ENDLESS, *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not has_samples(bag):
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    time.sleep(0.1)
    return process


def has_samples(bag: Path) -> bool:
    """Return True if the bag has its first sample, and thus its reserve."""
    try:
        return (bag / "reserve").exists() and any(any(read_messages(file, ReadBudget())) for file in storage_files(bag))
    except (OSError, DamageError):
        return False


def whole(fmu: Path, folder: Path, n: int) -> Sequence[object]:
    """The first n messages of an undisturbed run."""
    stop = str(n * 0.01)
    options = ["--stop-time", stop, "--stamp-start", str(START), "-o", str(folder / "whole")]
    assert main(["run", str(fmu), *options]) == 0
    return list(read_with_rosbags(folder / "whole"))[:n]


SIGNALS = {
    "Ctrl-C": [signal.SIGINT],
    "Ctrl-C twice": [signal.SIGINT] * 2,
    "Ctrl-C many times": [signal.SIGINT] * 300,
    "terminated": [signal.SIGTERM],
    "terminal closed": [signal.SIGHUP],
    "terminated and interrupted": [signal.SIGTERM, signal.SIGINT, signal.SIGINT],
}


@pytest.mark.parametrize(
    ("name", "storage", "pace"), [*zip(SIGNALS, STORAGES * 3, ("--realtime", "", "", "--realtime", "--realtime", ""))]
)
def test_signals_leave_a_complete_bag(native_path, tmp_path, name, storage, pace):
    numbers, bag = SIGNALS[name], tmp_path / "bag"
    process = begin(native_path, bag, "--storage", storage, *pace.split())
    for number in numbers:
        process.send_signal(number)
        time.sleep(0.003 if len(numbers) < 4 else 0.0003)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in err and len(err.splitlines()) <= 1
    kept = assert_consistent(bag, storage)
    assert kept
    assert {p.suffix for p in bag.iterdir()} <= {".mcap", ".db3", ".yaml", ".json"}
    if len(numbers) == 1:
        assert f"({kept} messages" in out
        assert re.search(rf"stopped +on request at {(kept - 1) * 0.01:g} s", out)
    if kept < 10_000:
        assert read_with_rosbags(bag) == whole(native_path, tmp_path, kept)


def test_an_interrupt_does_not_disturb_the_end_by_another_one(monkeypatch):
    times = iter([5.0, 5.0 + 0.5 * signals.CLEAN_UP, 5.0 + 1.5 * signals.CLEAN_UP])
    monkeypatch.setattr(signals, "_interrupts", [])
    monkeypatch.setattr(signals, "time", SimpleNamespace(monotonic=lambda: next(times)))
    with pytest.raises(KeyboardInterrupt):
        signals.interrupt(signal.SIGINT, None)
    signals.interrupt(signal.SIGINT, None)
    with pytest.raises(KeyboardInterrupt):  # the clean-up hangs
        signals.interrupt(signal.SIGINT, None)


def test_a_request_to_end_a_run_takes_its_time():
    with signals.asked_to_stop() as asked:
        os.kill(os.getpid(), signal.SIGTERM)
        assert signal.getitimer(signal.ITIMER_REAL)[0] > 0.0  # a step that hangs is interrupted
        assert asked()
        assert signal.getitimer(signal.ITIMER_REAL)[0] == 0.0


LOOP = """
import sys
import twodof
from twodof.simulation.sample import Sample
fmu, path, storage = sys.argv[1:]
run = twodof.experiment(fmu, stop_time=1e4)
inputs = dict(run.start_values)
k = 0
try:
    with twodof.Bag(path, storage=storage).begin(run) as bag:
        while True:
            if k == 1:  # before, rosbags makes code: CPython ends by SIGINT if it comes in an exec
                print("open", flush=True)
            numbers = (0.1, k), (0.3, -k), (0.5, 0.6), (0.7, 0.8)
            bag.write(Sample(k, run.time(k), *numbers, inputs, 0.0, 10_000_000 * k))
            k += 1
except KeyboardInterrupt:
    print(k)
"""


@both_storages
def test_interrupt_in_a_loop_of_ones_own_never_cuts_a_message(native_path, tmp_path, storage):
    """Python raises KeyboardInterrupt at any instruction, also during a write."""
    for i in range(3):
        bag = tmp_path / f"bag{i}"
        process = subprocess.Popen(
            [sys.executable, "-c", LOOP, str(native_path), str(bag), storage],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None and process.stdout.readline() == "open\n"
        time.sleep(0.01 + 0.037 * i)
        process.send_signal(signal.SIGINT)
        said, err = process.communicate(timeout=120)
        assert (process.returncode, err) == (0, "")
        assert_consistent(bag, storage)
        states = read_with_rosbags(bag)
        assert [float(*memoryview(s.position).cast("d")[1:]) for s in states] == [*range(len(states))]
        assert int(said) <= len(states) <= int(said) + 1


@both_storages
@pytest.mark.parametrize("how", ["removed", "moved"])
def test_folder_that_goes_under_the_run_ends_it(native_path, tmp_path, storage, how):
    bag = tmp_path / "bag"
    process = begin(native_path, bag, "--storage", storage, "--realtime")
    if how == "removed":
        shutil.rmtree(bag)
    else:
        bag.rename(tmp_path / "moved")
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    (line,) = err.splitlines()
    assert line.startswith(f"twodof: error: cannot continue writing the bag '{bag}': it was removed")
    assert not bag.exists()
    if how == "moved":
        assert main(["recover", str(tmp_path / "moved")]) == 0
        kept = assert_consistent(tmp_path / "moved", storage)
        assert read_with_rosbags(tmp_path / "moved") == whole(native_path, tmp_path, kept)


@pytest.mark.long
@both_storages
def test_full_disk_costs_a_second_at_most(native_path, tmp_path, disk, storage, length):
    """Another process fills the disk to the last byte during a run in real time."""
    expected = whole(native_path, tmp_path, 1000)
    rng = random.Random(storage)
    lost = []
    for _ in range(length(20, 2)):
        folder = disk(8192)
        bag = folder / "bag"
        run = logging(native_path, bag, storage)
        time.sleep(rng.uniform(0.0, 2.0))
        with pytest.raises(OSError, match="No space left"), (folder / "other").open("wb") as other:
            while True:
                other.write(bytes(256))
                other.flush()
        _, err = run.process.communicate(timeout=120)
        assert run.process.returncode == 1
        (line,) = err.splitlines()
        kept = assert_consistent(bag, storage)
        assert re.search(rf"the disk is full; it is closed with its first {kept} samples", line)
        assert read_with_rosbags(bag) == expected[:kept]
        lost.append(run.lost(kept))
    print(f"{len(lost)} full disks, {storage}: lost at most {max(lost):.3f} s")
    assert max(lost) <= 1.0


def test_reader_of_the_summary_that_leaves_costs_no_sample(native_path, tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    command = [*TWODOF, "run", str(native_path), "-o", str(tmp_path / "bag")]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(writing)
    assert done.stderr == "" and done.returncode == 1
    assert assert_consistent(tmp_path / "bag", "mcap") == 501


def test_interrupt_while_a_file_is_closed_is_an_interrupt(monkeypatch, capsys):
    """``shutil.rmtree`` then closes the folder a second time."""

    def verb(_options: object) -> int:
        descriptor = os.open(os.devnull, os.O_RDONLY)
        try:
            os.close(descriptor)
            raise KeyboardInterrupt
        finally:
            os.close(descriptor)

    monkeypatch.setattr(info, "call", verb)
    before = signal.getsignal(signal.SIGINT)
    try:
        assert main(["info", "."]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "twodof: error: interrupted\n"


INTERRUPTED_IMPORT = """
import os, signal, sys

class Interrupts:
    def find_spec(name, *_):
        if name == MODULE:
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                if AS_C_DOES:
                    raise ImportError("a module in C failed")
                raise

sys.meta_path.insert(0, Interrupts)
from twodof.__main__ import main
sys.exit(main(["info", FMU]))
"""


@pytest.mark.parametrize(
    "module, as_c_does, said",
    [
        ("twodof.cli", False, ""),
        ("twodof.cli.sweep", False, ""),
        ("fmpy", False, "twodof: error: interrupted\n"),
        ("fmpy", True, "twodof: error: interrupted\n"),
    ],
)
def test_an_interrupted_import_is_quiet(native_path, module, as_c_does, said):
    given = f"MODULE, AS_C_DOES, FMU = {module!r}, {as_c_does}, {str(native_path)!r}"
    command = [sys.executable, "-c", given + INTERRUPTED_IMPORT]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, said)
