"""Control laws, payload, forces and rigid stops in both flavours, against independent results."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from native_models import deviation, engine, loaded, model, random_plant
from scipy.integrate import solve_ivp

import twodof
from twodof.export.fmu_options import FmuOptions
from twodof.export.package import build_fmu

CONTROLS = ("task", "pose", "joint", "effort")


DRIVEN = ("q_des", "v_des", "a_des", "tau_cmd", "x_des", "xd_des", "quat_des", "omega_des", "alpha_des")


@pytest.mark.parametrize("name", ["twodof", "ur5", "panda"])
@pytest.mark.parametrize("control", CONTROLS)
def test_both_flavours_have_the_same_accelerations_and_efforts(name, control):
    native, rng = engine(name, control), np.random.default_rng(2)
    for limit_effort, known in product((False, True), repeat=2):
        for _ in range(15):
            plant = random_plant(name, control, rng)
            plant.limit_effort, plant.payload_known = limit_effort, known
            for group in DRIVEN:
                if hasattr(plant, group):
                    setattr(plant, group, rng.normal(0, 1, len(getattr(plant, group))).tolist())
            plant.prepare()
            values, a = native.values(plant), np.empty(native.n)
            native.call("acceleration", values, a)
            q, v = np.array(plant.q), np.array(plant.v)
            assert deviation(a, plant.equations_of_motion().acceleration(q, v, None, [0] * native.n)[0]) <= 1e-9
            native.call("outputs", values)
            assert deviation(native.group(values, "tau"), plant.tau) <= 1e-10
            assert deviation(native.group(values, "xd"), plant.xd) <= 1e-12


@pytest.fixture(scope="module")
def fmus(tmp_path_factory) -> dict[tuple[str, bool], Path]:
    folder = tmp_path_factory.mktemp("controls")
    return {
        (control, native): build_fmu(folder / f"{control}{native}.fmu", FmuOptions(control=control, native=native))
        for control in CONTROLS
        for native in (False, True)
    }


def trajectory(fmu: Path, **options) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    run = [(s.t, s.q, s.v) for s in twodof.samples(fmu, **options)]
    t, q, v = zip(*run)
    return np.array(t), np.array(q), np.array(v)


TIGHT = {"rtol": 1e-10, "atol": 1e-12}


@pytest.mark.parametrize("native", [False, True])
def test_joint_control_obeys_its_closed_form(fmus, native):
    """ë + Kd ė + Kp e = 0 in each joint, by the matrix exponential."""
    goal, Kp, Kd = (0.9, -0.8), (60.0, 30.0), (12.0, 14.0)
    settings = {"q_des": goal, "Kp": Kp, "Kd": Kd, "payload": 0.4, "payload_known": True, **TIGHT}
    t, q, _ = trajectory(fmus["joint", native], stop_time=1.0, settings=settings)
    from scipy.linalg import expm

    for i, start in enumerate((0.5, 0.35)):
        A = np.array([[0.0, 1.0], [-Kp[i], -Kd[i]]])
        e = [(expm(A * k) @ [goal[i] - start, 0.0])[0] for k in t]
        np.testing.assert_allclose(goal[i] - q[:, i], e, atol=1e-9)


@pytest.mark.parametrize("native", [False, True])
@pytest.mark.parametrize("control", CONTROLS)
def test_unknown_payload_against_an_independent_integration(fmus, control, native):
    settings = {"payload": 0.05, "payload_com": (0.02, -0.03, 0.01), "f_ext": (0.1, 0.2, 0.0)}
    if control == "effort":
        settings["tau_cmd"] = (0.8, 0.2)
    if control == "pose":
        settings["quat_des"] = (0.0, 0.0, 0.3, 0.9)
    plant = model("twodof", control).plant()
    for name, value in settings.items():
        setattr(plant, name, list(value) if isinstance(value, tuple) else value)
    known, unknown = plant.robot.model.copy(), loaded(plant)
    known.gravity.linear = unknown.gravity.linear
    data, truth, frame = known.createData(), unknown.createData(), plant.robot.frame_id

    def law(q, v):
        if control == "effort":
            return np.array(plant.tau_cmd)
        pin.forwardKinematics(known, data, q, v, np.zeros(2))
        rows = [0, 1, 3, 4, 5] if control == "pose" else [0, 1]
        J = pin.computeFrameJacobian(known, data, q, frame, pin.LOCAL_WORLD_ALIGNED)[rows]
        drift = pin.getFrameClassicalAcceleration(known, data, frame, pin.LOCAL_WORLD_ALIGNED)
        if control in ("task", "pose"):
            error = plant.x_des - data.oMf[frame].translation[:2]
            if control == "pose":
                goal = pin.Quaternion(np.array(plant.quat_des)).normalized().matrix()
                error = np.r_[error, pin.log3(goal @ data.oMf[frame].rotation.T)]
            command = 50.0 * error - 40.0 * J @ v - drift.vector[rows]
            return pin.rnea(known, data, q, v, np.linalg.pinv(J) @ command)
        return pin.rnea(known, data, q, v, 50.0 * (plant.q_des - q) - 40.0 * v)

    def derivative(_, y):
        q, v = y[:2], y[2:]
        J = pin.computeFrameJacobian(unknown, truth, q, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
        effort = law(q, v) + J.T @ plant.f_ext
        return np.r_[v, pin.aba(unknown, truth, q, v, effort)]

    t, q, v = trajectory(fmus[control, native], stop_time=0.2, settings={**settings, **TIGHT})
    y = solve_ivp(derivative, (0, 0.2), [*q[0], *v[0]], "DOP853", t, rtol=1e-12, atol=1e-14).y.T
    np.testing.assert_allclose(np.c_[q, v], y, atol=1e-9)


@pytest.mark.parametrize("native", [False, True])
def test_energy_of_the_free_plant_is_kept(fmus, native):
    """Without effort, damping and stops; kinetic and potential energy are by Pinocchio."""
    settings = {"q_max": 1e3, "q_min": -1e3, "rtol": 1e-12, "atol": 1e-13, "max_step": 0.1}
    _, q, v = trajectory(fmus["effort", native], stop_time=10, settings=settings)
    plant = model("twodof").plant()
    reference = plant.robot.model.copy()
    reference.gravity.linear = np.array(plant.gravity)
    data = reference.createData()
    energy = [
        pin.computeKineticEnergy(reference, data, a, b) + pin.computePotentialEnergy(reference, data, a)
        for a, b in zip(q, v)
    ]
    assert np.ptp(energy) <= 1e-9 * max(map(abs, energy))


# --- rigid stops ---


@pytest.mark.parametrize("control", CONTROLS)
def test_stops_do_not_depend_on_the_step_or_the_flavour(fmus, control):
    """An alternating input stops and releases joints at several limits."""
    settings = {"q_min": (0.2, 0.1), "q_max": (0.7, 0.5), "rigid_stops": True, **TIGHT}
    table = {
        "task": ("x_des", [(0.1, 0.25), (0.28, 0.05), (0.2, 0.15)]),
        "pose": ("x_des", [(0.1, 0.25), (0.28, 0.05), (0.2, 0.15)]),
        "joint": ("q_des", [(1.0, 1.0), (0.0, 0.7), (0.4, 0.0)]),
        "effort": ("tau_cmd", [(3.0, 1.0), (-1.0, 1.0), (2.0, -1.0)]),
    }
    group, values = table[control]
    if control != "effort":
        settings |= {"Kp": 400.0, "Kd": 20.0}
    trajectories = []
    for native, step in ((True, 0.01), (True, 0.002), (False, 0.01)):
        changes = dict(zip((0.0, 0.2, 0.4), values))
        run = twodof.samples(
            fmus[control, native], step=step, stop_time=0.6, settings={**settings, group: changes[0.0]}
        )
        states = []
        sample = next(run)
        while True:
            if round(sample.t / 0.01, 6).is_integer():
                states.append(sample.q + sample.v)
            due = [value for t, value in changes.items() if abs(t - sample.t) < 1e-9]
            try:
                sample = run.send({group: due[0]} if due else None)
            except StopIteration:
                break
        trajectories.append(np.array(states))
    at_stops = (trajectories[0][:, :2] == [0.7, 0.5]).any() and (trajectories[0][:, :2] == [0.2, 0.1]).any()
    assert at_stops
    size = np.maximum(1.0, np.abs(trajectories[0]))  # joints are thrown at up to 200 rad/s
    assert (np.abs(trajectories[0] - trajectories[1]) / size).max() <= 1e-6
    assert (np.abs(trajectories[0] - trajectories[2]) / size).max() <= 1e-9


@pytest.mark.parametrize("control", CONTROLS)
def test_flavours_are_equal_with_limits_of_all_kinds_and_a_force(fmus, control):
    """Joints are stopped, efforts saturated, with an external force and an unknown payload."""
    settings = {
        "q_min": (0.2, 0.1),
        "q_max": (0.7, 0.5),
        "limit_effort": True,
        "f_ext": (3.0, -2.0, 1.0),
        "payload": 0.2,
        "payload_com": (0.01, 0.02, 0.0),
        "tau_ext": (0.1, -0.1),
        **TIGHT,
    }
    moves: dict[str, Any] = {
        "task": ({"x_des": (0.1, 0.25), "Kp": 5000.0}, {"x_des": (0.28, 0.05)}),
        "pose": ({"x_des": (0.1, 0.25), "Kp": 5000.0, "Kp_rot": 9.0}, {"x_des": (0.28, 0.05)}),
        "joint": ({"q_des": (1.0, 1.0), "Kp": 5000.0}, {"q_des": 0.0}),
        "effort": ({"tau_cmd": (11.0, 2.0)}, {"tau_cmd": -3.0}),
    }
    there, back = moves[control]
    options = dict[str, Any](stop_time=0.2, settings=settings | there, changes=[(0.1, back)])
    runs = [list(twodof.samples(fmus[control, native], **options)) for native in (False, True)]
    rows = [np.array([(*s.q, *s.v, *s.x, *s.tau) for s in run]) for run in runs]
    assert (rows[0][:, :2] == [0.7, 0.5]).any() or (rows[0][:, :2] == [0.2, 0.1]).any()
    assert (np.abs(rows[0][:, -2:]) == 10.0).any()
    size = np.maximum(1.0, np.abs(rows[1]))
    assert (np.abs(rows[0] - rows[1]) / size).max() <= 1e-9


def test_a_short_hop_does_not_depend_on_the_largest_step(fmus):
    """Joint 2 leaves its stop for 11 µs, at 0.9481 s."""
    rng = np.random.default_rng(1)
    torque, limit = rng.uniform(0.2, 2.0), 0.3 * rng.uniform(0.2, 2.0)
    changes = [(0.2 * k, dict(zip(("tau_cmd[1]", "tau_cmd[2]"), rng.uniform(-torque, torque, 2)))) for k in range(5)]
    ends = []
    for native, max_step in ((True, 1e-5), (True, 1e-3), (True, 1e-2), (False, 1e-3)):
        settings = {"q_start": 0.0, "q_min": -limit, "q_max": limit, "max_step": max_step, **TIGHT}
        _, q, v = trajectory(fmus["effort", native], stop_time=1.0, settings=settings, changes=changes)
        ends.append([*q[-1], *v[-1]])
    np.testing.assert_allclose(ends, [ends[0]] * 4, atol=1e-9)


def test_mutual_impacts_of_two_stops_end():
    """They act like the feet of a rocking block; impacts in turn would never end."""
    of = engine("twodof", "effort")
    plant = of.model.plant()
    plant.q_max, plant.q_min, plant.tau_cmd = [0.6, 0.36], [0.4, 0.34], [0.5, -0.1]
    plant.initialise()
    values = of.values(plant)
    for _ in range(100):
        assert of.call("advance", values, 0.01) == 1
        plant.step(0.01)
        native = [*of.group(values, "q"), *of.group(values, "v")]
        np.testing.assert_allclose([*plant.q, *plant.v], native, atol=1e-9)
    assert native == [*plant.q, *plant.v] == [0.6, 0.34, 0.0, 0.0]


# --- what an FMU has ---


def test_an_external_pd_loop_converges_to_the_internal_one(fmus):
    """Halving the step halves the distance."""
    Kp, Kd, goal = 60.0, 14.0, np.array([0.9, -0.6])
    plant = model("twodof").plant()
    reference = plant.robot.model.copy()
    reference.gravity.linear = np.array(plant.gravity)
    data = reference.createData()
    _, inside, _ = trajectory(
        fmus["joint", True], stop_time=1.0, settings={"q_des": tuple(goal), "Kp": Kp, "Kd": Kd, **TIGHT}
    )
    distances = []
    for step in (0.002, 0.001):
        run = twodof.samples(fmus["effort", True], step=step, stop_time=1.0, settings=TIGHT)
        sample, q = next(run), []
        while True:
            if round(sample.t / 0.01, 6).is_integer():
                q.append(sample.q)
            a = Kp * (goal - sample.q) - Kd * np.array(sample.v)
            tau = pin.rnea(reference, data, np.array(sample.q), np.array(sample.v), a)
            try:
                sample = run.send({"tau_cmd": tuple(tau)})
            except StopIteration:
                break
        distances.append(np.abs(np.array(q) - inside).max())
    assert distances[1] < 0.01 and distances[1] / distances[0] == pytest.approx(0.5, abs=0.05)
    assert np.abs(sample.q - goal).max() < 0.02


def test_a_bare_plant_has_no_code_of_a_controller(fmus):
    import zipfile

    with zipfile.ZipFile(fmus["effort", True]) as archive:
        names = archive.namelist()
        text = b"".join(archive.read(n) for n in names if n.startswith("sources/"))
    assert not [name for name in names if "task_control" in name or "pseudo_inverse" in name]
    assert b"X_DES" not in text and b"KP" not in text
    with zipfile.ZipFile(fmus["joint", True]) as archive:
        assert "sources/pseudo_inverse.c" not in archive.namelist()


@pytest.mark.parametrize("control", CONTROLS)
def test_the_description_is_that_of_the_control(fmus, control):
    import fmpy
    from fmpy.validation import validate_fmu

    of = {
        "task": ["x_des", "xd_des", "xdd_des", "Kp", "Kd", "tau_ext", "f_ext", "Kn"],
        "pose": [
            "x_des",
            "xd_des",
            "xdd_des",
            "quat_des",
            "omega_des",
            "alpha_des",
            "Kp",
            "Kd",
            "Kp_rot",
            "Kd_rot",
            "tau_ext",
            "f_ext",
            "Kn",
        ],
        "joint": ["q_des", "v_des", "a_des", "Kp", "Kd", "tau_ext", "f_ext"],
        "effort": ["tau_cmd", "tau_ext", "f_ext"],
    }
    descriptions = []
    for native in (False, True):
        path = fmus[control, native]
        assert validate_fmu(str(path)) == []
        fmu = twodof.load_fmu(path)
        assert [*fmu.groups("input")] == of[control]
        turned = ["quat", "omega"] if control == "pose" else []
        assert [*fmu.groups("output")] == ["q", "v", "x", "xd", *turned, "tau", "q_meas", "v_meas"]
        description = fmpy.read_model_description(str(path))
        unknowns = {u.variable.name: {d.name for d in u.dependencies} for u in description.outputs}
        driving = set(of[control]) - {"tau_ext", "f_ext"}
        groups = {name.partition("[")[0] for name in unknowns["tau[1]"]}
        assert groups - {"q", "v"} == driving
        still = unknowns["x[1]"] | unknowns["xd[1]"] | unknowns["q[1]"]
        assert {name[:2] for name in still} == {"q[", "v["}
        # only where there is Model Exchange has a state a start of its own
        starts = [v.start if v.name[:2] not in ("q[", "v[") else "" for v in fmu.variables.values()]
        variables = [(v.name, v.unit) for v in description.modelVariables]
        descriptions.append((variables, starts))
    assert descriptions[0] == descriptions[1]


def test_a_variable_of_another_control_is_named_as_such(fmus):
    message = "no variable 'x_des': it belongs to control 'task' or control 'pose'; this FMU has control"
    with pytest.raises(twodof.TwoDofError, match=f"{message} 'effort'"):
        twodof.experiment(fmus["effort", True], settings={"x_des": 1.0})
    assert twodof.load_fmu(fmus["joint", False]).control == "joint"


@pytest.mark.parametrize("rigid", [False, True])
def test_a_start_into_a_stop_is_an_impact(fmus, rigid):
    """With rigid stops it is the plastic impulse, with Pinocchio's M; otherwise only that joint's velocity changes."""
    plant = model("twodof").plant()
    q, v = np.array([0.5, 0.35]), np.array([3.0, -9.0])
    M = pin.crba(plant.robot.model, plant.robot.model.createData(), q)
    M = np.triu(M) + np.triu(M, 1).T
    W = np.linalg.inv(M)
    expected = v - W[:, 0] * v[0] / W[0, 0] if rigid else [0.0, -9.0]
    settings = {"q_max": (0.5, 3.0), "q_min": -3.0, "v_start": tuple(v), "rigid_stops": rigid}
    for native in (False, True):
        sample = next(twodof.samples(fmus["effort", native], settings=settings, stop_time=0.01))
        np.testing.assert_allclose(sample.v, expected, atol=1e-12)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_target_on_a_limit_does_not_chatter(fmus, side):
    """The other joint's stop pushes the unpressed joint off its limit."""
    settings = {"q_min": -1.0, "q_max": 1.0, "q_start": (side, -side), "q_des": (4 * side, -side)}
    _, q, _ = trajectory(fmus["joint", True], settings={**settings, **TIGHT}, stop_time=0.3)
    assert (q[:, 0] == side).all() and side * q[-1, 1] > 0.5
    _, other, _ = trajectory(fmus["joint", False], settings={**settings, **TIGHT}, stop_time=0.3)
    np.testing.assert_allclose(other, q, atol=1e-9)


def test_an_unknown_control_law_is_refused():
    with pytest.raises(twodof.TwoDofError, match="`control` 'velocity' is unknown; there are: task, pose, j"):
        build_fmu(None, FmuOptions(control="velocity"))


@pytest.mark.parametrize("payload", [-1.0, float("nan")])
def test_an_invalid_payload_is_refused(fmus, payload):
    for native in (False, True):
        with pytest.raises(twodof.TwoDofError, match="payload"):
            [*twodof.samples(fmus["task", native], settings={"payload": payload}, stop_time=0.01)]


@pytest.mark.parametrize("control", ["pose", "effort"])
def test_every_verb_follows_the_control(fmus, control, tmp_path, monkeypatch, capsys):
    """Bag, figure, replay, sweep and page, with an FMU of each control."""

    from twodof.cli.main import main
    from twodof.pages.arm import RECORDED
    from twodof.pages.loop import Loop

    monkeypatch.chdir(tmp_path)
    fmu, swept = str(fmus[control, True]), "tau_cmd" if control == "effort" else "Kp"
    for line in (
        f"run {fmu} -o bag --scene --effort --stop-time 0.3 --set payload=0.1 --set f_ext=0.2,0,0",
        "plot bag -o p.html",
        "plot bag bag -o p2.svg",
        "view bag --export v.html",
        "info bag",
        f"sweep {fmu} --grid {swept}=1:3:3 --stop-time 0.2 -o s",
        "info s",
        "plot s -o s.svg",
    ):
        assert main(line.split()) == 0, capsys.readouterr().err
    best = capsys.readouterr().out.partition("best:")[2]
    follows = control in ("task", "pose")
    assert ("final_error" in best) == follows
    bag = twodof.read_bag("bag")
    assert bag.tau.shape == bag.q.shape and bag.target.shape[1] == (2 if follows else 0)
    live = twodof.experiment(fmu, stop_time=np.inf)
    (row,) = Loop(live).news()["rows"]
    values = {**live.start_values, **dict(zip(live.fmu.vector("q"), bag.q[0]))}
    told = [values.get(name) for group in RECORDED for name in live.fmu.vector(group)]
    assert len(row) == 1 + len(told)
    assert all(a == b for a, b in zip(row[1:], told) if b is not None)
