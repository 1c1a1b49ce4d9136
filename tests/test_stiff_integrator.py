"""The integrator for stiff joints in both flavours, against Radau, the other integrator and order conditions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from friction_oracle import Rubbing
from harness import Driver, in_child_process
from native_models import Engine, engine, from_urdf, shipped
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from test_stiffness import radau

from twodof.plant import rosenbrock
from twodof.plant.damping import find_modes
from twodof.plant.dormand_prince import interpolant
from twodof.plant.plant import DiscardError, Plant
from twodof.plant.regime import AUTOMATIC, DORMAND_PRINCE, STIFF

STEP = 0.01
TIGHT = {"rtol": 1e-9, "atol": 1e-12}
PENDULUM = """<robot name="pendulum"><link name="base"/>
<link name="rod"><inertial><origin xyz="0.3 0 0"/><mass value="0.4"/>
<inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tip"><inertial><origin xyz="0.02 0 0"/><mass value="0.01"/>
<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="swing" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="0" velocity="0"/></joint>
<joint name="finger" type="revolute"><parent link="rod"/><child link="tip"/><origin xyz="0.6 0 0"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="0" velocity="0"/></joint></robot>"""


SLIDES = f"""<robot name="slides"><link name="base"/>{
    "".join(
        f'''<link name="l{i}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
</inertial></link><joint name="j{i}" type="prismatic"><parent link="{"base" if i == 1 else f"l{i - 1}"}"/>
<child link="l{i}"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="0" velocity="0"/></joint>'''
        for i in (1, 2, 3)
    )
}</robot>"""
"""Three slides of 1 kg in a row along x: M is constant."""


@pytest.fixture(scope="module")
def slides() -> Engine:
    return Engine(from_urdf(SLIDES, "l3", "x", "effort"))


@pytest.fixture(scope="module")
def pendulum() -> Engine:
    return Engine(from_urdf(PENDULUM, "tip", "xz", "effort"))


def started(of: Engine, integrator: int, **changes: object) -> Plant:
    plant = of.model.plant()
    for name, value in {"integrator": integrator, **changes}.items():
        setattr(plant, name, value)
    plant.initialise()
    return plant


def both(of: Engine, plant: Plant, steps: int, h: float = STEP) -> np.ndarray:
    """q and v after communication steps of the Python flavour, checked against the native one."""
    values = of.values(plant)
    for _ in range(steps):
        plant.step(h)
        assert of.call("advance", values, h) == 1
    found = np.array([*plant.q, *plant.v])
    native = np.concatenate([of.group(values, "q"), of.group(values, "v")])
    assert (np.abs(native - found) <= 1e-9 * np.maximum(1.0, np.abs(found))).all()
    return found


def evaluations(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> int:
    """Evaluations of the right-hand side in a communication step."""
    count, equations = [0], plant.equations_of_motion()

    def acceleration(*arguments):
        count[0] += 1
        return equations.acceleration(*arguments)

    monkeypatch.setattr(plant, "equations_of_motion", lambda: replace(equations, acceleration=acceleration))
    plant.step(STEP)
    return count[0]


def test_coefficients_satisfy_the_order_conditions_of_a_w_method_and_damp_stiff_modes():
    """Hairer & Wanner, "Solving ODEs II", IV.7: orders 3 and 2 with any T; R(∞) = 0."""
    g = rosenbrock.GAMMA
    lower = np.zeros((4, 4))
    coupling, a = lower.copy(), lower.copy()
    for i, (row, c) in enumerate(zip(rosenbrock.A, rosenbrock.C), start=1):
        a[i, :i], coupling[i, :i] = row, c
    gamma = np.linalg.inv(np.eye(4) / g - coupling)
    alpha, m = a @ gamma, np.array([*rosenbrock.A[-1], 1.0])
    b = m @ gamma
    ones, nodes = np.ones(4), alpha.sum(1)
    for weights, order in ((b, 3), ((m - rosenbrock.E) @ gamma, 2)):
        sums = [(weights @ ones, 1.0), (weights @ nodes, 1 / 2), (weights @ gamma @ ones, 0.0)]
        if order == 3:
            sums += [(weights @ nodes**2, 1 / 3), (weights @ alpha @ nodes, 1 / 6)]
            sums += [(weights @ x @ y @ ones, 0.0) for x, y in ((alpha, gamma), (gamma, alpha), (gamma, gamma))]
        assert [found for found, _ in sums] == pytest.approx([wanted for _, wanted in sums], abs=1e-13)
    assert 1.0 - b @ np.linalg.inv(alpha + gamma) @ ones == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("integrator", [AUTOMATIC, STIFF])
@pytest.mark.parametrize("damping", [0.1, 10.0, 600.0, 1e4, 1e6])
@pytest.mark.parametrize("v_start", [[0.0, 0.0], [0.5, -0.4]], ids=["at rest", "moving"])
def test_damped_arms_move_as_an_implicit_solver_says(v_start, damping, integrator):
    of, changes = engine("twodof"), {"damping": [damping] * 2, "v_start": v_start}
    expected = radau(shipped(of, **changes), STEP)
    found = both(of, shipped(of, **changes, integrator=integrator), 1)
    assert np.abs(found[:2] - expected).max() <= 1e-5


@pytest.mark.parametrize("damping", [[1e4, 1.2], [4e5, 0.3], [0.1, 1e5], [2e6, 1e-3]])
def test_a_decay_in_one_joint_moves_the_other_as_an_implicit_solver_says(damping):
    """While the stiff joint comes to rest, the other moves on; a step that damped the first moved it by 3e-4 rad."""
    of, changes = engine("twodof"), {"damping": damping, "v_start": [-0.6, -0.66]}
    found = both(of, shipped(of, **changes), 1)
    assert np.abs(found[:2] - radau(shipped(of, **changes), STEP)).max() <= 1e-5


@pytest.mark.parametrize("damping", [1.0, 10.0, 30.0, 100.0, 1e3, 1e5, 1e6])
@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_step_of_a_damped_arm_costs_few_evaluations(speed, damping, monkeypatch):
    undamped, damped = (shipped(engine("twodof"), damping=[D] * 2, v_start=[speed] * 2) for D in (0.0, damping))
    assert evaluations(damped, monkeypatch) <= 4 * evaluations(undamped, monkeypatch)


@pytest.mark.parametrize("damping", [1e4, 1e5, 1e6])
def test_velocities_that_vanish_within_a_short_time_cost_no_evaluations(damping, monkeypatch):
    """Integrating their decay took four times the evaluations. Afterwards the damping balances the controller."""
    changes = {"v_start": [0.5, 0.5]}
    undamped, damped = (shipped(engine("twodof"), damping=[D] * 2, **changes) for D in (0.0, damping))
    assert evaluations(damped, monkeypatch) <= evaluations(undamped, monkeypatch)
    assert damping * np.abs(damped.v).max() < 1.0


def mobility(q: np.ndarray) -> np.ndarray:
    """M⁻¹ of two rods in a row."""
    coupling = 0.5 * np.cos(q[0] - q[1])
    return np.linalg.inv([[1.0, coupling], [coupling, 0.26]])


def damped_rods(damping: np.ndarray, effort: float = 0.0):
    """ẏ of two rods that damping and an effort on both joints move."""

    def rates(y):
        return [*y[2:], *(mobility(np.array(y[:2])) @ (effort - damping * y[2:])).tolist()]

    return rates


def stiff_step(rates, damping: np.ndarray, y: list[float], h: float):
    """y after a step with exact decay of the modes, and the norm of its error."""
    M_inv = mobility(np.array(y[:2]))
    modes, k1 = find_modes(M_inv, damping), rates(y)

    def acceleration(at):
        return rates(at)[2:]

    decay = rosenbrock.settled(acceleration, modes, y, k1, h)
    y_new, K, norm, _ = rosenbrock.rosenbrock(rates, M_inv, damping, y, h, k1, 1e-3, 1e-6, decay)
    return y_new, max(norm, rosenbrock.unseen(acceleration, modes, y, K, y_new, h, 1e-3, 1e-6))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3, 1e6])
def test_the_decay_of_the_modes_is_that_of_the_matrix_exponential(scale):
    rng = np.random.default_rng(5)
    A = rng.normal(size=(4, 4))
    M_inv, damping = A @ A.T + 0.1 * np.eye(4), scale * np.array([1.0, 0.0, 1e-3, 30.0])
    v, a, t = rng.normal(size=4), scale * rng.normal(size=4), 1e-3
    modes = find_modes(M_inv, damping)
    T = np.zeros((9, 9))
    T[:4, 4:8], T[4:8, 4:8], T[:8, 8] = np.eye(4), -M_inv * damping, [*v, *a]
    change = expm(t * T)[:8, 8]
    found, rates = modes.decay(v, modes.VM @ a, t)
    assert np.abs(found - change).max() <= 1e-10 * np.abs(change).max()
    assert rates[4:] == pytest.approx((T @ [*change, 1.0])[4:8], abs=1e-10 * scale)
    assert rates[:4] == pytest.approx(v + change[4:], rel=1e-10)


def test_a_step_with_exact_decay_passes_only_if_its_error_is_within_the_tolerances():
    """The stages come after the decay of a fast mode, during which M changes."""
    rng, passed, h = np.random.default_rng(8), 0, 0.01
    for _ in range(200):
        damping = 10.0 ** np.array([rng.uniform(2, 4), rng.uniform(-2, 0)])
        y = [*rng.uniform(-3, 3, 2).tolist(), *(10.0 ** rng.uniform(-2, 1) * rng.uniform(-1, 1, 2)).tolist()]
        rates = damped_rods(damping)
        y_new, norm = stiff_step(rates, damping, y, h)
        if norm < 1.0:
            exact = solve_ivp(lambda _, y: rates(y), (0.0, h), y, "Radau", rtol=1e-9, atol=1e-12).y[:, -1]  # noqa: B023
            tolerances = 1e-6 + 1e-3 * np.maximum(np.abs(y), np.abs(y_new))
            assert np.linalg.norm((y_new - exact) / tolerances) / 2 < 1.0, (damping, y)
            passed += 1
    assert passed > 30


def test_a_step_with_exact_decay_is_of_third_order():
    damping, y = np.array([3.0, 5.0]), [0.2, 0.9, 1.0, -2.0]
    rates, errors = damped_rods(damping, effort=2.0), []
    for h in (0.004, 0.002, 0.001):
        exact = solve_ivp(lambda _, y: rates(y), (0.0, h), y, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
        errors.append(np.abs(stiff_step(rates, damping, y, h)[0] - exact).max())
    assert errors[0] / errors[1] > 12 and errors[1] / errors[2] > 12, errors


@pytest.mark.parametrize("rigid", [False, True], ids=["clamp", "rigid"])
def test_a_joint_that_a_decay_pushes_to_its_limit_and_back_stops_there(rigid, slides):
    """One fast mode pushes the slide out, and another one back, both within an integration step."""
    changes = {"damping": [3274.68, 17.0457, 66057.8], "v_start": [-3.61686, 0.0, 4.03041]}
    changes |= {"q_start": [0.0] * 3, "gravity": [0.0] * 3}
    free = started(slides, AUTOMATIC, **changes)
    turn = 0.0
    for _ in range(10):
        free.step(1e-4)
        turn = max(turn, free.q[1])
    assert free.q[1] < 0.0 < 1.9e-4 < turn
    changes |= {"q_max": [1.0, 1e-4, 1.0], "rigid_stops": rigid}
    one, other = (both(slides, started(slides, i, **changes), 1) for i in (AUTOMATIC, DORMAND_PRINCE))
    assert one[:3] == pytest.approx(other[:3], abs=1e-5)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("integrator", [AUTOMATIC, STIFF])
@pytest.mark.parametrize("speed", [1e100, 1e154, 1e200])
def test_a_motion_that_is_not_finite_is_refused(speed, integrator, pendulum):
    plant = started(pendulum, integrator, v_start=[speed, speed], damping=[1.0, 1.0])
    values = pendulum.values(plant)
    with pytest.raises(DiscardError, match="not finite"):
        plant.step(STEP)
    assert pendulum.call("advance", values, STEP) == 0
    assert (pendulum.group(values, "v") == speed).all() and plant.v == [speed, speed]


@pytest.mark.parametrize("damping", [0.0, 0.1, 0.5])
def test_joints_that_are_not_stiff_move_as_by_dormand_prince_bit_for_bit(damping):
    of, changes = engine("twodof"), {"damping": [damping] * 2}
    one, other = (both(of, shipped(of, **changes, integrator=i), 20) for i in (AUTOMATIC, DORMAND_PRINCE))
    assert (one == other).all()


def test_the_error_falls_with_the_third_power_of_the_step(pendulum):
    """A stiff finger is on a pendulum; the tolerance accepts all steps."""
    errors = []
    changes = {"damping": [0.0, 0.05], "q_start": [0.3, 0.2], "v_start": [1.0, 0.0], "gravity": [0.0, 0.0, -9.81]}
    reference = both(pendulum, started(pendulum, DORMAND_PRINCE, **changes, rtol=1e-11, atol=1e-13), 1, 0.2)
    for max_step in (0.02, 0.01, 0.005):
        plant = started(pendulum, STIFF, **changes, rtol=10.0, atol=10.0, max_step=max_step)
        errors.append(abs(both(pendulum, plant, 1, 0.2)[0] - reference[0]))
    assert errors[0] / errors[1] > 6.0 and errors[1] / errors[2] > 6.0, errors


@pytest.mark.parametrize("rigid", [False, True], ids=["clamp", "rigid"])
@pytest.mark.parametrize("friction", [[0.0, 0.0], [0.2, 1e-4]], ids=["smooth", "friction"])
def test_stops_and_friction_are_those_of_the_other_integrator(pendulum, rigid, friction):
    """The pendulum falls onto its stop, and the finger moves between its own, at tight tolerances."""
    ends = []
    for integrator in (DORMAND_PRINCE, STIFF):
        plant = started(
            pendulum,
            integrator,
            **TIGHT,
            q_min=[-1.0, -0.1],
            q_max=[0.6, 0.1],
            v_start=[0.5, -3.0],
            damping=[0.01, 1e-4],
            friction=friction,
            rigid_stops=rigid,
            tau_cmd=[0.0, 1e-3],
        )
        path = [both(pendulum, plant, 4) for _ in range(10)]
        ends.append(np.array(path))
    stopped = np.isin(ends[0][:, :2], [0.6, 0.1, -0.1, -1.0])
    assert stopped[:, 0].any() and (stopped[:, 1].any() or any(friction))
    assert np.abs(ends[0] - ends[1]).max() <= 1e-6


@pytest.mark.parametrize("max_step", [1e-3, 5e-3])
@pytest.mark.parametrize("stop", [1.0, 0.2801], ids=["friction", "stop"])
def test_a_stiff_joint_comes_to_rest_where_its_motion_ends(stop, max_step, pendulum):
    """Its velocity decays within microseconds, so it moves by 5e-7 rad. An integration step of max_step is too long."""
    efforts, changes = [0.6, -0.006], {"damping": [0.0, 6.0], "friction": [0.0, 2.5e-4], "q_max": [2.0, stop]}
    changes |= {"q_start": [-0.07, 0.28], "v_start": [0.2, 0.5], "gravity": [0.0, 0.0, -9.81], "tau_cmd": efforts}
    found = both(pendulum, started(pendulum, AUTOMATIC, **changes, max_step=max_step), 1)
    model = pendulum.model.robot.model.copy()
    model.gravity.linear = np.array(changes["gravity"])
    given = (changes["friction"], changes["damping"], [0.0, 0.0], [-2.0, -1.0], changes["q_max"])
    oracle = Rubbing(model, lambda *_: np.array(efforts), *map(np.array, given))
    exact = oracle.run(changes["q_start"], changes["v_start"], [STEP])[0][-1]
    assert np.abs(found[:2] - exact[:2]).max() <= 1e-5


def test_a_stiff_joint_rests_on_its_stop_and_leaves_it(pendulum):
    """Dormand–Prince agrees with many more steps; M⁻¹D is 1e5 1/s."""
    changes = {"damping": [0.1, 0.5], "q_max": [2.0, 0.01], "q_start": [0.0, 0.0], "friction": [0.01, 0.02], **TIGHT}
    plants = [started(pendulum, i, **changes) for i in (AUTOMATIC, DORMAND_PRINCE)]
    for effort in (3.0, 0.01, -1.5):
        for plant in plants:
            plant.tau_cmd = [0.1, effort]
        one, other = (both(pendulum, plant, 2, 0.005) for plant in plants)
        assert np.abs(one - other).max() <= 1e-7
        if effort > 0.0:
            assert one[1] == 0.01 and one[3] == 0.0
    assert one[1] < 0.01


def test_samples_of_a_controller_are_taken_at_their_times(pendulum):
    """A sampled joint controller applies a sawtooth of efforts to stiff joints."""
    of = Engine(from_urdf(PENDULUM, "tip", "xz", "joint"))
    changes = {"damping": [0.5, 0.05], "control_period": 0.004, "control_delay": 0.0013, "q_des": [0.4, -0.3]}
    tight = both(of, started(of, DORMAND_PRINCE, **changes, **TIGHT), 1, 6 * STEP)
    for integrator in (AUTOMATIC, STIFF):
        assert both(of, started(of, integrator, **changes), 1, 6 * STEP)[:2] == pytest.approx(tight[:2], abs=1e-5)
        plant = started(of, integrator, **changes)
        for _ in range(6):
            plant.step(STEP)
        assert plant.q == pytest.approx(tight[:2], abs=1e-5)


@in_child_process
@pytest.mark.parametrize("damping", [0.1, 1e4])
def test_a_restored_fmu_continues_bit_for_bit_in_both_flavours(damping, fmu_path, native_path):
    """It equals an FMU that did all steps, with either choice of the automatic integrator."""
    runs = []
    for path in (fmu_path, native_path):
        driver = Driver(path).initialise(damping=[damping] * 2, friction=[0.05, 0.0], q_max=[0.51, 3.0])
        driver.run(2)
        blob = driver.call("serializeFMUState", driver.call("getFMUState"))
        runs.append(driver.run(4, start=2))
        driver.call("reset")
        driver.initialise()
        driver.call("setFMUState", driver.call("deSerializeFMUstate", blob))
        assert driver.run(4, start=2) == runs[-1]
        driver.free()
    assert np.array(runs[0]) == pytest.approx(np.array(runs[1]), abs=1e-9, rel=1e-9)


def test_dense_output_is_of_third_order_and_velocities_begin_with_the_acceleration():
    """SciPy solves a damped oscillator from rest."""

    def rates(y):
        return [y[1], -40.0 * y[0] - 3.0 * y[1]]

    y, worst = [0.7, 0.0], []
    exact = solve_ivp(lambda t, y: rates(y), (0, 0.1), y, "DOP853", rtol=1e-12, atol=1e-14, dense_output=True).sol
    for h in (0.04, 0.02):
        y_new, K, *_ = rosenbrock.rosenbrock(rates, np.eye(1), np.array([3.0]), y, h, rates(y), 1e-3, 1e-6)
        state = interpolant(y, y_new, K, rosenbrock.CUBIC, h)
        worst.append(np.max([np.abs(np.subtract(state(t), exact(t))) for t in np.linspace(0.0, h, 9)], axis=0))
        assert (state(1e-9 * h)[1] - y[1]) / (1e-9 * h) == pytest.approx(rates(y)[1], rel=1e-6)
    assert (worst[0] > 6.0 * worst[1]).all() and (worst[1] < 3e-4).all()
