"""Masses, centres of mass and inertias of links as inputs, compared with Pinocchio's model of changed links."""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from native_models import ROBOTS, coupling, model, urdf_path

import twodof
from twodof.errors import BuildError, InputError, SimulationError
from twodof.fmu import instantiate, load_fmu
from twodof.fmu.instance import Instance
from twodof.identification.inertials import model_with, second_moments
from twodof.identification.parameters import Parameters
from twodof.plant.robot import moving_links
from twodof.plant.urdf import INERTIA, read_urdf

COMPARED = ("twodof", "ur5", "panda", "z1", "tiago")
EVERY = ("mass:*", "com:*", "inertia:*")
GRAVITY = (0.3, -0.5, -9.81)
Links = dict[str, dict[str, np.ndarray]]
"""Values of links by link and group: mass (1), com (3), and inertia (6) about the centre, in the link's axes."""


def options(name: str, **further: Any) -> twodof.FmuOptions:
    """Options of a native FMU of the shipped arm, or of a robot of ROBOTS; links are free, and all joints can move."""
    _, frame, axes = ROBOTS.get(name, ("", "EndEffector", "xy"))
    defaults = {"native": True, "control": "effort", "free": EVERY, "meshes": False, "gravity": GRAVITY}
    return twodof.FmuOptions(urdf_path(name), frame=frame, axes=axes, name="Arm", **{**defaults, **further})


@pytest.fixture(scope="module")
def fmu(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The FMU of a robot, or of a pair of a robot and further options."""
    name, further = request.param if isinstance(request.param, tuple) else (request.param, {})
    return twodof.build_fmu(tmp_path_factory.mktemp("links") / "Arm.fmu", options(name, **further))


class Reference:
    """The robot in Pinocchio, with links whose values may change."""

    def __init__(self, name: str) -> None:
        self.robot = model(name).robot
        self.G, self.c = coupling(name, list(self.robot.model.names)[1:])
        urdf = read_urdf(urdf_path(name).read_text())
        names, self.bodies, self.places, inertias = moving_links(urdf, self.robot.model)
        self.links: Links = {
            link: {
                "mass": np.array([inertia.mass]),
                "com": inertia.lever,
                "inertia": np.array([inertia.inertia[place] for place in INERTIA.values()]),
            }
            for link, inertia in zip(names, inertias)
        }

    def changed(self, rng: np.random.Generator) -> Links:
        """Return other, possible values: each inertia is larger by that of a body."""
        links: Links = {}
        for link, own in self.links.items():
            points = rng.uniform(-0.1, 0.1, (4, 3))
            tensor = sum(point @ point * np.eye(3) - np.outer(point, point) for point in points)
            mass = own["mass"] * rng.uniform(0.5, 2.0)
            inertia = own["inertia"] + mass * np.array([np.asarray(tensor)[place] for place in INERTIA.values()])
            links[link] = {"mass": mass, "com": own["com"] + rng.uniform(-0.05, 0.05, 3), "inertia": inertia}
        return links

    def model(self, links: Links) -> pin.Model:
        """Return the model of links with given values, and with the gravity of ``options``."""
        changed = self.robot.model.copy()
        changed.gravity.linear = np.array(GRAVITY)
        for body in {*self.bodies}:
            changed.inertias[body + 1] = pin.Inertia.Zero()
        for body, place, values in zip(self.bodies, self.places, links.values()):
            inertia = pin.Inertia(float(values["mass"][0]), values["com"], matrix(values["inertia"]))
            changed.inertias[body + 1] += place.act(inertia)
        return changed

    def inverse_dynamics(self, reduced: pin.Model, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        G = self.G
        return G.T @ pin.rnea(reduced, reduced.createData(), G @ q + self.c, G @ v, G @ a)

    def mass_matrix(self, reduced: pin.Model, q: np.ndarray) -> np.ndarray:
        M = pin.crba(reduced, reduced.createData(), self.G @ q + self.c)
        return self.G.T @ (np.triu(M) + np.triu(M, 1).T) @ self.G

    def state(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return q within the limits, and v."""
        low, high = (np.clip(side, -1.0, 1.0) for side in (self.robot.q_min, self.robot.q_max))
        n = len(self.robot.joints)
        return low + (high - low) * rng.uniform(0.2, 0.8, n), rng.uniform(-1.0, 1.0, n)


def matrix(inertia: np.ndarray) -> np.ndarray:
    xx, xy, xz, yy, yz, zz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def named(links: Links) -> dict[str, float]:
    """Return values of links by the names of the FMU's inputs."""
    found: dict[str, float] = {}
    for link, groups in links.items():
        for group, values in groups.items():
            for i, value in enumerate(values.tolist()):
                found[f"{group}_{link}" + f"[{i + 1}]" * (group != "mass")] = value
    return found


@contextmanager
def arm(fmu: Path, values: dict[str, Any], **arrays: np.ndarray) -> Iterator[tuple[Instance, list[str]]]:
    """The robot with given inputs and parameters, and the names of its accelerations."""
    for group, array in arrays.items():
        values = {**values, **{f"{group}[{i + 1}]": float(x) for i, x in enumerate(array)}}
    if "friction[1]" in (described := load_fmu(fmu)).variables:
        for group in ("friction", "damping"):
            values = {**values, **dict.fromkeys((f"{group}[{i + 1}]" for i in range(len(described.joints))), 0.0)}
    with instantiate(described) as instance:
        assert isinstance(instance, Instance)
        instance.initialise(0.0, math.inf, values)
        yield instance, [f"der(v[{i + 1}])" for i in range(len(described.joints))]


def slopes(reference: Reference, links: Links, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> dict[str, np.ndarray]:
    """Return ∂q̈ by each input: M ∂q̈ = −∂(M a + h) at a = q̈.

    Central differences are exact: M a + h is of second order in each value. Pinocchio refuses impossible inertias.
    """
    M, found = reference.mass_matrix(reference.model(links), q), {}
    for link, groups in links.items():
        for group, values in groups.items():
            size = np.linalg.eigvalsh(matrix(values))[0] if group == "inertia" else groups["mass"][0]
            step = 0.25 * (1.0 if group == "com" else size)
            for i, unit in enumerate(np.eye(len(values))):
                efforts = []
                for sign in (1.0, -1.0):
                    moved = {**links, link: {**groups, group: values + sign * step * unit}}
                    efforts.append(reference.inverse_dynamics(reference.model(moved), q, v, a))
                change = (efforts[0] - efforts[1]) / (2.0 * step)
                found[f"{group}_{link}" + f"[{i + 1}]" * (group != "mass")] = -np.linalg.solve(M, change)
    return found


@pytest.mark.parametrize("name, fmu", [(name, name) for name in COMPARED], indirect=["fmu"])
def test_accelerations_and_derivatives_are_those_of_pinocchio(fmu: Path, name: str) -> None:
    """Trees, mimic and prismatic joints, links that are rigidly joined, and frames that are not at the last link."""
    reference, rng = Reference(name), np.random.default_rng(7)
    links, (q, v) = reference.changed(rng), reference.state(rng)
    changed, inputs = reference.model(links), named(links)
    tau = reference.inverse_dynamics(changed, q, v, rng.uniform(-1.0, 1.0, len(q)))
    M = reference.mass_matrix(changed, q)
    expected = np.linalg.solve(M, tau - reference.inverse_dynamics(changed, q, v, 0.0 * v))
    with arm(fmu, inputs, q_start=q, v_start=v, tau_cmd=tau) as (instance, rates):
        a = np.array(instance.reader(rates)())
        np.testing.assert_allclose(a, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
        truth = np.column_stack([*(by_name := slopes(reference, links, q, v, expected)).values()])
        scale = np.abs(truth).max(axis=0)
        # the first derivative at a point is a complex step, the others are computed together
        alone, together = (instance.derivatives(rates, names) for names in ([*by_name][:1], [*by_name]))
    np.testing.assert_allclose(alone[:, 0], truth[:, 0], rtol=0, atol=1e-9 * scale[0])
    assert np.all(np.abs(together - truth) <= 1e-8 * scale + 1e-9), np.abs(together - truth).max(axis=0) / scale
    by_regressor = -np.linalg.solve(M, unit_masses(reference, links, q, v, expected))
    masses = [k for k, key in enumerate(by_name) if key.startswith("mass_")]
    np.testing.assert_allclose(together[:, masses], by_regressor, rtol=1e-8, atol=1e-8 * np.abs(by_regressor).max())


def unit_masses(reference: Reference, links: Links, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return ∂(M a + h) by the mass of each link, by Pinocchio's regressor of inertial parameters."""
    changed, G = reference.model(links), reference.G
    Y = pin.computeJointTorqueRegressor(changed, changed.createData(), G @ q + reference.c, G @ v, G @ a)
    columns = []
    for body, place, values in zip(reference.bodies, reference.places, links.values()):
        point = place.act(pin.Inertia(1.0, values["com"], np.zeros((3, 3)))).toDynamicParameters()
        columns.append(G.T @ Y.reshape(len(G), -1)[:, 10 * body : 10 * body + 10] @ point)
    return np.column_stack(columns)


@pytest.mark.parametrize("fmu", ["ur5"], indirect=True)
def test_a_value_has_the_meaning_that_it_has_in_a_fit(fmu: Path) -> None:
    reference, rng = Reference("ur5"), np.random.default_rng(3)
    links, (q, v) = reference.changed(rng), reference.state(rng)
    parameters = Parameters(read_urdf(urdf_path("ur5").read_text()), reference.robot, EVERY, GRAVITY)
    assert parameters.links == [*links]
    assert {name.replace(":", "_").partition(".")[0] for name in parameters.names} == {
        name.partition("[")[0] for name in named(links)
    }
    values = parameters.given.copy(float)
    for i, own in enumerate(links.values()):
        values.mass[i], values.com[i] = own["mass"][0], own["com"]
        values.second[i] = second_moments(matrix(own["inertia"]))
    fitted = model_with(reference.robot.model, parameters.dynamics(values).inertial, np.array(GRAVITY))
    with arm(fmu, named(links), q_start=q, v_start=v) as (instance, rates):
        found = np.array(instance.reader(rates)())
    np.testing.assert_allclose(found, pin.aba(fitted, fitted.createData(), q, v, 0.0 * q), rtol=1e-9)


@pytest.mark.parametrize(
    "fmu", [("twodof", {"control": "joint", "free": ("mass:*",), "outputs": ("M", "h")})], indirect=True
)
@pytest.mark.parametrize("factor", [1.0, 1.7])
def test_the_control_law_knows_the_masses_of_the_urdf(fmu: Path, factor: float) -> None:
    """With these masses q̈ is the commanded one; M and h are those of the changed robot."""
    reference, rng = Reference("twodof"), np.random.default_rng(5)
    links = {link: {**own, "mass": factor * own["mass"]} for link, own in reference.links.items()}
    changed, q, v = reference.model(links), np.array([0.4, -0.7]), rng.uniform(-1.0, 1.0, 2)
    inputs = {name: value for name, value in named(links).items() if name.startswith("mass")}
    aims = {"q_des": q + 0.1, "a_des": rng.uniform(-1.0, 1.0, 2), "Kp": np.full(2, 50.0), "Kd": np.full(2, 40.0)}
    commanded = aims["a_des"] + 40.0 * -v + 50.0 * 0.1
    tau = reference.inverse_dynamics(reference.model(reference.links), q, v, commanded)
    h = reference.inverse_dynamics(changed, q, v, 0.0 * v)
    M = reference.mass_matrix(changed, q)
    a = np.linalg.solve(M, tau - h)
    if factor == 1.0:
        np.testing.assert_allclose(a, commanded, rtol=1e-12)
    with arm(fmu, inputs, q_start=q, v_start=v, **aims) as (instance, rates):
        found = np.array(instance.reader(rates)())
        np.testing.assert_allclose(found, commanded if factor == 1.0 else a, rtol=1e-13 if factor == 1.0 else 1e-9)
        np.testing.assert_allclose(np.array(instance.reader(["tau[1]", "tau[2]"])()), tau, rtol=1e-10)
        names = [f"M[{i},{k}]" for i in (1, 2) for k in (1, 2)]
        np.testing.assert_allclose(np.array(instance.reader([*names, "h[1]", "h[2]"])()), [*M.flat, *h], rtol=1e-10)
        expected = {k: x for k, x in slopes(reference, links, q, v, a).items() if k in inputs}
        for name in (*expected, *expected):  # the first derivative at a point is computed alone, others together
            np.testing.assert_allclose(instance.derivatives(rates, [name])[:, 0], expected[name], rtol=1e-9)
        assert not instance.derivatives(["tau[1]", "tau[2]"], [*expected]).any()
        by_mass = instance.derivatives(["h[1]", "h[2]"], [*expected])
        np.testing.assert_allclose(by_mass, unit_masses(reference, links, q, v, 0.0 * v), rtol=1e-9)


@pytest.mark.parametrize("fmu", [("twodof", {"free": ("mass:link1", "mass:link2")})], indirect=True)
def test_without_changes_a_robot_moves_as_without_free_masses(fmu: Path, tmp_path: Path) -> None:
    fixed = twodof.build_fmu(tmp_path / "Arm.fmu", options("twodof", free=()))
    settings = {"tau_cmd": (0.3, 0.1), "rtol": 1e-11, "atol": 1e-13}
    first, second = (
        np.array([s.q for s in twodof.samples(each, settings=settings, stop_time=0.5)]) for each in (fmu, fixed)
    )
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-9)


@pytest.mark.parametrize("fmu", [("twodof", {"free": ("mass:link1", "mass:link2")})], indirect=True)
def test_a_mass_that_changes_is_a_run_of_a_changed_urdf_after_a_run(fmu: Path, tmp_path: Path) -> None:
    """The URDF has twice the mass, and its inertia is about the centre of mass."""
    text = urdf_path("twodof").read_text()
    mass = float(Reference("twodof").links["link2"]["mass"][0])
    assert text.count(f'"{mass!r}"') == 1
    heavy = tmp_path / "heavy.urdf"
    heavy.write_text(text.replace(f'"{mass!r}"', f'"{2.0 * mass!r}"'))
    fine = {"rtol": 1e-11, "atol": 1e-13, "tau_cmd": (0.4, 0.1)}
    whole = [*twodof.samples(fmu, settings=fine, stop_time=0.4, changes=[(0.2, {"mass_link2": 2.0 * mass})])]
    other = twodof.FmuOptions(heavy, frame="EndEffector", axes="xy", native=True, control="effort", gravity=GRAVITY)
    start = {"q_start": tuple(whole[20].q), "v_start": tuple(whole[20].v)}
    rest = [*twodof.samples(twodof.build_fmu(tmp_path / "H.fmu", other), settings={**fine, **start}, stop_time=0.2)]
    np.testing.assert_allclose([s.q for s in whole[20:]], [s.q for s in rest], atol=1e-9)


@pytest.mark.parametrize("fmu", [("twodof", {"free": ("mass:*", "com:link1", "inertia:link2")})], indirect=True)
def test_names_starts_units_and_dependents(fmu: Path) -> None:
    described, links = load_fmu(fmu), Reference("twodof").links
    starts = {k: x for k, x in named(links).items() if not k.startswith(("com_link2", "inertia_link1"))}
    found = {name: v for name, v in described.variables.items() if name.startswith(("mass_", "com_", "inertia_"))}
    assert {name: float(v.start or 0.0) for name, v in found.items()} == starts
    assert all(v.causality == "input" and v.variability == "continuous" for v in found.values())
    units = {"mass": "kg", "com": "m", "inertia": "kg.m2"}
    assert all(v.unit == units[name.partition("_")[0]] for name, v in found.items())
    assert b'min="2.2250738585072014e-308"' in zipfile.ZipFile(fmu).read("modelDescription.xml")
    linear = twodof.linearise(described, {"q": (0.3, 0.4), "v": (0.1, 0.2)}, inputs=["mass_link2", "inertia_link2"])
    assert linear.inputs == ("mass_link2", *(f"inertia_link2[{i}]" for i in range(1, 7)))
    assert np.all(linear.B[2:, 0] != 0.0) and np.all(linear.B[:2] == 0.0)


def test_a_start_value_of_the_build_is_that_of_a_run(tmp_path: Path) -> None:
    """The controller's model keeps the URDF's values, so that the verdict names a change."""
    settings = {"mass_link2": 0.5, "com_link2": (0.1, 0.0, 0.0), "inertia_link2[6]": 1e-3}
    free = {"control": "task", "free": ("mass:link2", "com:*", "inertia:link2")}
    usual, own = (
        twodof.build_fmu(tmp_path / f"{name}.fmu", options("twodof", settings=values, **free))
        for name, values in (("Usual", {}), ("Own", settings))
    )
    starts = load_fmu(own).start_values
    assert [starts[f"com_link2[{i}]"] for i in (1, 2, 3)] == [0.1, 0.0, 0.0] and starts["mass_link2"] == 0.5
    assert starts["inertia_link2[6]"] == 1e-3 and starts["com_link1[1]"] == load_fmu(usual).start_values["com_link1[1]"]
    whole = [[s.q for s in twodof.samples(fmu, settings=x, stop_time=0.2)] for fmu, x in ((usual, settings), (own, {}))]
    assert whole[0] == whole[1]
    first, second = twodof.simulate(usual, settings=settings, stop_time=1.0), twodof.simulate(own, stop_time=1.0)
    texts = [[cause.text for cause in run.verdict.causes] for run in (first, second)]
    assert texts[0] == texts[1] and "mass_link2 = 0.5: its model has 0.187" in str(texts[1])
    assert twodof.simulate(own, settings={"mass_link2": 0.4}, stop_time=1.0).verdict.causes


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"mass_link2": 0.0}, "mass_link2 = 0 must be > 0"),
        ({"com_link2": (1.0, 2.0)}, "com_link2 has 3 elements, 2 were given"),
        ({"mass_link1": 0.5}, "there is no variable 'mass_link1'; did you mean 'mass_link2'?"),
        ({"com_link2[2]": 0.1}, "references are computed with the URDF's links; leave out `reference` or com_link2[2]"),
    ],
)
def test_an_impossible_start_value_of_a_link_is_refused(tmp_path: Path, settings: Any, message: str) -> None:
    built = options("twodof", free=("mass:link2", "com:link2"), settings=settings, reference=True)
    with pytest.raises(BuildError, match=re.escape(message)):
        twodof.build_fmu(tmp_path / "Arm.fmu", built)


@pytest.mark.parametrize("control, fmi", [("task", 2), ("joint", 3), ("pose", 3), ("effort", 2)])
def test_an_fmu_with_free_links_passes_the_checks(tmp_path: Path, control: str, fmi: int) -> None:
    """These compare all derivatives with central differences, and the declared dependencies."""
    free = ("mass:*", "com:link2", "inertia:link2", "payload", "armature")
    built = options("twodof", control=control, fmi=fmi, free=free, outputs=("M", "h"))
    report = twodof.check(twodof.build_fmu(tmp_path / "Arm.fmu", built))
    assert report.passed, report


@pytest.mark.parametrize("fmu", [("twodof", {"control": "joint", "reference": True})], indirect=True)
def test_references_are_those_of_the_urdf(fmu: Path) -> None:
    report = twodof.check(fmu)
    assert report.passed, report
    assert "reference push" in str(report)


@pytest.mark.parametrize("fmu", [("twodof", {"free": ("mass:link2",)})], indirect=True)
@pytest.mark.parametrize("mass", [0.0, -1.0])
def test_a_mass_that_is_not_positive_is_refused(fmu: Path, mass: float) -> None:
    with pytest.raises((InputError, SimulationError), match=r"mass_link2.* > 0"):
        twodof.run(fmu, settings={"mass_link2": mass}, stop_time=0.1)


LINK = '<link name="{}">{}</link>'
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
JOINT = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><axis xyz="0 0 1"/></joint>'
ODD = (
    '<robot name="odd">'
    + "".join(LINK.format(link, INERTIAL * (link != "tip")) for link in ("base", "a-b", "a_b", "tip"))
    + JOINT.format("j", "continuous", "base", "a-b")
    + JOINT.format("k", "continuous", "a-b", "a_b")
    + JOINT.format("t", "fixed", "a_b", "tip")
    + "</robot>"
)


@pytest.mark.parametrize(
    "free, message",
    [
        ("mass:a_c", "`free` 'mass:a_c' matches no link that moves and has mass; did you mean 'mass:a_b'?"),
        ("com:*9*", "`free` 'com:.9.' matches no link that moves and has mass; there are: mass:a-b, mass:a_b, "),
        ("mass:base", "`free` 'mass:base': no joint moves the link"),
        ("com:tip", "`free` 'com:tip': the link has no mass"),
        ("mass:*", "`free` 'mass:a_b': another link has the same name in the FMU, 'mass_a_b'"),
        ("masss:a_b", "`free` 'masss:a_b' is not a parameter that can be an input.*mass:LINK"),
        ("mass:", "`free` 'mass:' is not a parameter that can be an input.*mass:LINK"),
    ],
)
def test_an_impossible_free_link_is_refused(tmp_path: Path, free: str, message: str) -> None:
    (tmp_path / "odd.urdf").write_text(ODD)
    with pytest.raises(BuildError, match=message.replace("?", r"\?")) as error:
        twodof.build_fmu(tmp_path / "odd.fmu", twodof.FmuOptions(tmp_path / "odd.urdf", native=True, free=(free,)))
    assert "\n" not in str(error.value) and not (tmp_path / "odd.fmu").exists()


def test_a_mass_that_the_controller_does_not_know_is_the_cause_of_a_failure(tmp_path: Path) -> None:
    options = twodof.FmuOptions(native=True, meshes=False, free=("mass:link2", "com:link2"))
    fmu = twodof.build_fmu(tmp_path / "Arm.fmu", options)
    good = twodof.simulate(fmu).verdict
    assert good.outcome == "reached" and not good.causes
    for settings, words in (
        ({"mass_link2": 0.5}, "mass_link2 = 0.5: its model has 0.187"),
        ({"com_link2": 0.1}, "com"),
    ):
        first = twodof.simulate(fmu, settings=settings).verdict.causes[0]
        assert words in first.text and first.tried.startswith("with that of the model: error 0.000224 m")
