"""Friction, armature, sampled control and sensors change no bit of a trajectory where they are 0.

The truth is the engine whose sources have none of them.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import fmpy
import pytest
from native_models import from_urdf, last_link, urdf_path
from tools import needs

from twodof.export.compiler import FLAGS, TARGETS, ZIG

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
    fmi2DoStepTYPE *volatile step = fmi2DoStep; /* a function of its own, in which instructions are counted */
    int status = fmi2SetReal(arm, start, N_JOINTS, state) | fmi2SetupExperiment(arm, 0, 0, 0, 0, 0)
                 | fmi2EnterInitializationMode(arm) | fmi2ExitInitializationMode(arm);
    for (int k = 0; k < 200; k++) {
        status |= step(arm, k * 0.01, 0.01, 1) | fmi2GetReal(arm, vr, 2 * N_JOINTS, state);
        for (int i = 0; i < 2 * N_JOINTS; i++)
            printf("%a\\n", state[i]);
    }
    return status;
}
"""


def compiled(files: dict[str, bytes], folder: Path, compiler: Sequence[str], flags: Sequence[str]) -> Path:
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    (folder / "host.c").write_text(HOST)
    (folder / "stub.c").write_text("void twodof_differentiate(void) {}")  # a step needs no derivatives
    flags = [*flags, f"-I{Path(fmpy.__file__).parent / 'c-code'}"]
    subprocess.run([*compiler, *flags, "-o", "host", "host.c", "stub.c", "-lm"], cwd=folder, check=True)
    return folder / "host"


def without(files: dict[str, bytes]) -> dict[str, bytes]:
    """The sources without what the parameters do."""
    removed = {name: content.decode() for name, content in files.items() if name not in KEPT}
    for old, new in REMOVED.items():
        assert any(old in text for text in removed.values()), old
        removed = {name: text.replace(old, new) for name, text in removed.items()}
    return files | {name: text.encode() for name, text in removed.items()}


def hosts(name: str, control: str, folder: Path, compiler: Sequence[str], flags: Sequence[str]) -> list[Path]:
    """Programs that run a robot: with the parameters at 0, and without them."""
    text = re.sub('friction="[^"]*"', 'friction="0"', urdf_path(name).read_text())
    frame, axes = ("EndEffector", "xy") if name == "twodof" else (last_link(name), "xyz")
    files = from_urdf(text, frame, axes, control).sources()
    both = enumerate((files, without(files)))
    return [compiled(sources, folder / f"{Path(name).stem}{k}", compiler, flags) for k, sources in both]


@pytest.mark.parametrize("control", ["task", "joint", "effort"])
def test_parameters_at_zero_change_no_bit(control: str, length: Callable[[int, int], int], tmp_path: Path) -> None:
    for name in ROBOTS[: length(len(ROBOTS), 2)]:
        both = hosts(name, control, tmp_path, [needs("gcc")], ["-std=c99", "-O1", "-ffp-contract=off"])
        rows, plain = (subprocess.check_output([host]).split() for host in both)
        assert rows == plain and len(set(rows)) > 300, name


def instructions(host: Path) -> int:
    """Instructions of all communication steps, as Callgrind counts them."""
    count = [needs("valgrind"), "--tool=callgrind", "--callgrind-out-file=/dev/null", "--toggle-collect=fmi2DoStep"]
    done = subprocess.run([*count, host], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=True)
    return int(re.findall(r"Collected : (\d+)", done.stderr)[0])


@pytest.mark.parametrize("control", ["task", "joint", "effort"])
def test_parameters_at_zero_cost_few_instructions(
    control: str, length: Callable[[int, int], int], tmp_path: Path
) -> None:
    needs("valgrind")
    compiler = [*ZIG, *TARGETS["linux64"]]
    for name in ROBOTS[: length(len(ROBOTS), 2)]:
        steps, plain = map(instructions, hosts(name, control, tmp_path, compiler, FLAGS[:6]))
        print(f"{name}, {control}: {steps / plain:.4f}")
        assert plain > 1e6 and steps / plain < (1.04 if (name, control) == ("twodof", "effort") else 1.03), name
