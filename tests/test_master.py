"""The master: times, order, ends, and faulty FMUs."""

import logging
import os
import re
import threading
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import changed_step, in_child_process
from oracles import position, task_error
from pythonfmu import FmuBuilder
from sinks import Memory

import twodof
from twodof.errors import FmuError, InputError, SimulationError
from twodof.fmu import instantiate
from twodof.simulation.master import Member, simulate_together
from twodof.simulation.pace import RealTime
from twodof.simulation.stepping import at_rest


class Recorder(twodof.Sink):
    """A sink that keeps what it receives."""

    def __init__(self):
        self.samples = []
        self.left = None

    def write(self, sample):
        self.samples.append(sample)

    def __exit__(self, *exception):
        self.left = exception[0]


def test_n_steps_give_n_plus_one_samples_at_times_that_are_not_accumulated(native_path):
    recorder = Recorder()
    summary = twodof.simulate(native_path, recorder, stop_time=0.7, step=0.1)
    assert [s.k for s in recorder.samples] == list(range(8))
    assert [s.t for s in recorder.samples] == [k * 0.1 for k in range(8)]
    first = recorder.samples[0].stamp
    assert [s.stamp - first for s in recorder.samples] == [k * 100_000_000 for k in range(8)]
    assert summary.last == recorder.samples[-1]
    assert not summary.stopped
    assert recorder.left is None
    first = recorder.samples[0]
    assert first.q == (0.5, 0.35)
    assert first.v == (0.0, 0.0)
    assert first.x == pytest.approx(position(np.array(first.q)), abs=1e-15)
    target = np.array([0.2, 0.05])
    assert summary.error == pytest.approx(np.linalg.norm(target - summary.last.x), rel=1e-12)


@pytest.mark.parametrize("kp, kd", [(50.0, 40.0), (100.0, 20.0), (200.0, 10.0)])
def test_gains_act_as_in_the_closed_form(native_path, kp, kd):
    """Over-, critically and underdamped."""
    recorder = Recorder()
    settings = {"Kp": kp, "Kd": kd, "x_des": (0.15, 0.12)}
    twodof.simulate(native_path, recorder, stop_time=1.0, settings=settings)
    x = np.array([s.x for s in recorder.samples])
    t = np.array([s.t for s in recorder.samples])
    expected = np.array([0.15, 0.12]) - task_error([0.15, 0.12] - x[0], kp, kd, t)
    assert np.abs(x - expected).max() <= 1e-9


def test_a_run_may_start_at_another_time(native_path):
    samples = list(twodof.samples(native_path, start_time=100.0, stop_time=100.05))
    assert [s.t for s in samples] == [100.0 + k * 0.01 for k in range(6)]


def test_inputs_sent_hold_from_the_sample_on(native_path):
    run = twodof.samples(native_path, stop_time=1.0, settings={"x_des": (0.2, 0.05)})
    first = next(run)
    second = run.send({"x_des": (0.1, 0.2)})
    rest = [second, *run]
    assert first.inputs["x_des[1]"] == 0.2
    assert {s.inputs["x_des[1]"] for s in rest} == {0.1}
    other = list(twodof.samples(native_path, stop_time=1.0, settings={"x_des": (0.1, 0.2)}))
    assert [s.q for s in rest] == [s.q for s in other[1:]]


def test_a_sink_is_left_with_the_error_that_ends_the_run(native_path):
    class Failing(Recorder):
        def write(self, sample):
            if sample.k == 3:
                raise RuntimeError("mine")
            super().write(sample)

    before, failing = Recorder(), Failing()
    with pytest.raises(RuntimeError, match="mine"):
        twodof.simulate(native_path, before, failing, stop_time=0.1)
    assert before.left is RuntimeError
    assert len(before.samples) == 4
    assert len(failing.samples) == 3


def test_a_run_that_is_asked_to_stop_ends_between_steps(native_path):
    recorder = Recorder()
    summary = twodof.simulate(native_path, recorder, stop_time=1.0, stop=lambda: len(recorder.samples) > 5)
    assert summary.stopped
    assert summary.last.k == len(recorder.samples) - 1 < 10


class Clock:
    """A clock that advances only while a process sleeps, as on an infinitely fast machine."""

    def __init__(self):
        self.now = 1e6

    def perf_counter(self):
        return self.now

    def time_ns(self):
        return int(self.now * 1e9)

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("twodof.simulation.master.time", clock)
    monkeypatch.setattr("twodof.simulation.pace.time", clock)
    return clock


def test_realtime_paces_to_the_wall_clock(native_path):
    begin = time.monotonic()
    twodof.simulate(native_path, pace=RealTime(), stop_time=0.5, step=0.05)
    assert time.monotonic() - begin >= 0.5


@pytest.mark.parametrize("speed", [0.1, 10.0])
def test_a_run_takes_its_time_divided_by_the_speed(native_path, clock, speed):
    pace = RealTime(speed)
    assert twodof.simulate(native_path, pace=pace, stop_time=0.5, step=0.05).wall_time == pytest.approx(0.5 / speed)
    assert pace.missed == 0


def test_missed_deadlines_are_counted_and_caught_up_with(native_path, clock):
    pace = RealTime()

    class Slow(Recorder):
        def write(self, sample):
            if sample.k == 2:
                clock.sleep(0.12)  # the next two are due in 0.05 s and 0.1 s

    summary = twodof.simulate(native_path, Slow(), pace=pace, stop_time=0.5, step=0.05)
    assert pace.missed == 2
    assert pace.worst == pytest.approx(0.07)
    assert summary.wall_time == pytest.approx(0.5)


def test_time_that_sinks_take_to_open_is_not_the_runs(native_path, clock):
    pace = RealTime()

    class Slow(Recorder):
        def __enter__(self):
            clock.sleep(0.3)
            return self

    summary = twodof.simulate(native_path, Slow(), pace=pace, stop_time=0.5, step=0.05)
    assert pace.missed == 0
    assert summary.wall_time == pytest.approx(0.5)


def test_steering_holds_from_the_sample_on_that_it_answers(native_path):
    answers: dict[int, Any] = {3: {"x_des": (0.1, 0.2)}, 7: {"Kp[2]": 80.0}, 20: {"Kp": 1.0}}
    recorder = Recorder()
    twodof.simulate(
        native_path, recorder, stop_time=0.2, stamp_start=0.0, steer=lambda: answers.get(recorder.samples[-1].k)
    )
    run = twodof.samples(native_path, stop_time=0.2, stamp_start=0.0)
    expected = [next(run)]
    expected += [run.send(answers.get(k)) for k in range(20)]
    assert recorder.samples == expected
    assert [s.inputs["x_des[1]"] for s in expected[3:5]] == [0.2, 0.1]


def test_a_run_continues_at_rest_after_a_discarded_step(native_path):
    """The run continues like one that starts there with its target there."""
    recorder, fmu = Recorder(), twodof.load_fmu(native_path)
    reasons = []

    def resume(sample, error):
        reasons.append((sample.k, error.outcome))
        return at_rest(fmu, sample)

    twodof.simulate(
        fmu,
        recorder,
        stop_time=0.2,
        step=0.01,
        resume=resume,
        steer=lambda: {"x_des": (1e308, 1e308)} if recorder.samples[-1].k == 5 else None,
    )
    assert reasons == [(5, "discarded")]
    before, *after = recorder.samples[5:]
    assert max(map(abs, before.v)) > 0.1
    settings = {"q_start": before.q, "v_start": (0.0, 0.0), "x_des": before.x}
    again = [*twodof.samples(fmu, stop_time=0.15, step=0.01, settings=settings)][1:]
    assert len(after) == len(again) == 15
    for sample, expected in zip(after, again):
        assert (sample.inputs["x_des[1]"], sample.inputs["x_des[2]"]) == before.x
        assert sample.since == before.t
        assert sample.q + sample.v == pytest.approx(expected.q + expected.v, abs=1e-9)


def test_inputs_of_a_continued_run_hold_since_then(native_path, monkeypatch):
    """No input was set before the discarded step."""
    fmu = twodof.load_fmu(native_path)
    broken: list[float] = []
    with instantiate(fmu) as instance:
        step = instance.step

        def breaks(t, h):
            if t > 0.055 and not broken:
                broken.append(t)
                raise SimulationError("too fast", outcome="discarded")
            step(t, h)

        monkeypatch.setattr(instance, "step", breaks)
        run = twodof.samples(
            fmu, stop_time=0.1, step=0.01, instance=instance, resume=lambda sample, error: at_rest(fmu, sample)
        )
        since = [sample.since for sample in run]
    assert since == [0.0] * 7 + [0.06] * 4


def test_a_loop_of_ones_own_is_paced(native_path, clock):
    for sample in twodof.samples(native_path, pace=RealTime(), stop_time=0.5, step=0.05):
        assert clock.now - 1e6 == pytest.approx(sample.t)


def test_runs_that_do_not_go_together_open_no_sink(native_path, monkeypatch):
    recorder = Recorder()
    monkeypatch.setattr(recorder, "begin", lambda run: pytest.fail("it was opened"))
    options: dict[str, Any] = {"stop_time": 0.1, "stamp_start": 0.0}
    first = Member(twodof.experiment(native_path, **options), [recorder])
    for other, error in (
        ({**options, "stop_time": 0.2}, InputError),
        ({**options, "start_time": 0.05}, InputError),
        ({**options, "stamp_start": 1.0}, InputError),
        ({**options, "settings": {"rtol": -1.0}}, SimulationError),
    ):
        with pytest.raises(error, match=r"runs in one loop|rtol = -1 must be"):
            simulate_together([first, Member(twodof.experiment(native_path, **other), [])])
    unstamped = Member(twodof.experiment(native_path, stop_time=0.1), [])
    with pytest.raises(InputError, match="runs in one loop need equal"):
        simulate_together([unstamped, unstamped])


def test_messages_of_the_fmu_go_to_logging(native_path, caplog):
    with caplog.at_level(logging.INFO, "twodof.fmu"):
        twodof.simulate(native_path, stop_time=0.01, settings={"q_start": (4.0, 0.35)})
    (record,) = [r for r in caplog.records if r.name == "twodof.fmu"]
    assert record.levelno == logging.WARNING
    assert "q_start[1] = 4 of joint 'joint1' is outside its limits" in record.getMessage()


def test_a_target_in_millimetres_is_doubted_before_the_run_and_where_it_fails(native_path, caplog):
    question = "the target x_des is 205.9 m from the end effector; is the target in millimetres?"
    with pytest.raises(SimulationError, match=re.escape(question)):  # hypot(200, 50) m, less the pose at the start
        twodof.simulate(native_path, stop_time=0.01, settings={"x_des": (200.0, 50.0), "max_step": 1e-9})
    assert question in caplog.text
    caplog.clear()
    twodof.simulate(native_path, stop_time=0.01, settings={"x_des": (40.0, 9.0)})  # too far, but perhaps in metres
    assert not caplog.text


def test_a_refusal_of_the_fmu_comes_with_its_own_words(native_path):
    with pytest.raises(SimulationError, match=r"^rtol = -1 must be > 0$") as error:
        twodof.simulate(native_path, stop_time=1.0, settings={"rtol": -1.0})
    assert error.value.k == 0


@pytest.mark.parametrize(
    "inside, message",
    [
        ("self.v = [float('nan')] * 2; return", r"not finite at t = 0\.01 s"),
        ("raise RuntimeError('broken inside')", "broken inside"),
    ],
)
@in_child_process
def test_an_fmu_that_fails_ends_the_run_with_the_valid_samples(fmu_path, tmp_path, inside, message):
    recorder = Recorder()
    with pytest.raises(SimulationError, match=message):
        twodof.simulate(changed_step(fmu_path, tmp_path, inside), recorder, stop_time=1.0)
    assert len(recorder.samples) == 1
    assert recorder.left is SimulationError


@in_child_process
def test_values_are_finite_also_where_their_sum_is_not(fmu_path, tmp_path):
    changed = changed_step(fmu_path, tmp_path, "self.q = [1.5e308] * 2; return")
    assert twodof.simulate(changed, stop_time=0.01).last.q == (1.5e308, 1.5e308)


OTHER_MAKER = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Clock(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.angle, self.speed, self.rate = 0.0, 0.0, 2.0
        output, settable = Fmi2Causality.output, Fmi2Causality.input
        get = lambda name: (lambda: getattr(self, name))
        self.register_variable(Real("q[1]", causality=output, getter=get("angle")), nested=False)
        self.register_variable(Real("v[1]", causality=output, getter=get("speed")), nested=False)
        self.register_variable(Real("rate", causality=settable))

    def do_step(self, current_time, step_size):
        self.speed = self.rate
        self.angle += self.rate * step_size
        return True
"""


@pytest.fixture(scope="module")
def other_maker(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clock")
    (folder / "clock_slave.py").write_text(OTHER_MAKER)
    return Path(FmuBuilder.build_FMU(folder / "clock_slave.py", folder))


@in_child_process
def test_a_third_party_fmu_runs_if_its_variables_match(other_maker, tmp_path):
    run = twodof.experiment(other_maker, stop_time=0.05, settings={"rate": 3.0})
    recorder = Recorder()
    twodof.simulate(run, recorder, twodof.Bag(tmp_path / "bag"))
    assert recorder.samples[-1].q == pytest.approx((0.15,))
    assert recorder.samples[-1].x == recorder.samples[-1].tau == ()
    assert twodof.read_bag(tmp_path / "bag").joints == ("joint1",)


def test_an_fmu_for_another_platform_is_refused_with_its_platforms(fmu_path, tmp_path):
    other = tmp_path / "Win.fmu"
    with zipfile.ZipFile(fmu_path) as archive, zipfile.ZipFile(other, "w") as changed:
        for name in archive.namelist():
            moved = name.replace("linux64/TwoDof.so", "win64/TwoDof.dll")
            changed.writestr(moved, archive.read(name))
    with pytest.raises(FmuError, match=r"no binary for this platform \(linux64\), only for: win64"):
        next(twodof.samples(other))


@in_child_process
def test_memory_is_flat_over_many_logged_steps(fmu_path, tmp_path):
    """Steps of 1 ms, with seven evaluations each, go into a bag: 52 bytes a step, and the queue."""
    run = twodof.experiment(fmu_path, stop_time=72.0, step=1e-3)
    memory = Memory(9000)  # by the first look the bag has stored something, and a block is judged
    twodof.simulate(run, twodof.Bag(tmp_path / "bag"), memory)
    assert memory.growth <= 2_000_000 + 52 * 54_000  # 2 MB wait to be stored at most


@pytest.mark.parametrize(
    "use",
    [
        lambda run: twodof.simulate(run),
        lambda run: run.fmu.urdf,
        lambda run: twodof.page(run.fmu, "page.html"),
        lambda run: twodof.sweep(run.fmu, grid={"Kp": [50.0]}, stop_time=0.1, workers=1),
    ],
    ids=["simulate", "urdf", "page", "sweep"],
)
def test_facts_of_an_fmu_are_not_used_for_another(tmp_path, native_path, monkeypatch, use):
    """Two robots' URDFs have one name, or one is rebuilt meanwhile."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "arm.fmu"
    path.write_bytes(native_path.read_bytes())
    run = twodof.experiment(path, stop_time=0.1)
    path.write_bytes(native_path.read_bytes())  # the same again is the same
    twodof.simulate(run)
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    content["resources/robot.urdf"] += b"<!-- heavier -->"
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    with pytest.raises(FmuError, match=r"'.*arm\.fmu' was replaced by another FMU"):
        use(run)
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize("how", [twodof.samples, twodof.simulate])
def test_options_beside_an_experiment_are_refused(native_path, how):
    run = twodof.experiment(native_path, stop_time=0.1)
    with pytest.raises(InputError, match="settings, step would have no effect with an experiment"):
        list(how(run, settings={"Kp": 10.0}, step=0.1))


def test_threads_stay_in_the_working_directory_while_an_fmu_is_loaded(tmp_path, native_path, fmu_path, monkeypatch):
    """The working directory belongs to the whole process."""
    monkeypatch.chdir(tmp_path)
    there, ended = [], threading.Event()

    def look():
        while not ended.is_set():
            there.append(os.getcwd())

    looking = threading.Thread(target=look)
    looking.start()
    try:
        for path in (native_path, fmu_path) * 3:
            next(twodof.samples(path))
    finally:
        ended.set()
        looking.join()
    assert set(there) == {str(tmp_path)}
