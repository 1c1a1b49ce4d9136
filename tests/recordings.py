"""Bags for figures: of runs with their samples, and in the form of other recorders."""

import pickle
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from harness import shared
from sinks import Collector

import twodof
from twodof.simulation.sample import Sample

START = 1_700_000_000  # s since the epoch
LINK = 0.15  # m, of the default arm
UR5_JOINTS = [
    "elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", "wrist_1_joint", "wrist_2_joint",
    "wrist_3_joint",
]  # fmt: skip


class Recording(NamedTuple):
    bag: Path
    samples: list[Sample]

    def __getattr__(self, name: str) -> np.ndarray:  # t, q, v, x: N or N × n
        return np.array([getattr(sample, name) for sample in self.samples])


def record(bag: Path, fmu: Path, **options: Any) -> Recording:
    run = twodof.experiment(fmu, stamp_start=START, **options)
    samples = Collector()
    twodof.simulate(run, samples, twodof.Bag(bag))
    return Recording(bag, samples)


@pytest.fixture(scope="session")
def gains(fmu_path: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Recording]:
    """The default arm's runs with three gains; that with 50 is the default run."""

    def make(folder: Path) -> None:
        for gain, end in ((20, 1.0), (50, 5.0), (400, 1.0)):
            run = record(folder / f"Kp{gain}", fmu_path, settings={"Kp": gain}, stop_time=end)
            (folder / f"{gain}").write_bytes(pickle.dumps([*run.samples]))

    folder = shared(tmp_path_factory, "gains", make)
    return {
        gain: Recording(folder / f"Kp{gain}", pickle.loads((folder / f"{gain}").read_bytes())) for gain in (20, 50, 400)
    }


@pytest.fixture(scope="session")
def default(gains: dict[int, Recording]) -> Recording:
    return gains[50]


@pytest.fixture(scope="session")
def changing(fmu_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Changes before and at the start, between communication points, at one, and too late.

    Each names only the inputs that change.
    """
    folder = tmp_path_factory.mktemp("changing")
    (folder / "in.csv").write_text(
        "time,x_des[1],x_des[2],Kp[1],xdd_des[2]\n-1,0,0.1,50,0\n0,0.2,0.05,50,0\n0.503,0.1,0.2,50,0\n"
        "0.75,0.1,0.2,90,0.5\n1.2,0.05,0.2,90,0\n2,0.3,0.3,90,0\n"
        "9,0.3,0.3,90,0\n"
    )
    run = twodof.experiment(fmu_path, stop_time=2.0, input_file=folder / "in.csv", stamp_start=START)
    known: dict[str, Any] = {}
    changes = []
    for time, values in run.changes:
        changes.append((time, {n: v for n, v in values.items() if known.get(n) != v}))
        known.update(values)
    samples = Collector()
    twodof.simulate(replace(run, changes=changes), samples, twodof.Bag(folder / "bag"))
    return Recording(folder / "bag", samples)


def third_party_bag(bag: Path, names: Sequence[str], t: np.ndarray, q: np.ndarray, v: np.ndarray | None) -> Path:
    """A bag as another recorder writes it, without provenance."""
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    stamp_of, header_of, state_of = (
        store.types[f"{kind}"]
        for kind in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header", "sensor_msgs/msg/JointState")
    )
    with Writer(bag, version=9) as writer:
        topic = writer.add_connection("/joint_states", state_of.__msgtype__, typestore=store)
        for k, time in enumerate(t):
            stamp = START * 10**9 + round(time * 1e9)
            numbers = [q[k], [] if v is None else v[k], []]
            message = state_of(
                header_of(stamp_of(*divmod(stamp, 10**9)), ""),
                list(names),
                *(np.asarray(part, dtype=np.float64) for part in numbers),
            )
            writer.write(topic, stamp, store.serialize_cdr(message, topic.msgtype))
    return bag


def waves(n: int, count: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times at uneven steps, and n joints that oscillate about different centres."""
    t = np.linspace(0.0, 1.0, count) ** 1.5 * 6.0
    phase = np.arange(n)
    q = -0.4 - 0.1 * phase + 0.3 * np.sin(t[:, None] * (1 + 0.2 * phase))
    return t, q, 0.3 * (1 + 0.2 * phase) * np.cos(t[:, None] * (1 + 0.2 * phase))


def bare(urdf: str) -> str:
    """A URDF without its meshes, which the FMU of a test does not need."""
    tree = ET.fromstring(urdf)
    for link in tree.findall("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(part)
    return ET.tostring(tree, encoding="unicode")


def chain_urdf(joints: str, length: float = 0.4, low: float = -2.0, high: float = 2.0) -> str:
    """A chain with a letter of ``joints`` for each joint: x, y, z rotate about the axis, X, Y, Z slide along it."""
    text = '<robot name="chain"><link name="base"/>'
    for i, letter in enumerate(joints):
        kind = "prismatic" if letter.isupper() else "revolute"
        axis = " ".join("1" if letter.lower() == axis else "0" for axis in "xyz")
        parent, offset = ("base", 0.0) if i == 0 else (f"l{i}", length)
        text += (
            f'<link name="l{i + 1}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="1"/>'
            '<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-2" iyz="0" izz="1e-2"/></inertial></link>'
            f'<joint name="j{i + 1}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="l{i + 1}"/><origin xyz="{offset} 0 0"/><axis xyz="{axis}"/>'
            f'<limit lower="{low}" upper="{high}" effort="9" velocity="9"/></joint>'
        )
    return (
        f'{text}<link name="tip"/><joint name="end" type="fixed"><parent link="l{len(joints)}"/>'
        f'<child link="tip"/><origin xyz="{length} 0 0"/></joint></robot>'
    )


def build(folder: Path, urdf: str, **options: Any) -> Path:
    (folder / "robot.urdf").write_text(urdf)
    options = {"urdf": folder / "robot.urdf", "frame": "tip", **options}
    return twodof.build_fmu(folder / "Robot.fmu", twodof.FmuOptions(**options))


@pytest.fixture(scope="session")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Joint states of a UR5 in alphabetical order, as joint_state_broadcaster writes them."""
    return third_party_bag(tmp_path_factory.mktemp("foreign") / "ur5_log", UR5_JOINTS, *waves(6))


def long_run(default: Recording, q: np.ndarray) -> twodof.Recording:
    """An artificial run of the default arm at 1 kHz."""
    run = twodof.read_bag(default.bag)
    stamps = START * 10**9 + np.arange(len(q)) * 10**6
    run.provenance["step"] = 0.001
    return replace(run, stamps=stamps, count=len(q), q=q, v=q - q[0])
