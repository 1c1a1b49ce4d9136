"""Runs whose sinks receive rows of outputs, from spans in C or in Python, compared with runs of samples."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader
from systems import WIRES, component, connection, loop, pd_fmu, ssd

import twodof
from twodof.errors import SimulationError
from twodof.fmu import spans

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


def in_each_way(
    monkeypatch: pytest.MonkeyPatch, work: Callable[[str, tuple[twodof.Sink, ...]], object], *, in_c: bool | None = True
) -> list[Any]:
    """Return results of work that is done with spans in C, with spans in Python, and with samples."""
    found, made, span_of = [], list[int](), spans.span_of

    def watched(instance: twodof.fmu.Instance) -> Any:
        span: Any = span_of(instance)

        def call(*arguments: Any) -> Any:
            made.append(1)
            return span(*arguments)

        return call if span else None

    monkeypatch.setattr(spans, "span_of", watched)
    found.append(work("c", ()))
    assert in_c is None or bool(made) == in_c
    monkeypatch.setattr(spans, "span_of", lambda _: None)
    return [*found, work("python", ()), work("samples", (Watcher(),))]


@pytest.mark.parametrize(
    "control, storage, options",
    [
        ("task", "mcap", {"effort": True}),
        ("pose", "mcap", {"scene": True, "effort": True}),
        ("joint", "sqlite3", {}),
        ("effort", "mcap", {"scene": True}),
        ("split", "mcap", {"effort": True}),
        ("split 3", "mcap", {"effort": True}),
        ("task", "mcap", {"measured": True}),
    ],
)
def test_a_bag_of_rows_has_the_messages_of_samples(
    control: str, storage: str, options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part: dict[str, Any] = {"native": True, "control": control}
    if control.startswith("split"):
        part = {"part": "split", "fmi": 3 if control == "split 3" else 2}
    path = twodof.build_fmu(tmp_path / "arm", twodof.FmuOptions(name="Arm", **part))
    given = {"q_noise": 1e-3, "control_period": 0.01} if options.get("measured") else {"v_start": (0.1, -0.2)}
    times: dict[str, Any] = {
        "start_time": 0.7,
        "stop_time": 0.7 + STEPS / 320,
        "step": 1 / 320,
        "stamp_start": 1e9 / 3.0,
    }
    run = twodof.experiment(path, settings=given, **times)

    def work(way: str, further: tuple[twodof.Sink, ...]) -> object:
        return recorded(run, twodof.Bag(tmp_path / way, storage=storage, **options), *further)

    first, *others = in_each_way(monkeypatch, work, in_c=None if "measured" in options else True)
    assert others == [first, first]


@pytest.mark.parametrize("feedthrough", ["direct", "transformed"])
def test_a_loop_with_a_third_party_controller_is_equal_in_each_way(
    feedthrough: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = twodof.build_fmu(tmp_path / "plant.fmu", twodof.FmuOptions(native=True, control="effort")).read_bytes()
    wires = WIRES
    if feedthrough == "transformed":  # a call alone does not do this
        inside = '<ssc:LinearTransformation factor="2.0"/>'
        wires = WIRES.replace(connection("pd.tau[1]", "plant.tau_cmd[1]"), "") + connection(
            "pd.tau[1]", "plant.tau_cmd[1]", inside
        )
    system = f"<ssd:Elements>{component('plant')}{component('pd')}</ssd:Elements><ssd:Connections>{wires}"
    path = loop(tmp_path / "loop.ssp", plant, pd_fmu(), ssd(f"{system}</ssd:Connections>"))
    run = twodof.experiment(path, step=1 / 320, stop_time=STEPS / 320, stamp_start=0, settings={"pd.Kp": 0.1})

    def work(way: str, further: tuple[twodof.Sink, ...]) -> object:
        return recorded(run, twodof.Bag(tmp_path / way), *further)

    first, *others = in_each_way(monkeypatch, work, in_c=feedthrough == "direct")
    assert others == [first, first]


def outcome(run: twodof.Experiment, bag: Path, *further: twodof.Sink) -> tuple[str, str]:
    """Return the error of a run that fails, and the digest of the messages so far."""
    with pytest.raises(SimulationError) as caught:
        twodof.simulate(run, twodof.Bag(bag), *further)
    return str(caught.value), messages(bag)


@pytest.mark.parametrize("failing, count", [("plant", 71), ("pd", 70)])
def test_a_refused_call_has_the_same_message_and_samples_in_each_way(
    failing: str, count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = twodof.build_fmu(tmp_path / "plant.fmu", twodof.FmuOptions(native=True, control="effort"))
    effort = "c->steps < 70 ? 0.0 : 1e300" if failing == "plant" else "0.0; if (c->steps >= 70) return fmi2Error"
    path = loop(tmp_path / "loop.ssp", path.read_bytes(), pd_fmu(effort=effort))
    run = twodof.experiment(path, step=1 / 320, stop_time=1.0, stamp_start=0)
    results = in_each_way(monkeypatch, lambda way, further: outcome(run, tmp_path / way, *further))
    assert results[1:] == results[:1] * 2
    assert f"'{failing}': " in results[0][0]
    assert twodof.read_bag(tmp_path / "c").count == count


def test_a_number_that_is_not_finite_ends_a_run_in_each_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = {f'name="{old}[{i}]"': f'name="{new}[{i}]"' for old, new in (("q", "a"), ("v", "b")) for i in (1, 2)}
    names |= {'name="tau[1]"': 'name="q[1]"', 'name="tau[2]"': 'name="v[1]"', 'unit="N.m"': ""}
    pd = pd_fmu(replaced=names, effort="c->steps < 70 ? 0.1 * c->steps : 0.0 / 0.0")
    plant = twodof.build_fmu(tmp_path / "plant.fmu", twodof.FmuOptions(native=True, control="effort")).read_bytes()
    wires = connection("plant.q[1]", "pd.a[1]")
    system = f"<ssd:Elements>{component('plant')}{component('pd')}</ssd:Elements><ssd:Connections>{wires}"
    path = loop(tmp_path / "loop.ssp", plant, pd, ssd(f"{system}</ssd:Connections>"))
    run = twodof.experiment(twodof.load_fmu(path, robot="pd"), step=1 / 320, stop_time=2.0, stamp_start=0)
    results = in_each_way(monkeypatch, lambda way, further: outcome(run, tmp_path / way, *further))
    assert results[1:] == results[:1] * 2
    assert twodof.read_bag(tmp_path / "c").count == 70


def test_a_bag_with_a_write_of_its_own_receives_samples(native_path: Path, tmp_path: Path) -> None:
    bag = Copied(tmp_path / "bag")
    twodof.simulate(native_path, bag, stop_time=0.1)
    assert bag.seen == bag.count == 11


def test_a_run_that_is_interrupted_leaves_every_sample_so_far(native_path: Path, tmp_path: Path) -> None:
    calls, bag = iter(range(3)), twodof.Bag(tmp_path / "bag")

    def interrupt() -> bool:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        twodof.simulate(native_path, bag, stop=interrupt, stop_time=50.0)
    assert 2 < twodof.read_bag(bag.path).count == bag.count < 5001


def test_spans_are_short_so_that_a_signal_ends_a_run_soon(native_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step that takes longer than FAST is a span of its own."""
    monkeypatch.setattr("twodof.simulation.stepping.FAST", 0.0)
    looks = iter(range(1000))
    twodof.simulate(native_path, stop_time=1.0, stop=lambda: next(looks) < 0)
    assert next(looks) >= 99
    monkeypatch.setattr("twodof.simulation.stepping.FAST", 1e9)
    looks = iter(range(1000))
    twodof.simulate(native_path, stop_time=10.0, stop=lambda: next(looks) < 0)
    assert next(looks) < 99


@pytest.mark.parametrize("further", [(), (Watcher(),)], ids=["rows", "samples"])
def test_a_step_that_fails_is_named_with_its_time(
    further: tuple[twodof.Sink, ...], native_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spans, "span_of", lambda _: None)
    step = twodof.fmu.Instance.step

    def fail(instance: twodof.fmu.Instance, t: float, h: float) -> None:
        if t > 0.205:
            raise SimulationError("it hurts", outcome="discarded")
        step(instance, t, h)

    monkeypatch.setattr(twodof.fmu.Instance, "step", fail)
    with pytest.raises(SimulationError, match=r"0\.21 s.*it hurts"):
        twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), *further)
    assert twodof.read_bag(tmp_path / "bag").count == 22
