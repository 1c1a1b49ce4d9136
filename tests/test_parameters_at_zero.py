"""Friction, armature, sampled control and sensors change no bit of a trajectory where they are 0.

The truth is the engine whose sources have none of them.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import fmpy
import pytest
from native_models import from_urdf, last_link, urdf_path
from tools import needs

ROBOTS = (
    "twodof",
    "ur5",
    "panda",
    "z1",
    "tiago",
    "baxter",
    "ur_description/urdf/ur3_robot.urdf",
    "kinova_description/robots/kinova.urdf",
    "xarm_description/urdf/xarm7.urdf",
    "so_arm_description/urdf/so100.urdf",
)
REMOVED = {
    "plant->value[FRICTION + i]": "0.0",
    "value[FRICTION + i]": "0.0",
    "return stops->any_slip ? stops->slip : NULL;": "return NULL;",
    "return value[CONTROL_PERIOD] != 0.0;": "return (void)value, 0;",
    "plant->value[CONTROL_PERIOD]": "0.0",
    "!are_samples(plant->value)": "1",
    "&value[ARMATURE]": "NO_ARMATURE",
    "&plant->value[ARMATURE]": "NO_ARMATURE",
}
KEPT = ("model.h", "mechanism.c", "mechanism.h")
HOST = """
#include <stdio.h>
static const double NO_ARMATURE[128];
#include "fmu.c"
int main(void)
{
    static const fmi2CallbackFunctions callbacks;
    double state[2 * N_JOINTS];
    fmi2ValueReference vr[2 * N_JOINTS], start[N_JOINTS];
    fmi2Component arm = fmi2Instantiate("arm", fmi2CoSimulation, MODEL_GUID, "", &callbacks, 0, 0);
    for (int i = 0; i < 2 * N_JOINTS; i++)
        vr[i] = Q + i + 1;
    for (int i = 0; i < N_JOINTS; i++) {
        start[i] = V_START + i + 1;
        state[i] = 0.3;
    }
    int status = fmi2SetReal(arm, start, N_JOINTS, state) | fmi2SetupExperiment(arm, 0, 0, 0, 0, 0)
                 | fmi2EnterInitializationMode(arm) | fmi2ExitInitializationMode(arm);
    for (int k = 0; k < 200; k++) {
        status |= fmi2DoStep(arm, k * 0.01, 0.01, 1) | fmi2GetReal(arm, vr, 2 * N_JOINTS, state);
        for (int i = 0; i < 2 * N_JOINTS; i++)
            printf("%a\\n", state[i]);
    }
    return status;
}
"""


def compiled(files: dict[str, bytes], folder: Path) -> Path:
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    (folder / "host.c").write_text(HOST)
    (folder / "stub.c").write_text("void twodof_differentiate(void) {}")  # a step needs no derivatives
    flags = ["-std=c99", "-O1", "-ffp-contract=off", f"-I{Path(fmpy.__file__).parent / 'c-code'}"]
    subprocess.run([needs("gcc"), *flags, "-o", "host", "host.c", "stub.c", "-lm"], cwd=folder, check=True)
    return folder / "host"


def without(files: dict[str, bytes]) -> dict[str, bytes]:
    """The sources without what the parameters do."""
    removed = {name: content.decode() for name, content in files.items() if name not in KEPT}
    for old, new in REMOVED.items():
        assert any(old in text for text in removed.values()), old
        removed = {name: text.replace(old, new) for name, text in removed.items()}
    return files | {name: text.encode() for name, text in removed.items()}


@pytest.mark.parametrize("control", ["task", "joint", "effort"])
def test_parameters_at_zero_change_no_bit(control: str, length: Callable[[int, int], int], tmp_path: Path) -> None:
    for name in ROBOTS[: length(len(ROBOTS), 2)]:
        text = re.sub('friction="[^"]*"', 'friction="0"', urdf_path(name).read_text())
        frame, axes = ("EndEffector", "xy") if name == "twodof" else (last_link(name), "xyz")
        files = from_urdf(text, frame, axes, control).sources()
        hosts = [compiled(files, tmp_path / f"{Path(name).stem}{k}") for k, files in enumerate((files, without(files)))]
        rows, plain = (subprocess.check_output([host]).split() for host in hosts)
        assert rows == plain and len(set(rows)) > 300, name
