"""Outputs on request: mass matrix, Jacobian, orientation and others, against Pinocchio."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pinocchio as pin
import pytest
from oracles import REST, TwoLinkArm

import twodof
from twodof.cli.main import main
from twodof.errors import BuildError
from twodof.files import data_file

ALL = ("M", "h", "J", "drift", "quat", "omega")
V = (0.3, -0.8, 0.5, 1.1, -0.4, 0.9, -1.3)
PAYLOAD, COM, ARMATURE = 1.5, (0.02, -0.01, 0.05), 0.1
FLAVOURS: dict[str, dict[str, Any]] = {
    "python": {},
    "native 2": {"native": True},
    "native 3": {"native": True, "fmi": 3},
    "scalars": {"native": True, "fmi": 3, "arrays": False},
    "bare python": {"control": "effort"},
    "bare native": {"control": "effort", "native": True},
    "joint native": {"control": "joint", "native": True},
}


def outputs(fmu: Path, **settings: object) -> tuple[twodof.Sample, dict[str, float]]:
    """Return the last sample of a short run, and its signals by name."""
    run = twodof.experiment(fmu, signals=True, step=0.002, stop_time=0.01, settings=settings)
    *_, last = twodof.samples(run)
    return last, dict(zip(run.signals, last.signals, strict=True))


def matrix(signals: dict[str, float], name: str, rows: int, columns: int) -> np.ndarray:
    return np.array([[signals[f"{name}[{i + 1},{k + 1}]"] for k in range(columns)] for i in range(rows)])


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_they_are_pinocchios(panda: str, tmp_path: Path, flavour: str) -> None:
    """With a payload and rotors, at a state in motion."""
    urdf = tmp_path / "panda.urdf"
    urdf.write_text(panda)
    given = {"control": "pose", "outputs": ALL, **FLAVOURS[flavour]}
    options = twodof.FmuOptions(urdf, frame="panda_hand_tcp", meshes=False, **given)
    path = twodof.build_fmu(tmp_path / "panda.fmu", options)
    sample, signals = outputs(
        path, q_start=REST["panda"], v_start=V, payload=PAYLOAD, payload_com=COM, armature=ARMATURE
    )
    q, v = np.array(sample.q), np.array(sample.v)
    assert np.abs(v).max() > 0.1
    model = pin.buildModelFromXML(panda)
    frame = model.getFrameId("panda_hand_tcp", pin.FrameType.BODY)
    body = model.frames[frame]
    model.inertias[body.parentJoint] += pin.Inertia(PAYLOAD, body.placement.act(np.array(COM)), np.zeros((3, 3)))
    model.armature[:] = ARMATURE
    data = model.createData()
    M = pin.crba(model, data, q)
    aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    exact: Any = dict(rtol=0, atol=1e-12)
    np.testing.assert_allclose(matrix(signals, "M", 7, 7), np.triu(M) + np.triu(M, 1).T, **exact)
    np.testing.assert_allclose(
        [signals[f"h[{i}]"] for i in range(1, 8)], pin.nonLinearEffects(model, data, q, v), **exact
    )
    J = pin.computeFrameJacobian(model, data, q, frame, aligned)
    np.testing.assert_allclose(matrix(signals, "J", 6, 7), J, **exact)
    pin.forwardKinematics(model, data, q, v, np.zeros(7))
    drift = pin.getFrameClassicalAcceleration(model, data, frame, aligned).vector
    np.testing.assert_allclose([signals[f"drift[{i}]"] for i in range(1, 7)], drift, **exact)
    np.testing.assert_allclose([signals[f"omega[{i}]"] for i in (1, 2, 3)], (J @ v)[3:], **exact)
    quat = pin.Quaternion(data.oMf[frame].rotation).coeffs()
    np.testing.assert_allclose(sample.quat, quat * np.sign(quat[3]), **exact)
    described = {v.name: v.dimensions for v in fmpy.read_model_description(path).modelVariables}
    assert [int(size.start) for size in described["M" if flavour == "native 3" else "M[1,7]"]] == (
        [7, 7] if flavour == "native 3" else []
    )


@pytest.mark.parametrize("native", [False, True])
def test_a_bare_plant_has_those_that_are_asked_for(tmp_path: Path, native: bool) -> None:
    """The reference is the textbook form of the two-link arm; derivatives and dependencies are right."""
    path = tmp_path / "arm.fmu"
    command = ["build", "-o", str(path), "--control", "effort", "--with", "M", "h", *["--native"] * native]
    assert main(command) == 0
    sample, signals = outputs(path, v_start=(1.0, -2.0))
    arm, (q, v) = TwoLinkArm(data_file("urdf", "2dof.urdf"), 9.81), map(np.array, (sample.q, sample.v))
    np.testing.assert_allclose(matrix(signals, "M", 2, 2), arm.mass_matrix(q), rtol=0, atol=1e-12)
    np.testing.assert_allclose([signals["h[1]"], signals["h[2]"]], arm.nonlinear_effects(q, v), rtol=0, atol=1e-12)
    assert not {"J[1,1]", "drift[1]"} & signals.keys()
    assert twodof.check(path).passed, twodof.check(path)


def test_others_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BuildError, match=r"`outputs` 'm' is unknown; did you mean 'M'"):
        twodof.FmuOptions(outputs=("m",))
    with pytest.raises(BuildError, match="outputs of the plant, which the controller alone"):
        twodof.FmuOptions(part="controller", native=True, outputs=("M",))
    with pytest.raises(BuildError, match="quat and omega need a `control` other than 'task'"):
        twodof.FmuOptions(outputs=("omega",))
