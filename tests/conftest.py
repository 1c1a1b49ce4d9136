"""Fixtures that several test files share."""

from __future__ import annotations

import importlib.metadata
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

import twodof


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the file whose first compilation for another platform takes minutes."""
    items.sort(key=lambda item: item.path.name != "test_native_platforms.py")


@pytest.fixture(scope="session")
def fmu_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default arm's FMU, built once."""
    return twodof.build_fmu(tmp_path_factory.mktemp("fmu") / "TwoDof.fmu")


@pytest.fixture(scope="session")
def robots() -> Path:
    """Folder of the URDFs of example-robot-data, one folder a robot."""
    files = importlib.metadata.files("example-robot-data") or []
    urdf = next(file for file in files if file.parts[-4:-2] == ("robots", "panda_description"))
    return Path(str(urdf.locate())).parents[2]


@pytest.fixture(scope="session")
def ur5(robots: Path) -> str:
    """URDF text of the UR5, six joints."""
    return (robots / "ur_description/urdf/ur5_robot.urdf").read_text()


@pytest.fixture(scope="session")
def panda(robots: Path) -> str:
    """URDF text of the Panda arm, seven joints: its fingers fixed, without joint damping.

    The second finger mimics the first, which is refused; and damping, which the controller does
    not compensate, would leave no closed form to compare with.
    """
    tree = ET.fromstring((robots / "panda_description/urdf/panda.urdf").read_text())
    for joint in tree.findall("joint"):
        if "finger_joint" in str(joint.get("name")):
            joint.set("type", "fixed")
        for element in [*joint.findall("mimic"), *joint.findall("dynamics")]:
            joint.remove(element)
    return ET.tostring(tree, encoding="unicode")
