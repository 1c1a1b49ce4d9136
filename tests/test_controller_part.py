"""The controller as an FMU of its own, in a loop with the bare plant, against the FMU of both."""

from __future__ import annotations

from pathlib import Path

import fmpy.validation
import numpy as np
import pytest
from systems import component, connection, loop, ssd

import twodof
from twodof.errors import BuildError

TARGETS = {"task": {"x_des": (0.25, 0.1)}, "joint": {"q_des": (0.1, 0.9)}}
EXACT = {"rtol": 1e-10, "atol": 1e-12}
STOP = 1.0


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A plant, and of each law the controller, the FMU of both, and the system of plant and controller."""
    folder, built = tmp_path_factory.mktemp("parts"), {}

    def build(name: str, **options: object) -> Path:
        return twodof.build_fmu(folder / f"{name}.fmu", twodof.FmuOptions(native=True, name=name, **options))

    built["plant"] = build("plant", control="effort")
    wires = "".join(
        connection(f"{a}[{i}]", f"{b}[{i}]")
        for i in (1, 2)
        for a, b in (("plant.q", "pd.q"), ("plant.v", "pd.v"), ("pd.tau_cmd", "plant.tau_cmd"))
    )
    structure = ssd(
        f"<ssd:Elements>{component('pd')}{component('plant')}</ssd:Elements><ssd:Connections>{wires}</ssd:Connections>"
    )
    for law in TARGETS:
        built[f"{law} law"] = build(f"law_{law}", control=law, part="controller")
        built[f"{law} both"] = build(f"both_{law}", control=law, settings={"rigid_stops": True})
        parts = built["plant"].read_bytes(), built[f"{law} law"].read_bytes()
        built[f"{law} split"] = loop(folder / f"{law}.ssp", *parts, structure)
    return built


def q_of(path: Path, step: float = 0.01, **settings: object) -> np.ndarray:
    """Return q at every 10 ms; an array of N + 1 × 2."""
    given = {name.replace("__", "."): value for name, value in settings.items()}
    rows = [sample.q for sample in twodof.samples(path, step=step, stop_time=STOP, settings=given)]
    return np.array(rows)[:: round(0.01 / step)]


def split_settings(law: str, **settings: object) -> dict[str, object]:
    """Return settings of a system from those of the controller."""
    return {f"pd__{name}": value for name, value in {**TARGETS[law], **settings}.items()}


@pytest.mark.parametrize("law", TARGETS)
def test_a_split_loop_converges_to_the_whole_with_order_1(fmus: dict[str, Path], law: str) -> None:
    expected = q_of(fmus[f"{law} both"], **TARGETS[law], **EXACT)
    given = {**split_settings(law), **EXACT}
    errors = [np.abs(q_of(fmus[f"{law} split"], 0.01 / n, **given) - expected).max() for n in (1, 2, 4, 8)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[0] > 1e-4
    assert ((orders > 0.9) & (orders < 1.1)).all(), orders


@pytest.mark.parametrize("law", TARGETS)
@pytest.mark.parametrize(("period", "delay"), [(0.01, 0.0), (0.02, 0.0), (0.03, 0.01), (0.01, 0.03)])
def test_a_sampled_split_loop_is_the_whole(fmus: dict[str, Path], law: str, period: float, delay: float) -> None:
    sampling = {"control_period": period, "control_delay": delay}
    sensors = {"q_resolution": 1e-4, "q_noise": 1e-4, "seed": 7}
    for more in ({}, sensors, {"v_from_q": True}):
        whole = q_of(fmus[f"{law} both"], **TARGETS[law], **sampling, **more)
        split = q_of(fmus[f"{law} split"], **split_settings(law, **sampling, **more))
        assert np.ptp(whole) > 0.3
        np.testing.assert_allclose(split, whole, rtol=0, atol=1e-12)


def test_the_controller_knows_what_it_is_told(fmus: dict[str, Path]) -> None:
    """A payload of the plant is one that the controller knows, or not."""
    for known in (False, True):
        loads = {"payload": 0.2, "payload_known": known}
        whole = q_of(fmus["joint both"], **TARGETS["joint"], **loads, control_period=0.01)
        given = split_settings("joint", **loads, control_period=0.01)
        split = q_of(fmus["joint split"], **given, plant__payload=0.2)
        np.testing.assert_allclose(split, whole, rtol=0, atol=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
def test_its_description_is_that_of_a_law(tmp_path: Path, fmi: int) -> None:
    options = twodof.FmuOptions(native=True, fmi=fmi, control="pose", part="controller", name="law")
    path = twodof.build_fmu(tmp_path / "law.fmu", options)
    assert fmpy.validation.validate_fmu(path) == []
    description = fmpy.read_model_description(path)
    groups = {v.name.partition("[")[0]: v.causality for v in description.modelVariables}
    assert {"q", "v", "x_des", "Kp", "Kp_rot"} <= {name for name, kind in groups.items() if kind == "input"}
    assert {name for name, kind in groups.items() if kind == "output"} == {"tau_cmd", "q_meas", "v_meas"}
    assert not groups.keys() & {"x", "q_start", "max_step", "friction", "tau_ext", "der(q"}
    assert not description.derivatives


def test_its_effort_is_that_of_the_whole_at_once(fmus: dict[str, Path]) -> None:
    """In co-simulation before any step, and in Model Exchange, whatever the state."""
    whole = next(twodof.samples(fmus["joint both"], settings={"q_start": (0.3, -0.4), **TARGETS["joint"]}))
    starts = {"q[1]": 0.3, "q[2]": -0.4, "q_des[1]": 0.1, "q_des[2]": 0.9}
    for kind in ("CoSimulation", "ModelExchange"):
        result = fmpy.simulate_fmu(
            fmus["joint law"], fmi_type=kind, stop_time=0.01, start_values=starts, output=["tau_cmd[1]", "tau_cmd[2]"]
        )
        np.testing.assert_allclose([*result[0]][1:], whole.tau, rtol=1e-13)


def test_a_controller_is_native_and_has_a_law(tmp_path: Path) -> None:
    for options in ({"control": "effort", "native": True}, {"control": "task"}):
        with pytest.raises(BuildError, match="the controller alone is native"):
            twodof.FmuOptions(part="controller", **options)
    with pytest.raises(BuildError, match="`part` 'law' is unknown"):
        twodof.FmuOptions(part="law")
