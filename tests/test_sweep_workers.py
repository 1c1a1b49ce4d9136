"""Workers of a sweep on this machine and on a cluster: access, and ends of processes."""

import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from harness import asked, changed_step, children_of, lives, python, wait_until
from tables import BEGUN, COMMAND, same, table_of
from tools import needs

import twodof
from twodof import TwoDofError, sweep
from twodof.sweeps.runner import MOST_DEATHS


def doors(process: int) -> dict[str, str]:
    """Return the kernel's list of sockets to which others could connect or send, by inode."""
    own = set()
    for entry in Path(f"/proc/{process}/fd").iterdir():
        with suppress(OSError):
            own.add(re.sub(r"socket:\[(\d+)\]", r"\1", os.readlink(entry)))
    found = dict[str, str]()
    for kind in ("tcp", "tcp6", "udp", "udp6"):
        lines = Path(f"/proc/{process}/net/{kind}").read_text().splitlines()[1:]
        found |= {line.split()[9]: f"{kind} {line}" for line in lines if line.split()[9] in own}
    for line in Path(f"/proc/{process}/net/unix").read_text().splitlines()[1:]:
        _, _, _, flags, _, _, inode, *name = line.split()
        if inode in own and (name or int(flags, 16) & 0x10000):  # it listens
            found[inode] = f"unix {line}"
    return found


@pytest.fixture
def started():
    """Return the living processes that the test has started; other tests may have left some."""
    others = children_of(os.getpid())
    return lambda: [child for child in children_of(os.getpid()) if child not in others]


def test_workers_have_no_ports_or_names(native_path, started):
    """No socket has a port or a name, no other user can write to their pipes, and each has one thread."""
    before, seen = doors(os.getpid()), {}

    def look(done: int, runs: int) -> None:
        for worker in started():
            opened = [door for inode, door in doors(os.getpid()).items() if inode not in before]
            assert (doors(worker), opened) == ({}, [])  # those of other tests in this process may close meanwhile
            status = Path(f"/proc/{worker}/status").read_text()
            threads = int(re.findall(r"Threads:\s+(\d+)", status)[0])
            environment = Path(f"/proc/{worker}/environ").read_text().split("\0")
            (folder,) = [Path(line[7:]) for line in environment if line.startswith("TMPDIR=")]
            if threads > 1:  # it has started
                seen[worker] = threads, folder.stat().st_mode & 0o077

    grid = {"Kp": np.linspace(10.0, 90.0, 2000)}
    sweep(native_path, grid=grid, workers=2, progress=look, stop=lambda: len(seen) == 2)
    assert [*seen.values()] == 2 * [(2, 0)]  # one thread runs, the other waits for our end


PROGRAM = """
import sys
import twodof
def run():
    return twodof.sweep(sys.argv[-1], grid={"Kp": [20.0, 60.0]}, stop_time=0.1, workers=1)
expected = run()
sys.path.append(sys.argv[-2])
from harness import lay_traps
lay_traps(".")  # only now: this process itself may import from here
assert run().equals(expected)
assert not {"dask", "distributed"} & {*sys.modules}
"""


@pytest.mark.parametrize(
    ("way", "variables"),
    [  # what a way puts on the path and what a variable does are independent of each other
        (["-c", PROGRAM], {"PYTHONPATH": ":."}),
        (["program.py"], {}),
        (["-m", "program"], {}),
    ],
)
def test_workers_import_nothing_from_the_working_directory(way, variables, native_path, tmp_path):
    """They do not import the program either, even without ``if __name__ == "__main__"``."""
    (tmp_path / "program.py").write_text(PROGRAM)
    done = python(*way, Path(__file__).parent, native_path, cwd=tmp_path, env={**os.environ, **variables})
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "numpy.py").exists() and not list(tmp_path.glob("*.sprung"))


def test_workers_run_the_package_that_the_program_runs(native_path, tmp_path):
    """It is in the working directory, and differs from the installed one."""
    shutil.copytree(Path(twodof.__file__).parent, tmp_path / "twodof")
    with (tmp_path / "twodof/simulation/judge.py").open("a") as file:
        file.write("Judge.metrics = lambda judge: {'overshoot': 17.0}\n")
    code = "import sys, twodof; print(*twodof.sweep(sys.argv[1], grid={'Kp': [9.0]})['overshoot'])"
    done = python("-c", code, native_path, cwd=tmp_path)
    assert (done.stdout, done.stderr) == ("17.0\n", "")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("raise ImportError('no such luck')", "a child process failed: ImportError: no such luck"),
        ("import os; os._exit(3)", "workers die as they start: exit status 3"),
    ],
)
def test_workers_that_cannot_start_report_the_reason(text, said, native_path, tmp_path, monkeypatch, started):
    (tmp_path / "numpy.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(TwoDofError, match=said):
        sweep(native_path, grid={"Kp": [1.0, 2.0, 3.0]}, output=tmp_path / "s", workers=3)
    assert not (tmp_path / "s").exists() and started() == []


def test_an_fmu_that_workers_cannot_load_is_named(native_path, tmp_path):
    broken = tmp_path / "Broken.fmu"
    with zipfile.ZipFile(native_path) as archive, zipfile.ZipFile(broken, "w") as changed:
        for name in archive.namelist():
            content = archive.read(name)
            changed.writestr(name, bytes(4096) if name.endswith(".so") else content)
    with pytest.raises(TwoDofError, match=r"Broken.fmu' cannot be loaded: .*invalid ELF"):
        sweep(broken, grid={"Kp": [1.0]})


@pytest.mark.long
def test_workers_that_are_killed_cost_no_run(native_path, length, started):
    runs, pause, part = length(2000, 400), length(5, 0), length(1, 30)
    most = length(1000, MOST_DEATHS - 1)
    grid = {"Kp": np.linspace(10.0, 200.0, runs)}
    expected = sweep(native_path, grid=grid, stop_time=8)
    killed = [(time.monotonic(), 0)]
    rng = random.Random(1)

    def kill(done: int, runs: int) -> None:
        """Each so many seconds, and runs that are done; no run so often that it is given up."""
        now = time.monotonic()
        workers = started()
        due = now >= killed[-1][0] + pause and done >= killed[-1][1] + part
        if workers and due and len(killed) <= most:
            os.kill(rng.choice(workers), signal.SIGKILL)
            killed.append((now, done))

    found = sweep(native_path, grid=grid, stop_time=8, progress=kill)
    print(f"{len(killed) - 1} workers killed during {runs} runs")
    assert len(killed) > 2
    assert list(found["run"]) == list(range(runs))
    same(found, expected)


# --- how a sweep ends ---


SLEEP = """
if self.Kp[0] == 4.0:
    import os, time
    open(os.environ['ASLEEP'], 'w').close()
    time.sleep(1e6)
"""


@contextmanager
def asleep(fmu_path: Path, folder: Path) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A sweep, in folder/s, whose third run takes days and has started; and its workers."""
    fmu = changed_step(fmu_path, folder, SLEEP)
    grid = ["--grid", "Kp=2:6:5", "--stop-time", "0.05", "--workers", "1"]
    process = subprocess.Popen(
        [*COMMAND, "sweep", str(fmu), *grid, "-o", str(folder / "s")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "ASLEEP": str(folder / "asleep")},
    )
    try:
        wait_until(lambda: (folder / "asleep").exists())
        yield process, children_of(process.pid)
    finally:
        process.kill()
        process.communicate()


def test_a_signal_ends_a_sweep_in_the_midst_of_a_long_run(fmu_path, tmp_path):
    """Finished runs are stored, and no process is left."""
    with asleep(fmu_path, tmp_path) as (process, workers):
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (130, "")
    done = list(table_of(tmp_path / "s")["Kp"])
    assert done in ([2.0], [2.0, 3.0])  # the latter may be in one batch with what sleeps
    assert f"{len(done)} of 5 runs: {len(done)} finished" in out and "--resume" in out
    assert len(workers) == 1 and not lives(workers[0])


def test_workers_end_with_the_sweep_whatever_they_are_at(fmu_path, tmp_path):
    with asleep(fmu_path, tmp_path) as (process, workers):
        process.kill()
        process.communicate()
        assert len(workers) == 1
        wait_until(lambda: not lives(workers[0]))


def test_a_sweep_can_be_stopped_while_its_workers_start(native_path, tmp_path, monkeypatch, started):
    (tmp_path / "numpy.py").write_text("import time; time.sleep(1e6)")
    monkeypatch.syspath_prepend(tmp_path)
    table = sweep(native_path, grid={"Kp": [1.0, 2.0]}, output=tmp_path / "s", stop=asked(5))
    assert len(table) == len(table_of(tmp_path / "s")) == 0
    assert started() == []


def test_a_sweep_can_be_stopped_while_a_scheduler_does_not_answer(native_path):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        table = sweep(native_path, grid={"Kp": [1.0]}, scheduler=address, stop=asked(5))
    assert len(table) == 0


# --- clusters ---


@contextmanager
def cluster(folder: Path, workers: int, options: Sequence[str] = (), **environment: str) -> Iterator[tuple[str, int]]:
    """Address and process of a scheduler, with workers that have joined it."""
    file, log = folder / "scheduler.json", folder / "cluster.log"
    programs = [["scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1"]]
    worker = ["worker", "--nthreads", "2", "--no-dashboard", "--local-directory", str(folder)]
    programs += [worker] * workers
    with log.open("a") as told:
        processes = [
            subprocess.Popen(
                [sys.executable, "-m", "dask", *program, "--scheduler-file", str(file), *options],
                stdout=told,
                stderr=told,
                start_new_session=True,
                env={**os.environ, "TMPDIR": str(folder), **environment},
            )
            for program in programs
        ]
    try:
        while not file.exists() or not file.read_text() or log.read_text().count("Registered to:") < workers:
            assert all(process.poll() is None for process in processes), log.read_text()
            time.sleep(0.05)
        yield json.loads(file.read_text())["address"], processes[0].pid
    finally:
        children = [child for process in processes for child in children_of(process.pid)]
        for process in processes:
            process.kill()
            process.wait()
        wait_until(lambda: not any(map(lives, children)))  # their trackers then remove their semaphores


def test_a_cluster_that_asks_for_keys(native_path, tmp_path, monkeypatch):
    """Dask's own configuration sets it; connections without a key are refused."""
    key, certificate = str(tmp_path / "key.pem"), str(tmp_path / "certificate.pem")
    request = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=cluster", "-days", "2"]
    command = [needs("openssl"), *request, "-keyout", key, "-out", certificate]
    subprocess.run(command, check=True, capture_output=True)
    monkeypatch.setattr("twodof.sweeps.cluster.SCHEDULER_TIMEOUT", 2.0)
    names = (("--tls-ca-file", certificate), ("--tls-cert", certificate), ("--tls-key", key))
    options = ["--protocol", "tls", *(word for pair in names for word in pair)]
    files = {"CA_FILE": certificate, "CLIENT__KEY": key, "CLIENT__CERT": certificate}
    keys = {f"DASK_DISTRIBUTED__COMM__TLS__{name}": file for name, file in files.items()}
    grid = {"Kp": [20.0, 60.0]}
    with cluster(tmp_path, 1, options) as (address, _):
        assert address.startswith("tls://")
        command = ["sweep", native_path, "--grid", "Kp=20:60:2", "--scheduler", address, "-o", tmp_path / "s"]
        done = python("-m", "twodof", *command, env={**os.environ, **keys})
        assert (done.returncode, done.stderr) == (0, "")
        same(table_of(tmp_path / "s"), sweep(native_path, grid=grid))
        for stranger in (address, address.replace("tls", "tcp")):
            with pytest.raises(TwoDofError, match="does not answer"):
                sweep(native_path, grid=grid, scheduler=stranger)


@pytest.fixture(scope="module")
def two_workers(tmp_path_factory):
    """Address and process of a scheduler, and a file that lists the started runs."""
    folder = tmp_path_factory.mktemp("cluster")
    variables = {"BEGUN": str(folder / "begun"), "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    with cluster(folder, 2, **variables) as (address, scheduler):
        yield address, scheduler, folder / "begun"


def test_a_cluster_gives_the_table_of_local_workers(native_path, two_workers):
    grid: dict[str, Iterable[float]] = {"Kp": np.linspace(10.0, 200.0, 30), "Kd": [10.0, 40.0]}
    expected = sweep(native_path, grid=grid)
    for _ in range(2):  # the workers stay, and nothing of a sweep stays with them
        same(sweep(native_path, grid=grid, scheduler=two_workers[0]), expected)


def test_a_run_that_kills_is_given_up_by_a_cluster(fmu_path, tmp_path, two_workers):
    """Dask also suspects the other runs of its worker, which are not given up."""
    fmu = changed_step(fmu_path, tmp_path, BEGUN)
    address, _, begun = two_workers
    grid = {"Kp": [298.0, 299.0, 300.0, 301.0]}
    table = sweep(fmu, grid=grid, stop_time=0.01, scheduler=address)
    assert list(table["outcome"]) == ["finished", "finished", "crashed", "finished"]
    assert begun.read_text().split().count("300") == 3


def test_a_sweep_can_be_stopped_when_its_scheduler_is_suspended(native_path, two_workers):
    address, scheduler, _ = two_workers
    suspended: list[int] = []
    looks = asked(5)

    def suspend(done: int, runs: int) -> None:
        if done and not suspended:
            os.kill(scheduler, signal.SIGSTOP)
            suspended.append(done)

    try:
        table = sweep(
            native_path,
            grid={"Kp": np.linspace(10.0, 200.0, 2000)},
            scheduler=address,
            progress=suspend,
            stop=lambda: bool(suspended) and looks(),
        )
    finally:
        os.kill(scheduler, signal.SIGCONT)
    assert suspended[0] <= len(table) < 2000


BLOCK = """
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "twodof":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Blocker())
"""


def test_workers_without_the_package_are_named(native_path, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(BLOCK)
    with (
        cluster(tmp_path, 1, PYTHONPATH=str(tmp_path)) as (address, _),
        pytest.raises(TwoDofError, match=r"a worker cannot take the job: .*; install twodof \d"),
    ):
        sweep(native_path, grid={"Kp": [1.0]}, scheduler=address)


def test_a_scheduler_without_workers_is_named(native_path, tmp_path):
    with cluster(tmp_path, 0) as (address, _), pytest.raises(TwoDofError, match="has no workers"):
        sweep(native_path, grid={"Kp": [1.0]}, scheduler=address)
