"""Parts of an error by the balance of forces, against closed forms, Pinocchio, and runs without one of two causes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from failures import LARGE_STEPS, fmu_of
from page_causes import page_causes
from pytest import approx

import twodof
from twodof.geometry.dynamics import Dynamics
from twodof.plant.mechanism import Mechanism
from twodof.plant.robot import load_robot
from twodof.plant.urdf import read_urdf
from twodof.simulation.balance import UNKNOWN, parts_of_error
from twodof.simulation.judge import Judge
from twodof.simulation.setup import robot_of, setup, setup_of
from twodof.simulation.verdict import judged

AWAY: dict[str, Any] = {"q_des": (0.9, 0.8)}
COARSE = {"control_period": 0.001, "q_resolution": (0.05, 0.05), "v_from_q": True}
HELD = {"limit_effort": True, "payload": 6.0, "payload_known": True}


class Kept(twodof.Sink):
    """The run and its samples."""

    def begin(self, run: twodof.Experiment) -> Kept:
        self.run, self.samples = run, list[twodof.Sample]()
        return self

    def write(self, sample: twodof.Sample) -> None:
        self.samples.append(sample)


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> list[dict[tuple[str, str], float]]:
    """Collect the parts of each run of the test."""
    found: list[Any] = []

    def spy(*arguments: Any) -> Any:
        made = parts_of_error(*arguments)
        found.append(made.of)
        return made

    monkeypatch.setattr("twodof.simulation.balance.parts_of_error", spy)
    return found


def verdict(control: str, stop_time: float = 5.0, **settings: Any) -> twodof.Verdict:
    return twodof.simulate(fmu_of("arm", control), settings={**LARGE_STEPS, **settings}, stop_time=stop_time).verdict


FIRST = [
    ("task", {"payload": 0.3, "xdd_des": (0.0, 1e-6)}, 5.0, "the payload of 0.3 kg"),
    ("joint", {"payload": 0.3, "q_des": (0.9, 3.1416)}, 5.0, "the payload of 0.3 kg"),
    ("joint", {**AWAY, "q_max": (3.0, 0.78), "friction": (0.5, 0.2)}, 5.0, "sticks"),
    ("joint", {**AWAY, **HELD, "friction": 1e-4}, 5.0, "was saturated"),
    ("task", {"friction": (0.5, 0.0)}, 5.0, "joint 'joint1' creeps: its friction of 0.5 N·m slows it down"),
    ("task", {"friction": (0.5, 0.0), "payload": 1e-4}, 5.0, "friction of 0.5 N·m"),
    ("task", {"f_ext": (0.0, 0.0, 10.0), "q_min": (-0.2, -3.0)}, 5.0, "'joint1' stood at its lower limit"),
    ("joint", {**AWAY, "Kp": 50.0, "Kd": 7.07}, 0.4, "has not settled: with these gains"),
    ("task", {"Kp": 20.0, "Kd": 2.0, "payload": 0.001}, 0.5, "has not settled"),
    ("joint", {**AWAY, "friction": (0.01, 0.005), "payload": 0.3}, 5.0, "the payload of 0.3 kg"),
    ("joint", {**AWAY, "friction": (0.05, 0.02), "payload": 0.002}, 5.0, "friction of 0.0"),
    ("joint", {**AWAY, "a_des": (20.0, 0.0), "payload": 0.3}, 5.0, "the payload of 0.3 kg"),
    ("task", {"q_min": (-0.2, -3.0), "payload": 0.002}, 5.0, "'joint1' stood at its lower limit"),
    ("task", {"Kp": 5.0, "damping": 0.05}, 5.0, "still approaches"),
    ("task", {"tau_ext": (0.0, 0.3)}, 5.0, r"does not know tau_ext[2] (of joint 'joint2') = 0.3 N·m"),
    ("joint", {**AWAY, "q_max": (0.6, 3.0), "tau_ext": (0.2, 0.0)}, 5.0, "'joint1' is out of reach by 0.3 rad"),
    ("task", {"x_des": (0.6, 0.05), "payload": 0.1}, 5.0, "the target is out of reach by"),
    ("joint", {**AWAY, "Kp": 0.0, "Kd": 50.0, "control_period": 0.02}, 5.0, "Kp = 0: the controller"),
    ("joint", {**AWAY, "q_max": (3.0, 0.7848), "control_period": 0.01, "q_resolution": 0.0186}, 5.0, "out of reach by"),
    ("task", {"x_des": (0.368, 0.05), "Kp": 1.29, "Kd": 20.0}, 5.0, "and other causes keep an error"),
    ("joint", {**AWAY, "f_ext": (0.0, -0.03, 0.0)}, 2.0, "and other causes keep an error"),
    ("task", {"Kp": (2.0, 50.0)}, 1.5, "with a time constant of 20 s"),
    ("task", {"Kp": (0.0, 50.0), "control_period": 0.06}, 5.0, "unstable"),
    ("joint", {**AWAY, **COARSE, "tau_ext": (0.03, 0.0)}, 5.0, "q_resolution"),
    ("task", {"x_des": (0.297, 0.07), "Kp": 5.0}, 5.0, "still approaches"),
    ("joint", {**AWAY, "control_period": 0.01, "q_resolution": 0.05}, 5.0, "does not see smaller errors"),
    ("joint", {**AWAY, "Kd": 0.3, "control_period": 0.01}, 5.0, "damps Kp = 50 s⁻² too little"),
    ("task", {"Kd": 1.5, "x_des": (0.4, 0.3)}, 5.0, "out of reach by 0.2 m"),
    ("task", {"Kd": 1.5, "control_period": 0.06}, 5.0, "at its limit of stability"),
    ("joint", {**AWAY, "Kp": 16.0, "Kd": 8.0, "control_period": 0.01, "control_delay": 0.08}, 5.0, "control_delay"),
]


@pytest.mark.parametrize(("control", "settings", "stop_time", "words"), FIRST, ids=[str(k) for k in range(len(FIRST))])
def test_the_first_cause_is_the_one_without_which_the_error_is_smallest(
    control: str, settings: dict[str, Any], stop_time: float, words: str
) -> None:
    assert words in verdict(control, stop_time, **settings).lines[0]


def test_parts_of_loads_are_those_of_the_linear_balance(parts: list[dict[tuple[str, str], float]]) -> None:
    """Under joint control e = Kp⁻¹ M⁻¹ Σ d, with d = Jᵀ m g of a payload, and minus an external effort."""
    settings: dict[str, Any] = {**AWAY, "payload": 0.1, "tau_ext": (0.05, 0.02), "Kp": 400.0, "Kd": 40.0}
    kept: list[twodof.Sample] = [*twodof.samples(fmu_of("arm", "joint"), settings=settings, stop_time=5.0)]
    fmu = twodof.load_fmu(fmu_of("arm", "joint"))
    model = pin.buildModelFromXML(fmu.urdf)
    q, frame = np.array(kept[-1].q), model.getFrameId(fmu.frame)
    data = model.createData()
    M = pin.crba(model, data, q)
    M = np.triu(M) + np.triu(M, 1).T
    J = pin.computeFrameJacobian(model, data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:3]
    gravity = np.array([fmu.start_values[f"gravity[{i}]"] for i in (1, 2, 3)], float)
    loads = {"payload": -J.T @ (0.1 * gravity), "tau_ext": -np.array([0.05, 0.02])}
    terms = {name: np.linalg.solve(M, load) / 400.0 for name, load in loads.items()}
    e = np.array(AWAY["q_des"]) - q
    np.testing.assert_allclose(sum(terms.values()), e, rtol=1e-3)
    verdict("joint", **settings)
    for name, term in terms.items():
        assert parts[-1]["load", name] == approx(term @ e / (e @ e), abs=2e-3)
    assert sum(parts[-1].values()) == approx(1.0, abs=1e-9)


def test_a_stuck_joint_has_the_part_that_the_controller_asks_of_it(parts: list[dict[tuple[str, str], float]]) -> None:
    """The reaction of friction is M Kp e where gravity is known and nothing moves."""
    made = verdict("joint", q_des=(0.5, 0.36), friction=(5.0, 5.0))
    assert parts[-1]["friction", "joint1"] + parts[-1]["friction", "joint2"] == approx(1.0, abs=1e-6)
    assert made.causes[0].part == approx(1.0, abs=1e-6)


def test_a_cause_that_is_first_by_a_rule_has_no_part() -> None:
    root = verdict("task", tau_ext=(0.0, 0.3)).causes[0]
    assert (root.kind, root.part) == ("load", None)


def test_friction_that_holds_two_joints_is_first_beside_a_load_that_it_balances() -> None:
    """Without the friction of joint2 the arm reaches."""
    made = verdict("joint", **AWAY, friction=(0.1, 0.05), tau_ext=(0.1, 0.0))
    assert [cause.kind for cause in made.causes] == ["friction"] * len(made.causes)
    assert verdict("joint", **AWAY, friction=(0.1, 0.0), tau_ext=(0.1, 0.0)).numbers["final_joint_error"] < 0.2


@pytest.mark.parametrize("more", [{"Kp[3]": 1.0}, {"Kd[2]": None}, {"xdd_des[2]": None}])
def test_gains_that_are_not_those_of_the_error_have_no_balance(more: dict[str, float | None]) -> None:
    """A forged or third-party bag may have any number of them."""
    run = twodof.experiment(fmu_of("arm", "task"), settings={"payload": 0.3}, stop_time=0.1)
    made = setup_of(run.fmu, robot_of(run.fmu.urdf), run.step, run.start_values)
    starts = {name: value for name, value in {**made.starts, **more}.items() if value is not None}
    judge = Judge(made._replace(starts=starts), [2, 2, 2, 2, 0])
    judge.judge(np.array([0.0, run.step]), np.full((2, 8), 0.1), judge.targets)
    assert parts_of_error(judge, ["x"]) == UNKNOWN


def test_a_distance_that_overflows_is_not_reached() -> None:
    target = {"x": np.full((9, 1), 1e200)}
    t, q = np.arange(9.0), np.zeros((9, 1))
    values = {"q": q, "v": q, "x": q, "tau": q[:, :0], "quat": q[:, :0]}
    facts = setup(joints=("j",), robot=None, frame="", axes="x", step=1.0, starts={})
    assert judged(facts, t, values, target).outcome == "not reached"


def test_small_causes_are_not_named_and_others_with_their_parts() -> None:
    lines = str(verdict("joint", **AWAY, payload=0.05, tau_ext=(0.06, 0.0)))
    assert lines.count("% of the error)") == 2
    assert "payload" not in str(verdict("joint", **AWAY, payload=1e-5, tau_ext=(0.06, 0.0)).lines[:2])


def test_a_run_of_unknown_forces_has_its_causes_by_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twodof.simulation.balance.parts_of_error", lambda *_: UNKNOWN)
    found = verdict("joint", **AWAY, payload=0.3).causes
    assert [cause.kind for cause in found] == ["load"] and found[0].part is None


@pytest.mark.parametrize("name", ["gravity", "armature", "payload_com"])
def test_a_parameter_that_the_controller_of_a_system_has_otherwise_is_named(name: str, tmp_path: Path) -> None:
    system = twodof.build_fmu(tmp_path / "arm.ssp", twodof.FmuOptions(native=True, part="split"))
    values = {"gravity": (0.0, 0.0, 0.0), "armature": (0.5, 0.5), "payload_com": (0.2, 0.0, 0.0)}[name]
    more = {"plant.payload": 0.3, "controller.payload": 0.3, "controller.payload_known": True}
    settings = {f"plant.{name}": values, **(more if name == "payload_com" else {})}
    line = twodof.simulate(system, settings=settings).verdict.lines[0]
    assert f"the controller's model has {name} = " in line and f"set controller.{name}" in line


@pytest.mark.parametrize("recovered", [False, True])
def test_an_input_that_changed_late_is_named(recovered: bool, tmp_path: Path) -> None:
    """Also in a bag without a stored verdict."""
    changes = [(1.0, {"tau_ext[1]": 1.0}), (4.8, {"tau_ext[1]": 0.0})]
    bag = twodof.Bag(tmp_path / "bag")
    made = twodof.simulate(fmu_of("arm", "joint"), bag, settings={**LARGE_STEPS, **AWAY}, changes=changes).verdict
    if recovered:
        run = twodof.read_bag(tmp_path / "bag")
        made = run._judged(run.setup, run.x, run.target if run.x.size else run.x)
    assert "tau_ext[1] changed from 1 to 0 at 4.8 s" in made.lines[0]


@pytest.mark.parametrize(
    ("settings", "rows", "words"),
    [
        ({"Kp": 5.0}, [(4.9, {"v_des[1]": 1e-4})], "still approach their targets, with a time constant of 7.97 s"),
        ({}, [(0.01 * k, {"tau_ext[1]": 0.3 * np.sin(0.06 * k)}) for k in range(1, 500)], "does not know tau_ext"),
        ({"Kp": 0.0}, [(4.8, {"Kp[1]": 50.0, "Kp[2]": 50.0})], "Kp[1] changed from 0 to 50 at 4.8 s"),
    ],
)
def test_a_late_change_is_a_cause_only_if_it_ended_one(settings: Any, rows: Any, words: str) -> None:
    made = twodof.simulate(fmu_of("arm", "joint"), settings={**LARGE_STEPS, **AWAY, **settings}, changes=rows).verdict
    assert words in made.lines[0]


def test_a_direction_without_a_gain_shares_its_error_with_the_force_that_moves_it() -> None:
    lines = verdict("joint", **AWAY, Kp=0.0, f_ext=(0.0, -0.93, 0.0)).lines
    assert "does not know f_ext" in lines[0] and lines[1].startswith("also Kp = 0")


def test_a_gain_that_changed_is_the_present_one_in_a_bag_without_a_verdict(tmp_path: Path) -> None:
    twodof.simulate(
        fmu_of("arm", "joint"), twodof.Bag(tmp_path / "bag"), settings={**LARGE_STEPS, **AWAY},
        changes=[(0.2, {"Kp[1]": 0.0, "Kp[2]": 0.0})],
    )  # fmt: skip
    run = twodof.read_bag(tmp_path / "bag")
    assert "Kp = 0: the controller" in run._judged(run.setup, run.x, run.target if run.x.size else run.x).lines[0]


def test_a_bag_of_an_impossible_gravity_has_a_verdict(tmp_path: Path) -> None:
    """Rounding makes its mass matrix singular, and its error has no known parts."""
    bag = tmp_path / "bag"
    twodof.simulate(fmu_of("arm", "task"), twodof.Bag(bag), settings={"gravity": (0.0, -9.81, 0.0)}, stop_time=1.0)
    run = json.loads((bag / "run.json").read_text())
    run["start_values"]["gravity[1]"] = 1e30
    (bag / "run.json").write_text(json.dumps({**run, "verdict": None}))
    assert twodof.read_bag(bag).verdict.outcome == "not reached"


def test_a_joint_without_limits_may_turn_further_than_once() -> None:
    unbounded = 1.7976931348623157e308
    free: dict[str, Any] = {"q_min": (-unbounded, -3.0), "q_max": (unbounded, 3.0)}
    assert not verdict("joint", q_des=(7.0, 0.8), **free).causes
    assert "did you mean 90°" in verdict("joint", 20.0, q_des=(90.0, 0.8), **free).lines[0]


@pytest.mark.parametrize("robot", ["arm", "panda", "so100"])
def test_the_inverse_dynamics_of_a_page_are_those_of_pinocchio(robot: str) -> None:
    kept = Kept()
    offset: dict[str, Any] = {"payload_com": (0.02, 0.05, -0.03), "gravity": (1.0, 2.0, -9.0), "armature": 0.02}
    twodof.simulate(fmu_of(robot, "joint"), kept, settings={**LARGE_STEPS, **offset}, stop_time=0.02)
    fmu = twodof.load_fmu(fmu_of(robot, "joint"))
    assert fmu.urdf is not None
    model = load_robot(fmu.urdf, fmu.frame, "xyz")
    n = len(model.joints)
    real = Mechanism(model, offset["gravity"], 0.7, offset["payload_com"], [0.02] * n)
    q, v, a = np.random.default_rng(1).uniform(-1.0, 1.0, (3, n))
    vectors = [each.tolist() for each in (q, v, a)]
    found = page_causes(kept.run, kept.samples, "dynamics", *vectors, 0.7)
    np.testing.assert_allclose(found["tau"], real.inverse_dynamics(q, v, a), rtol=1e-9, atol=1e-12)
    mass = page_causes(kept.run, kept.samples, "mass", q.tolist(), 0.7)
    np.testing.assert_allclose(mass, real.mass_matrix(q), rtol=1e-9, atol=1e-12)
    still = page_causes(kept.run, kept.samples, "dynamics", *vectors[:2], [0.0] * n, 0.7)
    drift = real.observe(q, v)[2]
    np.testing.assert_allclose([*still["acceleration"], *still["turning"]], drift, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("control", "settings"), [row[:2] for row in FIRST if row[2] > 1.0])
def test_a_page_names_the_same_first_cause(control: str, settings: dict[str, Any]) -> None:
    """Unless the error only needs less time than a page waits."""
    kept = Kept()
    made = twodof.simulate(fmu_of("arm", control), kept, settings={**LARGE_STEPS, **settings}).verdict
    found = page_causes(kept.run, kept.samples)
    assert made.causes[0].kind in ("time", found[0]["kind"] if found else "")


@pytest.mark.parametrize("robot", ["arm", "panda", "so100", "kinova"])
def test_the_dynamics_of_the_verdict_are_those_of_pinocchio(robot: str) -> None:
    fmu = twodof.load_fmu(fmu_of(robot, "joint"))
    assert fmu.urdf is not None
    model = load_robot(fmu.urdf, fmu.frame, "xyz")
    n = len(model.joints)
    constants = ((1.0, 2.0, -9.0), 0.7, (0.02, 0.05, -0.03), [0.02] * n)
    real, made = Mechanism(model, *constants), Dynamics(read_urdf(fmu.urdf), model.joints, fmu.frame, *constants)
    for q, v, a in np.random.default_rng(2).uniform(-1.0, 1.0, (5, 3, n)):
        np.testing.assert_allclose(
            made.inverse_dynamics(q, v, a), real.inverse_dynamics(q, v, a), rtol=1e-9, atol=1e-11
        )
        np.testing.assert_allclose(made.mass_matrix(q), real.mass_matrix(q), rtol=1e-9, atol=1e-11)
        seen, (x, jacobian, drift) = made.observe(q, v), real.observe(q, v)
        np.testing.assert_allclose(seen.position, x, atol=1e-12)
        np.testing.assert_allclose(seen.rotation, real.rotation, atol=1e-12)
        np.testing.assert_allclose(seen.jacobian, jacobian, atol=1e-12)
        np.testing.assert_allclose(seen.drift, drift, rtol=1e-9, atol=1e-11)
