"""Runs whose sinks receive rows of outputs instead of samples, compared with runs of samples."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

import twodof
from twodof.errors import SimulationError

STEPS = 320


class Watcher(twodof.Sink):
    """A sink that needs samples; a bag beside it receives them too."""


class Copied(twodof.Bag):
    """A bag whose own ``write`` counts its samples."""

    seen = 0

    def write(self, sample: twodof.Sample) -> None:
        self.seen += 1
        super().write(sample)


def messages(bag: Path) -> str:
    """Return the SHA-256 of all topics, stamps and messages of a bag."""
    digest = hashlib.sha256()
    with AnyReader([bag]) as reader:
        for connection, stamp, data in reader.messages():
            digest.update(f"{connection.topic} {stamp} {len(data)} ".encode() + data)
    return digest.hexdigest()


def recorded(run: twodof.Experiment, bag: twodof.Bag, *further: twodof.Sink) -> tuple[object, ...]:
    """Return what a run leaves behind."""
    summary = twodof.simulate(run, bag, *further)
    assert bag.count == STEPS + 1
    return messages(bag.path), summary.last, str(summary.verdict), twodof.read_bag(bag.path).provenance["verdict"]


@pytest.mark.parametrize(
    "control, storage, options",
    [
        ("task", "mcap", {"effort": True}),
        ("pose", "mcap", {"scene": True, "effort": True}),
        ("joint", "sqlite3", {}),
        ("effort", "mcap", {"scene": True}),
        ("split", "mcap", {"effort": True}),
        ("task", "mcap", {"measured": True}),
    ],
)
def test_a_bag_of_rows_has_the_messages_of_samples(
    control: str, storage: str, options: dict[str, Any], tmp_path: Path
) -> None:
    part: dict[str, Any] = {"part": "split"} if control == "split" else {"native": True, "control": control}
    path = twodof.build_fmu(tmp_path / "arm", twodof.FmuOptions(name="Arm", **part))
    given = {"q_noise": 1e-3, "control_period": 0.01} if options.get("measured") else {"v_start": (0.1, -0.2)}
    times: dict[str, Any] = {
        "start_time": 0.7,
        "stop_time": 0.7 + STEPS / 320,
        "step": 1 / 320,
        "stamp_start": 1e9 / 3.0,
    }
    run = twodof.experiment(path, settings=given, **times)
    found = [
        recorded(run, twodof.Bag(tmp_path / f"bag{k}", storage=storage, **options), *further)
        for k, further in enumerate([(), (Watcher(),)])
    ]
    assert found[0] == found[1]


def test_a_bag_with_a_write_of_its_own_receives_samples(native_path: Path, tmp_path: Path) -> None:
    bag = Copied(tmp_path / "bag")
    twodof.simulate(native_path, bag, stop_time=0.1)
    assert bag.seen == bag.count == 11


def test_a_run_that_is_interrupted_leaves_every_sample_so_far(native_path: Path, tmp_path: Path) -> None:
    calls = iter(range(100))

    def interrupt() -> bool:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop=interrupt)
    assert twodof.read_bag(tmp_path / "bag").count == 101


@pytest.mark.parametrize("further", [(), (Watcher(),)], ids=["rows", "samples"])
def test_a_step_that_fails_is_named_with_its_time(
    further: tuple[twodof.Sink, ...], native_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = twodof.fmu.Instance.step

    def fail(instance: twodof.fmu.Instance, t: float, h: float) -> None:
        if t > 0.205:
            raise SimulationError("it hurts", outcome="discarded")
        step(instance, t, h)

    monkeypatch.setattr(twodof.fmu.Instance, "step", fail)
    with pytest.raises(SimulationError, match=r"0\.21 s.*it hurts"):
        twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), *further)
    assert twodof.read_bag(tmp_path / "bag").count == 22
