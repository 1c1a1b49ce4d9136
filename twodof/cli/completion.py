"""Shell completion of variables, frames and joints of the robot on the command line."""

import argparse
import xml.etree.ElementTree as ET
from pathlib import Path


def _file(options: argparse.Namespace) -> Path | None:
    """Return the FMU, URDF or first bag on an incomplete command line."""
    names = (getattr(options, name, None) for name in ("fmu", "urdf", "robot", "bag", "bags", "robots"))
    first = next((name for name in names if name), None)
    return Path(first[0] if isinstance(first, list) else first) if first else None


def variables(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """Complete an FMU's inputs and parameters."""
    path = _file(parsed_args)
    if path is None or path.suffix != ".fmu":
        return []
    from ..fmu import load_fmu

    fmu = load_fmu(path)
    return [f"{group}=" for causality in ("input", "parameter") for group in fmu.groups(causality)]


def links(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """Complete the links of a URDF or of a bag's robot."""
    return [str(link.get("name")) for link in _robot(parsed_args).iterfind("link")]


def joints(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """Complete the moving joints of a URDF or of a bag's robot."""
    found = _robot(parsed_args).iterfind("joint")
    return [str(joint.get("name")) for joint in found if joint.get("type") != "fixed"]


def _robot(options: argparse.Namespace) -> ET.Element:
    path = _file(options)
    if path is None:
        return ET.Element("robot")
    if path.suffix in (".urdf", ".xacro"):
        from ..export.urdf_source import read_text

        return ET.fromstring(read_text(path, None))
    from ..bag.provenance import read_provenance, robot_in

    return ET.fromstring(str(read_provenance(*robot_in(path))["urdf"]))
