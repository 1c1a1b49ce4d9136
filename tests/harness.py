"""An FMU driven call by call through FMPy, and tests that run in their own process."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import importlib
import itertools
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from concurrent.futures import ProcessPoolExecutor
from ctypes import byref
from pathlib import Path
from textwrap import dedent, indent
from typing import TYPE_CHECKING, Any
from weakref import WeakMethod

import fmpy
from fmpy import fmi2
from fmpy.fmi1 import FMICallException
from fmpy.logging import addLoggerProxy
from scratch import run_folder
from tools import needs


def shared(factory, name, make):
    """A folder for all processes of a test run, filled by the first one that requests it."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with open(f"{folder}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            begun = factory.mktemp(name)
            make(begun)
            begun.rename(folder)
    return folder


FRESH = multiprocessing.get_context("forkserver")
FRESH.set_forkserver_preload(["fmpy.fmi2", "hypothesis", "pinocchio", "pytest", "pythonfmu", "scipy.spatial.transform"])
"""Forks of a process that has imported what takes long to import, and nothing of the package."""


def in_child_process(test):
    """Run a test in a new process: a crash there is a failure here, and nothing is shared."""

    @functools.wraps(test)
    def run(*arguments, **named):
        with ProcessPoolExecutor(1, mp_context=FRESH) as pool:
            pool.submit(_call, test.__module__, test.__name__, arguments, named).result(timeout=600)

    return run


def _call(module, name, arguments, named):
    getattr(importlib.import_module(module), name).__wrapped__(*arguments, **named)


LOGGERS = list[Any]()


def lasting(method):
    """Return a logger that lives as long as the process and holds a weak reference to a method.

    FMPy's proxy passes the messages of all FMUs to the latest logger, whether it still exists or not.
    """
    LOGGERS.append(fmi2.fmi2CallbackLoggerTYPE(lambda *message: (log := method()) and log(*message)))
    return LOGGERS[-1]


def python(*arguments, check=False, timeout=300, **options):
    """Run Python with arguments, and return the process with its output as text."""
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=check, timeout=timeout, **options)


class Worker:
    """A process for many calls; a call that ends it or hangs fails, and the next call has a new process."""

    def __init__(self):
        self._start()

    def _start(self):
        context = multiprocessing.get_context("spawn")
        self._pipe, pipe = context.Pipe()
        self._process = context.Process(target=_serve, args=(pipe,), daemon=True)
        self._process.start()
        pipe.close()

    def __call__(self, function, *arguments):
        self._pipe.send((function, arguments))
        try:
            if self._pipe.poll(600.0):
                return self._pipe.recv()
            failure = "hangs"
        except EOFError:
            self._process.join()
            failure = f"ended its process with exit code {self._process.exitcode}"
        self.end()
        self._start()
        raise AssertionError(f"the call {failure}")

    def end(self):
        self._process.kill()
        self._process.join()


def _serve(pipe):
    while True:
        function, arguments = pipe.recv()
        pipe.send(function(*arguments))


def lay_traps(folder):
    """Write modules that must not be imported, by every name that this process knows."""
    names = {*sys.stdlib_module_names, *(name.partition(".")[0] for name in sys.modules)}
    for name in {*names, "sitecustomize", "usercustomize"} - {"__main__", "program"}:
        with open(os.path.join(folder, f"{name}.py"), "w") as file:
            file.write("open(__file__ + '.sprung', 'w'); raise ImportError(__file__)")


def asked(times):
    """A callable that returns True after some calls; code that never calls it would hang."""
    looks = itertools.count(1)
    return lambda: next(looks) >= times


def wait_until(condition):
    """Wait for a condition; a hang fails the test."""
    end = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def children_of(process):
    """Child processes that have not ended."""
    found: list[int] = []
    for children in Path(f"/proc/{process}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found += map(int, children.read_text().split())
    return [child for child in found if lives(child) and not _tracks(child)]


def _tracks(process):
    """Return True for the process that multiprocessing starts once and keeps until the end."""
    return b"resource_tracker" in Path(f"/proc/{process}/cmdline").read_bytes()


def lives(process):
    """Return True if the process has not ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


_description = functools.cache(fmpy.read_model_description)


class Recorded:
    """A mixin for FMPy's instances that keeps messages and checks that refused calls change nothing.

    The classes' names begin with the version of FMI, which FMPy looks for.
    """

    if TYPE_CHECKING:  # what FMPy's class has

        def __init__(self, *arguments: Any, **named: Any) -> None: ...

        def __getattr__(self, name: str) -> Any: ...

    def functions(self):
        """Return the callbacks of FMI 2.0."""
        self.messages = []
        return fmi2.fmi2CallbackFunctions(
            logger=fmi2.fmi2CallbackLoggerTYPE(lambda _, name, status, category, text: self.keep(status, text)),
            allocateMemory=fmi2.fmi2CallbackAllocateMemoryTYPE(),
            freeMemory=fmi2.fmi2CallbackFreeMemoryTYPE(),
        )

    def keep(self, status, text):
        self.messages.append((status, text.decode()))

    def status(self, function, *arguments):
        try:
            getattr(self, function)(*arguments)
        except FMICallException as error:
            return error.status
        return 0

    def refused(self, message, function, *arguments):
        """Assert that the call is refused with only this message, a pattern."""
        before, self.messages = self.snapshot(), []
        assert self.status(function, *arguments) == fmi2.fmi2Error
        ((status, text),) = self.messages
        assert status == fmi2.fmi2Error and re.search(message, text), text
        assert self.snapshot() == before

    def snapshot(self):
        state = self.getFMUState()
        blob = bytes(self.serializeFMUState(state))
        self.freeFMUState(state)
        return blob


def unzipped(fmu):
    """Unzip an FMU into a folder of its own, which the end of the run removes."""
    return fmpy.extract(str(fmu), tempfile.mkdtemp(prefix="fmu ", dir=run_folder()))


@contextlib.contextmanager
def wine(folder):
    """Yield the command and the environment that run Windows programs; its server ends too.

    The services of Wine start here, once: a program that starts them has their page faults in its own output.
    """
    command, server, quiet = needs("wine"), needs("wineserver"), subprocess.DEVNULL
    environment = {
        **os.environ,
        "TMPDIR": str(folder),
        "WINEPREFIX": str(folder / "wine"),
        "WINEDEBUG": "-all",
        "WINEDLLOVERRIDES": "mscoree,mshtml=",
    }
    try:
        (folder / "wine").mkdir()
        subprocess.run([server, "--persistent"], env=environment, check=True)
        subprocess.run([command, "wineboot"], env=environment, check=True, stdout=quiet, stderr=quiet)
        yield command, environment
    finally:
        for option in ("--kill", "--wait"):
            subprocess.run([server, option], env=environment, check=False)


class Driver:
    """One instance; ``log`` collects (status, message), and ``status`` is that of the last call.

    ``folder`` is that of an FMU that is already unzipped.
    """

    def __init__(self, fmu, folder=None, guid=None):
        self.folder = folder or unzipped(fmu)
        self.description = _description(self.folder)
        self.vr = {v.name: v.valueReference for v in self.description.modelVariables}
        self.log = []
        self.status = 0
        self.callbacks = fmi2.fmi2CallbackFunctions(
            logger=lasting(WeakMethod(self._log)),
            allocateMemory=fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc),
            freeMemory=fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free),
        )
        addLoggerProxy(byref(self.callbacks))
        self.slave = fmi2.FMU2Slave(
            guid=guid or self.description.guid,
            unzipDirectory=str(self.folder),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName="instance",
        )
        self.slave.instantiate(callbacks=self.callbacks, loggingOn=True)

    def _log(self, environment, name, status, category, message):
        self.log.append((status, message.decode()))

    def call(self, name, *arguments, **named):
        """Call a method of FMPy's slave, set ``status``, and return the method's result."""
        self.status = 0
        try:
            return getattr(self.slave, name)(*arguments, **named)
        except FMICallException as error:
            self.status = error.status
            return None

    def set(self, **values):
        """Set variables: ``x_des=(0.1, 0.2)`` a vector, ``Kn=1.0`` a scalar."""
        for group, value in values.items():
            setter = (
                "setBoolean"
                if isinstance(value, bool)
                else "setInteger"
                if group in ("seed", "integrator")
                else "setReal"
            )
            elements = value if isinstance(value, tuple | list) else [value]
            self.call(setter, self.references(group), list(elements))

    def references(self, group):
        if group in self.vr:
            return [self.vr[group]]
        return [vr for name, vr in self.vr.items() if name.startswith(f"{group}[")]

    def get(self, *groups):
        return [x for group in groups for x in self.call("getReal", self.references(group))]

    def outputs(self):
        return self.get("q", "v", "x", "tau")

    def initialise(self, **values):
        self.call("setupExperiment", startTime=0.0)
        self.set(**values)
        self.call("enterInitializationMode")
        self.call("exitInitializationMode")
        return self

    def step(self, t, h=0.01):
        self.call("doStep", t, h)
        return self.status

    def run(self, count, start=0, h=0.01):
        """Return outputs after each of ``count`` steps from step ``start`` on."""
        rows = []
        for k in range(start, start + count):
            assert self.step(k * h, h) == 0, self.log
            rows.append(self.outputs())
        return rows

    def free(self):
        self.slave.freeInstance()
        shutil.rmtree(self.folder, ignore_errors=True)


def forged(fmu, folder, pattern, text):
    """Return the path of an FMU with another modelDescription.xml."""
    path = folder / "forged.fmu"
    with zipfile.ZipFile(fmu) as archive, zipfile.ZipFile(path, "w") as other:
        for name in archive.namelist():
            content = archive.read(name)
            if name == "modelDescription.xml":
                changed, count = re.subn(pattern, text, content.decode())
                assert count
                content = changed.encode()
            other.writestr(name, content)
    return path


def changed_step(fmu_path, folder, lines):
    """The default FMU, whose plant runs some code before each step, or instead of it."""
    body = indent(dedent(lines).strip(), "    ")
    code = f"step = Plant.step\n\ndef changed(self, *times):\n{body}\n    step(self, *times)\n"
    return changed_plant(fmu_path, folder, f"{code}\nPlant.step = changed\n")


def changed_plant(fmu_path, folder, code):
    """The default FMU with code appended to that of its plant, under another digest."""
    other = folder / "Changed.fmu"
    with zipfile.ZipFile(fmu_path) as archive, zipfile.ZipFile(other, "w") as changed:
        (tag,) = {m[1] for n in archive.namelist() if (m := re.search(r"slave_(\w+)\.py", n))}
        own = format(abs(hash(code)), "x")
        for name in archive.namelist():
            content = archive.read(name)
            if name.endswith("plant/plant.py"):
                content += b"\n\n" + code.encode()
            if name.endswith("slavemodule.txt"):
                content = content.replace(tag.encode(), own.encode())
            changed.writestr(name.replace(tag, own), content)
    return other
