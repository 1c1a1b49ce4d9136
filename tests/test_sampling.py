"""A sampled controller: closed forms, time events at any communication step, sensors and their noise."""

import functools
import re
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import fmpy
import native_models
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.special
import scipy.stats
from harness import wine
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from tools import needs

import twodof
from twodof import FmuOptions, build_fmu, linearise, load_fmu
from twodof.errors import TwoDofError
from twodof.export.compiler import FLAGS, TARGETS, ZIG
from twodof.fmu import instantiate, resolve
from twodof.plant.noise import WORD, logarithm, normal_pair, philox
from twodof.plant.plant import Plant
from twodof.plant.robot import load_robot
from twodof.plant.sampling import rounded
from twodof.plant.variables import variable_table
from twodof.simulation.sampled_loop import quickest_gains, spectral_radius, stable_gains

SLIDER = """<robot name="slider">
  <link name="rail"/>
  <link name="cart"><inertial><mass value="2.5"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-100" upper="100" effort="1000" velocity="100"/></joint>
</robot>"""
EXACT = dict(rtol=1e-10, atol=1e-12)


def slider(control="joint", **values):
    robot = load_robot(SLIDER, "cart", "x")
    starts = {"q_start": (0.3,), "v_start": (-0.2,), "gravity": (0.0, 0.0, 0.0)}
    plant = Plant(robot, variable_table(robot, starts, control), control)
    for name, value in {**EXACT, **values}.items():
        setattr(plant, name, value)
    plant.initialise()
    return plant


def closed_form(T, D, Kp, Kd, samples, target=0.0):
    """q and v of a double integrator at t_k, its acceleration held from t_k + D to t_(k+1) + D."""
    whole, part = divmod(D, T)
    whole, part = (whole + 1, 0.0) if T - part < 1e-9 * T else (whole, part)
    y, commands, states = np.array([0.3, -0.2]), [0.0] * (int(whole) + 1), []

    def moved(y, a, h):
        A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, a], [0.0, 0.0, 0.0]])
        return (scipy.linalg.expm(A * h) @ [*y, 1.0])[:2]

    for _ in range(samples):
        states.append(y)
        commands.append(Kp * (target - y[0]) - Kd * y[1])
        before, after = commands[-2 - int(whole)], commands[-1 - int(whole)]
        y = moved(moved(y, before, part), after, T - part)
    return np.array(states)


@pytest.mark.parametrize("delay", [0.0, 0.002, 0.003, 0.01, 0.1])
def test_a_sampled_joint_follows_its_discrete_time_closed_form(delay):
    T, Kp, Kd = 0.01, 20.0, 5.0
    plant = slider(control_period=T, control_delay=delay, Kp=[Kp], Kd=[Kd], q_des=[0.0])
    expected = closed_form(T, delay, Kp, Kd, 200)
    assert np.abs(expected).max() < 2.0
    for q, v in expected:
        assert abs(plant.q[0] - q) <= 1e-10
        assert abs(plant.v[0] - v) <= 1e-10
        plant.step(T)


@pytest.mark.parametrize(
    "Kp, Kd, stable", [(1000.0, 195.0, True), (1000.0, 205.0, False), (1900.0, 10.0, True), (2100.0, 10.0, False)]
)
def test_a_sampled_joint_is_stable_up_to_its_closed_form(Kp, Kd, stable):
    """Kp T/2 < Kd < 2/T, by Jury's test of the discrete loop."""
    plant = slider(control_period=0.01, Kp=[Kp], Kd=[Kd], q_des=[0.0], q_min=[-1e9], q_max=[1e9])
    assert stable == (Kp * 0.01 / 2 < Kd < 2 / 0.01)
    for _ in range(2500):
        plant.step(0.01)
    assert (abs(plant.q[0]) + abs(plant.v[0]) < 0.1) == stable


@pytest.mark.parametrize(("Kp", "Kd"), [(1000.0, 1000.0), (90000.0, 300.0), (1e9, 1e5)])
def test_the_largest_stable_gains_are_those_of_the_closed_form(Kp, Kd):
    """Kp T/2 < Kd < 2/T, for gains Kp c² and Kd c of the same damping ratio."""
    scale = min(2.0 / 0.01 / Kd, 2.0 * Kd / (Kp * 0.01))
    assert stable_gains(Kp, Kd, 0.01, 0.0) == pytest.approx((Kp * scale**2, Kd * scale), rel=1e-3)


def test_the_largest_stable_gains_of_a_late_controller_have_no_phase_margin():
    """A continuous loop with a delay is stable while, where |L| = 1, atan(ω Kd/Kp) exceeds ω times the delay."""
    delay = 0.05
    Kp, Kd = stable_gains(900.0, 60.0, 1e-3, delay)
    crossing = np.sqrt((Kd**2 + np.sqrt(Kd**4 + 4.0 * Kp**2)) / 2.0)
    assert np.arctan(crossing * Kd / Kp) == pytest.approx(crossing * (delay + 0.5e-3), rel=1e-3)
    assert stable_gains(900.0, 0.0, 0.01, 0.0) == (0.0, 0.0)


def test_a_loop_without_stiffness_has_the_radius_of_its_speed():
    """v_{k+1} = (1 − Kd T) v_k; the mean of a period before replaces v_k if velocities are differences."""
    assert spectral_radius(0.0, 45.0, 0.05, 0.0) == pytest.approx(abs(1.0 - 45.0 * 0.05), rel=1e-12)
    known = np.abs(np.roots([1.0, 0.5 * 45.0 * 0.05 - 1.0, 0.5 * 45.0 * 0.05])).max()
    assert spectral_radius(0.0, 45.0, 0.05, 0.0, differences=True) == pytest.approx(known, rel=1e-12)
    assert stable_gains(0.0, 45.0, 0.05, 0.0) == pytest.approx((0.0, 40.0), rel=1e-3)
    assert quickest_gains(0.0, 45.0, 0.05, 0.0) == pytest.approx((0.0, 20.0), rel=1e-2)


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.03])
@pytest.mark.parametrize(("Kp", "Kd"), [(50000.0, 300.0), (1e6, 900.0)])
def test_the_quickest_gains_are_those_that_an_optimiser_finds(Kp, Kd, delay):
    def radius(scale):
        return spectral_radius(scale**2 * Kp, scale * Kd, 0.01, delay)

    bound = stable_gains(Kp, Kd, 0.01, delay)[1] / Kd
    best = scipy.optimize.brute(lambda s: radius(s[0]), [(0.01 * bound, bound)], Ns=400).item()
    assert quickest_gains(Kp, Kd, 0.01, delay) == pytest.approx((best**2 * Kp, best * Kd), rel=2.5e-2)


@pytest.mark.parametrize("differences", [False, True])
@pytest.mark.parametrize("delay", [0.0, 0.0008, 0.003, 0.01, 0.023])
def test_the_motion_of_an_unstable_sampled_loop_grows_by_its_spectral_radius(delay, differences):
    """A recurrence of second order of the final motion gives the two largest eigenvalues."""
    T, Kp, Kd = 0.01, 900.0, 600.0 if delay < 0.01 else 130.0
    gains = dict(control_period=T, control_delay=delay, Kp=[Kp], Kd=[Kd], q_des=[0.0])
    plant = slider(**gains, v_from_q=float(differences), q_min=[-1e99], q_max=[1e99])
    q = []
    for _ in range(100):
        plant.step(T)
        q.append(plant.q[0])
    x = np.array(q[-12:]) / q[-1]
    recurrence = np.linalg.lstsq(np.column_stack([x[1:-1], x[:-2]]), x[2:], rcond=1e-7)[0]
    grown = np.abs(np.roots([1.0, *-recurrence])).max()
    radius = spectral_radius(Kp, Kd, T, delay, differences=differences)
    assert grown > 1.02
    assert grown == pytest.approx(radius, rel=1e-5)


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    """The slider under joint and effort control, and the shipped arm, by control, flavour and version of FMI."""
    folder = tmp_path_factory.mktemp("sampling")
    urdf = folder / "slider.urdf"
    urdf.write_text(SLIDER)

    @functools.cache
    def fmu(robot, control, kind):
        options = FmuOptions(control=control, native=kind != "python", fmi=3 if kind == "fmi3" else None)
        if robot == "slider":
            options = replace(options, urdf=urdf, axes="x", gravity=(0.0, 0.0, 0.0), name="slider")
        return build_fmu(folder / f"{robot}_{control}_{kind}.fmu", options)

    return fmu


KINDS = ("python", "fmi2", "fmi3")


def run(fmu, stop_time, step, changes=None, adds_up=False, **settings):
    """q, v, tau, q_meas, v_meas at each communication point, whose times are accumulated or not."""
    settings = {**EXACT, **settings}
    fmu = load_fmu(fmu)
    with instantiate(fmu) as instance:
        values = resolve(fmu, settings)
        instance.initialise(0.0, np.inf, values)
        read = instance.reader([n for g in ("q", "v", "tau", "q_meas", "v_meas") for n in fmu.vector(g)])
        rows, due = [list(read())], dict(changes or {})
        time = 0.0
        for k in range(round(stop_time / step)):
            for t in [t for t in due if t <= k * step + 1e-9]:
                instance.set(resolve(fmu, due.pop(t)))
            instance.step(time if adds_up else k * step, step)
            time += step
            rows.append(list(read()))
    return np.array(rows)


SEEN = {"q_resolution": 1e-3, "q_noise": 2e-4, "v_noise": 1e-2, "seed": 11}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("period, delay", [(0.01, 0.0), (0.004, 0.0013), (0.0025, 0.025), (0.011, 0.002)])
def test_no_communication_step_moves_a_sample(fmus, kind, period, delay):
    """Inputs change at 0.35 s and 0.7 s, communication points of all steps, and samples of one period."""
    fmu = fmus("twodof", "task", kind)
    changes = {0.35: {"x_des": (0.15, 0.1)}, 0.7: {"x_des": (0.2, 0.0), "tau_ext": (0.1, 0.0)}}
    settings = {"control_period": period, "control_delay": delay, "Kp": 30.0, "Kd": 12.0, **SEEN}
    coarse = run(fmu, 1.05, 0.35, changes, **settings)
    assert np.ptp(coarse[:, 0]) > 0.1
    for step in (0.001, 0.002, 0.005, 0.007, 0.01, 0.05):
        fine = run(fmu, 1.05, step, changes, **settings)
        assert np.abs(fine[:: round(0.35 / step)] - coarse).max() <= 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_an_input_at_a_sampling_time_is_seen_by_that_sample(fmus, kind):
    """The importer may accumulate its steps; the output before is the effort that would act."""
    fmu = fmus("slider", "effort", kind)
    for step, adds_up in ((0.001, False), (0.001, True), (0.01, True)):
        points = [k * 0.05 for k in range(1, 19)]
        rows = run(fmu, 1.0, step, {t: {"tau_cmd": t} for t in points}, adds_up, control_period=0.05)[:, 2]
        times = [0.05 * np.floor((k * step + 1e-9) / 0.05) for k in range(round(0.95 / step))]
        expected = np.array(times)
        before = [k for k, t in enumerate(times) if t and abs(k * step - t) < 1e-9]
        expected[before] -= 0.05  # read before the input was set
        assert np.abs(rows[: len(expected)] - expected).max() < 1e-12


@pytest.mark.parametrize("kind", ["fmi2", "fmi3"])
@pytest.mark.parametrize("delay", [0.0, 0.003, 0.02])
def test_cvode_sees_the_time_events_in_model_exchange(fmus, kind, delay):
    fmu = fmus("twodof", "joint", kind)
    settings = {"control_period": 0.01, "control_delay": delay, "Kp": 40.0, "Kd": 12.0, "q_noise": 2e-3, "seed": 5}
    expected = run(fmu, 1.0, 0.01, **settings, q_des=(0.9, 0.6))
    values = resolve(load_fmu(fmu), {**EXACT, **settings, "q_des": (0.9, 0.6)})
    if kind == "fmi3":
        vectors: dict = {}
        for name, value in values.items():
            vectors.setdefault(name.partition("[")[0], []).append(value)
        values = {name: vector if len(vector) > 1 else vector[0] for name, vector in vectors.items()}
    names = ["q"] if kind == "fmi3" else ["q[1]", "q[2]"]
    result = fmpy.simulate_fmu(
        str(fmu),
        fmi_type="ModelExchange",
        stop_time=1.0,
        output_interval=0.01,
        relative_tolerance=1e-10,
        start_values=values,
        output=names,
        record_events=False,
    )
    q = result["q"] if kind == "fmi3" else np.array([result[name] for name in names]).T
    assert len(q) == 101
    assert np.abs(q - expected[:, :2]).max() <= 1e-6


# --- sensors ---


@pytest.mark.parametrize(
    "counter, key, words",
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((WORD,) * 4, (WORD,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_uniform_words_are_those_of_random123(counter, key, words):
    """The known answers are those of the authors' library, file kat_vectors, philox4x32 10."""
    assert philox(counter, key) == words


def test_the_logarithm_is_right_to_four_units_in_the_last_place():
    rng = np.random.default_rng(1)
    for x in [*rng.random(20000), *(rng.random(20000) * 2.0 ** -rng.integers(1, 105, 20000)), 1.0 - 2.0**-53]:
        assert abs(logarithm(x) - np.log(x)) <= 4 * np.spacing(abs(np.log(x)))


@pytest.mark.parametrize("kind", KINDS)
def test_every_flavour_has_bit_identical_noise(fmus, kind):
    """A joint at rest at 0 shows only noise; without a period, sensors are sampled at communication points."""
    for seed in (0, 1, 2**31 - 1):
        rows = run(fmus("slider", "effort", kind), 0.5, 0.01, q_start=0.0, q_noise=1.0, v_noise=1.0, seed=seed)
        assert [tuple(row[3:]) for row in rows] == [normal_pair(seed, k, 0) for k in range(51)]


NOISE = """
#include <inttypes.h>
#include <stdio.h>
#include <string.h>
#include "noise.c"
int main(void)
{
    for (int i = 0; i < 3000; i++) {
        double pair[2];
        uint64_t bits[2];
        normal_pair(i % 3 * 1073741823.0, i % 2 ? i : 9007199254740991.0 - i, i % 7, pair);
        memcpy(bits, pair, sizeof bits);
        printf("%016" PRIx64 " %016" PRIx64 "\\n", bits[0], bits[1]);
    }
}
"""


@pytest.mark.parametrize("machine", ["here", "ARM", "Windows"])
def test_every_platform_has_bit_identical_noise(machine, tmp_path):
    """Compiled with the flags of FMUs; run by qemu and wine."""
    (tmp_path / "main.c").write_text(NOISE)
    sources, program = Path(__file__).parents[1] / "fmu_src/native", tmp_path / "noise.exe"
    if machine == "ARM":
        emulator = [needs("qemu"), "-L", str(Path(needs("libc-arm64")).parents[1])]
        compiler = [*ZIG, *TARGETS["aarch64-linux"]]
        needs("ziglang")
    else:
        emulator, compiler = [], [needs("gcc" if machine == "here" else "mingw")]
    command = [*compiler, *FLAGS, f"-I{sources}", "-o", str(program), "main.c", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    if machine == "Windows":
        with wine(tmp_path) as (loader, environment):
            told = subprocess.run([loader, program], env=environment, capture_output=True, text=True, check=True).stdout
    else:
        told = subprocess.run([*emulator, program], capture_output=True, text=True, check=True).stdout
    ours = [normal_pair(i % 3 * 1073741823, i if i % 2 else 2**53 - 1 - i, i % 7) for i in range(3000)]
    assert told.split() == [struct.pack(">d", x).hex() for pair in ours for x in pair]


def test_noise_is_normal_and_independent():
    """A chi-square test covers 1e6 numbers of both channels, and of neighbours in time, joint, kind and seed."""
    engine = native_models.engine("twodof")
    n = 250_000
    noise = np.empty((4, n, 2))  # seeds 3 and 4, joints 0 and 1
    for row, (seed, joint) in zip(noise, [(3.0, 0.0), (3.0, 1.0), (4.0, 0.0), (4.0, 1.0)]):
        engine.call("noise", seed, 0.0, joint, float(n), row)
    few = [normal_pair(4, k, 1) for k in range(500)]
    assert (noise[3, :500] == few).all()
    bins = np.linspace(0.0, 1.0, 101)[1:-1]
    uniform = scipy.special.ndtr(noise)

    def passes(cells, count):
        expected = cells.size * [1.0 / cells.size]
        p = scipy.stats.chisquare(cells.ravel(), np.array(expected) * count).pvalue
        assert 1e-4 < p < 1.0 - 1e-4

    whole = noise.ravel()
    assert abs(whole.mean()) < 4e-3 and abs(whole.var() - 1.0) < 6e-3
    passes(np.bincount(np.digitize(uniform.ravel(), bins), minlength=100), whole.size)
    of_q, of_v = uniform[..., 0], uniform[..., 1]
    pairs = [(of_q[:, :-1], of_q[:, 1:]), (of_q, of_v), (of_q[0], of_q[1]), (of_q[0], of_q[2]), (of_v[1], of_v[3])]
    for one, other in pairs:
        cells, *_ = np.histogram2d(one.ravel(), other.ravel(), bins=20, range=((0, 1), (0, 1)))
        passes(cells, one.size)


def test_a_resolution_rounds_to_the_nearest_and_ties_to_even():
    steps = [0.5, 1.5, 2.5, -0.5, -1.5, 0.49, 0.51, -0.51, 3.0]
    assert [rounded(0.25 * k, 0.25) for k in steps] == [0.0, 0.5, 0.5, 0.0, -0.5, 0.0, 0.25, -0.25, 0.75]
    assert rounded(0.3, 0.0) == 0.3 and rounded(0.3, 5e-324) == 0.3 and rounded(1e300, 1e-9) == 1e300


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("q, seen", [(0.125, 0.0), (0.375, 0.5), (-0.375, -0.5), (0.13, 0.25)])
def test_every_flavour_rounds_alike(fmus, kind, q, seen):
    assert run(fmus("slider", "effort", kind), 0.01, 0.01, q_start=q, q_resolution=0.25)[:, 3].tolist() == [seen] * 2


@pytest.mark.parametrize("kind", KINDS)
def test_velocities_are_differences_of_measured_positions(fmus, kind):
    settings = dict(control_period=0.01, q_resolution=1e-3, q_noise=1e-4, seed=3, v_from_q=True, q_des=1.0, v_start=0.5)
    rows = run(fmus("slider", "joint", kind), 0.5, 0.01, **settings)
    q_meas, v_meas = rows[:, 3], rows[:, 4]
    assert v_meas[0] == 0.0
    assert (v_meas[1:] == np.diff(q_meas) / 0.01).all()
    counts = (q_meas - [1e-4 * normal_pair(3, k, 0)[0] for k in range(51)]) / 1e-3
    assert np.abs(counts - np.round(counts)).max() < 1e-9
    assert np.abs(q_meas - rows[:, 0]).max() < 1.5e-3


def test_the_effort_is_that_of_the_measured_state_within_the_limits(fmus):
    settings = {"control_period": 0.01, "q_noise": 0.05, "v_noise": 0.5, "seed": 9, "q_des": 1.0}
    for limit in (False, True):
        rows = run(fmus("slider", "joint", "fmi2"), 0.3, 0.01, **settings, limit_effort=limit, Kp=900.0)
        wanted = 2.5 * (900.0 * (1.0 - rows[:, 3]) - 40.0 * rows[:, 4])
        assert np.abs(wanted).max() > 1000.0
        expected = np.clip(wanted, -1000.0, 1000.0) if limit else wanted
        assert np.abs(rows[:, 2] - expected).max() < 1e-9


def test_a_bag_of_measured_states_also_has_the_true_ones(fmus, tmp_path):
    settings = {"control_period": 0.01, "x_des": (0.15, 0.1), **SEEN, **EXACT}
    fmu, storages = fmus("twodof", "task", "fmi2"), {"mcap": read_topics_of_mcap, "sqlite3": read_topics_of_sqlite3}
    samples = list(twodof.samples(fmu, stop_time=0.3, settings=settings))
    for storage, read in storages.items():
        bag = twodof.Bag(tmp_path / storage, measured=True, effort=True, storage=storage)
        twodof.run(fmu, bag, stop_time=0.3, settings=settings)
        topics = read(tmp_path / storage)
        assert topics.keys() == {"/joint_states", "/joint_states_true"}
        for sample, seen, true in zip(samples, topics["/joint_states"], topics["/joint_states_true"], strict=True):
            assert (*seen.position, *seen.velocity) == (*sample.q_meas, *sample.v_meas) != (*sample.q, *sample.v)
            assert (*true.position, *true.velocity) == (*sample.q, *sample.v)
            assert (*seen.effort,) == sample.tau and not len(true.effort) and seen.header == true.header
    with pytest.raises(TwoDofError, match="no outputs q_meas"):
        other = replace(load_fmu(fmu), variables={n: v for n, v in load_fmu(fmu).variables.items() if "meas" not in n})
        twodof.run(other, twodof.Bag(tmp_path / "other", measured=True), stop_time=0.1)


def read_topics_of_mcap(folder):
    topics: dict = {}
    with next(folder.glob("*.mcap")).open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            topics.setdefault(channel.topic, []).append(message)
    return topics


def read_topics_of_sqlite3(folder):
    topics: dict = {}
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(folder) as reader:
        for connection, _, data in reader.messages():
            topics.setdefault(connection.topic, []).append(store.deserialize_cdr(data, connection.msgtype))
    return topics


def test_chatter_is_the_rms_of_the_efforts_changes(fmus):
    settings = {"control_period": 0.002, "q_des": (0.9, 0.8), **SEEN}
    fmu = fmus("twodof", "joint", "fmi2")
    tau = np.array([sample.tau for sample in twodof.samples(fmu, stop_time=50.0, step=0.01, settings=settings)])
    assert len(tau) > 4096  # more than is judged at a time
    expected = np.sqrt(np.mean(np.diff(tau, axis=0) ** 2, axis=0)).max()
    found = twodof.run(fmu, stop_time=50.0, step=0.01, settings=settings).verdict.numbers["chatter"]
    assert found == pytest.approx(expected, rel=1e-12)


# --- what is refused ---

REFUSED: dict = {
    ("joint", "control_delay"): ({"control_delay": 0.01}, "control_delay = 0.01 needs a control_period > 0"),
    ("joint", "long"): (
        {"control_period": 0.001, "control_delay": 0.0101},
        "control_delay = 0.0101 must be at most 10 times control_period = 0.001; reduce it",
    ),
    ("joint", "slightly too long"): (
        {"control_period": 0.01, "control_delay": 0.1000000001},
        "control_delay = 0.1000000001 must be at most 10 times control_period = 0.01; reduce it",
    ),
    ("joint", "q_noise"): ({"q_noise": 0.1}, "q_noise[1] = 0.1 needs a control_period > 0; set that"),
    ("joint", "v_noise"): ({"v_noise": 0.1}, "v_noise[1] = 0.1 needs a control_period > 0; set that"),
    ("joint", "q_resolution"): ({"q_resolution": 0.1}, "q_resolution[1] = 0.1 needs a control_period > 0"),
    ("joint", "v_from_q"): ({"v_from_q": True}, "v_from_q = true needs a control_period > 0; set that"),
    ("effort", "both"): ({"v_from_q": True, "v_noise": 0.1}, "v_noise[1] = 0.1 has no effect with v_from_q = true"),
    ("effort", "period"): ({"control_period": -1.0}, "control_period = -1 must be >= 0"),
    ("effort", "negative"): ({"control_period": 1.0, "control_delay": -0.1}, "control_delay = -0.1 must be >= 0"),
    ("effort", "rho"): ({"q_resolution": -0.1}, "q_resolution[1] = -0.1 must be >= 0"),
    ("effort", "sigma"): ({"q_noise": -0.1}, "q_noise[1] = -0.1 must be >= 0"),
    ("effort", "friction"): ({"friction": -0.1}, "friction[1] = -0.1 must be >= 0"),
    ("effort", "armature"): ({"armature": -1e-9}, "armature[1] = -1e-09 must be >= 0"),
    ("effort", "damping"): ({"damping": -0.1}, "damping[1] = -0.1 must be >= 0"),
    ("effort", "seed"): ({"seed": -1}, "seed = -1 must be in [0, 2147483647]"),
    ("effort", "large"): ({"seed": 2**31}, "seed = 2147483648 must be in [0, 2147483647]"),
    ("effort", "half"): ({"seed": 0.5}, "seed = 0.5 must be a whole number"),
    ("effort", "short"): ({"control_period": 1e-9}, "control_period = 1e-09 s divides a step of 0.01 s into more than"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", REFUSED, ids="-".join)
def test_bad_parameters_are_refused_by_name(fmus, kind, case):
    values, message = REFUSED[case]
    with pytest.raises(TwoDofError, match=re.escape(message)):
        run(fmus("slider", case[0], kind), 0.01, 0.01, **values)


# --- linear models ---


def test_the_discrete_loop_of_a_linear_model_has_the_eigenvalues_of_the_motion(fmus):
    """One linear model gives the plant with held effort, that of the continuous loop gives the law."""
    fmu, T = fmus("twodof", "joint", "fmi2"), 0.02
    at: dict = {"q_des": (0.5, 0.7), "Kp": 60.0, "Kd": 9.0}
    plant = linearise(fmu, {**at, "control_period": T, "control_delay": 0.03, **SEEN}, inputs=["tau_ext"])
    law = linearise(fmu, at, outputs=["tau"])
    assert plant.point["q[2]"] == pytest.approx(0.7, abs=1e-9)
    A, B, K = plant.A, plant.B, law.C
    held = linearise(fmu, {**at, "control_period": T}, inputs=["q_des"], outputs=["tau"])
    assert not held.B.any() and not held.C.any() and not held.D.any()
    moved = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 6))]]) * T)
    loop = moved[:4, :4] + moved[:4, 4:] @ K

    def after(y):
        start = {"q_start": tuple(y[:2]), "v_start": tuple(y[2:])}
        return run(fmu, T, T, **at, control_period=T, **start)[-1, :4]

    rest, nudge = np.array([0.5, 0.7, 0.0, 0.0]), 1e-5
    columns = [(after(rest + nudge * e) - after(rest - nudge * e)) / (2.0 * nudge) for e in np.eye(4)]
    found, expected = (np.sort_complex(np.linalg.eigvals(M)) for M in (np.array(columns).T, loop))
    assert np.abs(found - expected).max() < 1e-8
