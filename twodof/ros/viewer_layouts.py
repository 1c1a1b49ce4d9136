"""Write layout files with which RViz, PlotJuggler and Foxglove show a robot.

Topics and their types are those of ``Messages``, in a namespace.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from math import inf
from pathlib import Path
from string import Template

from ..errors import InputError
from ..files import data_file, head_of, refusing, write_file
from ..fmu import Fmu, load_fmu
from ..plant.variables import GAINS
from ..simulation.experiments import experiment
from .messages import JOINT_STATES, POSE, Messages, check_name

COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f")
PARTS = {"position": "q", "velocity": "v", "effort": "tau"}
DESCRIPTION = "/robot_description"


def layouts(
    fmu: Fmu | str | Path, folder: str | Path = ".", *, namespace: str = "", overwrite: bool = False
) -> list[Path]:
    """Write the files with which RViz, PlotJuggler and Foxglove show an FMU's robot.

    Args:
        fmu: the FMU whose robot is published or recorded with ``scene`` and ``effort``.
        folder: output folder, made if it does not exist; the files have the name of the FMU.
        namespace: namespace of the topics, as in ``Publisher``.
        overwrite: replace files that differ.

    Returns:
        The files: .rviz, .xml for PlotJuggler, .json for Foxglove.

    Raises:
        BagError: the FMU contains no robot.
        FmuError: the FMU cannot be read.
        InputError: the namespace is invalid, or a file exists with another content or cannot be written.
    """
    check_name("namespace", namespace)
    fmu = fmu if isinstance(fmu, Fmu) else load_fmu(fmu)
    own = Messages(experiment(fmu, stop_time=inf), scene=True, effort=bool(fmu.vector("tau"))).topics
    prefix = f"/{namespace.strip('/')}" if namespace else ""
    types = {prefix + name: topic.type for name, topic in own.items()}
    units = {
        part: ", ".join(dict.fromkeys(str(fmu.variables[name].unit) for name in fmu.vector(group)))
        for part, group in PARTS.items()
        if fmu.vector(group)
    }
    texts = {
        ".rviz": _rviz(fmu, prefix, types),
        ".plotjuggler.xml": _plotjuggler(fmu, prefix, units),
        ".foxglove.json": _foxglove(fmu, prefix, units, types),
    }
    stem = Path(folder, Path(fmu.path).stem)
    contents = {Path(f"{stem}{ending}"): text.encode() for ending, text in texts.items()}
    for path, content in contents.items():
        if not overwrite and path.exists() and head_of(path, len(content) + 1) != content:
            raise InputError(f"'{path}' exists and differs; choose another folder or give `overwrite=True`")
    with refusing(InputError, f"make the folder '{folder}'"):
        stem.parent.mkdir(parents=True, exist_ok=True)
    for path, content in contents.items():
        with refusing(InputError, f"write '{path}'"):
            write_file(path, content, follow=False)
    return [*contents]


def _rviz(fmu: Fmu, prefix: str, types: Mapping[str, str]) -> str:
    """Return RViz's layout as JSON, which is YAML."""
    pitch, yaw = (1.57, 4.712) if "".join(fmu.axes) == "xy" else (0.5, 0.8)
    template = Template(data_file("ros", "layout.rviz").read_text("utf-8"))
    layout = json.loads(template.substitute(prefix=prefix, frame=json.dumps(fmu.root), pitch=pitch, yaw=yaw))

    def shows(topic: str | None, display: str) -> bool:
        """Return whether a kind of display has no topic, or a topic of the robot with the right type."""
        kind = types.get(topic or "", "").rpartition("/")[2]
        return topic is None or kind.startswith(display.rpartition("/")[2])

    manager = layout["Visualization Manager"]
    shown = [one for one in manager["Displays"] if shows(one.get("Topic", {}).get("Value"), one["Class"])]
    manager["Displays"] = shown
    return json.dumps(layout, indent=2) + "\n"


def _plotjuggler(fmu: Fmu, prefix: str, units: Mapping[str, str]) -> str:
    """Return a layout with a plot for each field of the joint states, by PlotJuggler's names."""
    root = ET.Element("root")
    window = ET.SubElement(root, "tabbed_widget", {"name": "Main Window", "parent": "main_window"})
    tab = ET.SubElement(window, "Tab", tab_name=fmu.name, containers="1")
    size = ";".join([f"{1 / len(units):.6f}"] * len(units))
    splitter = ET.SubElement(
        ET.SubElement(tab, "Container"), "DockSplitter", orientation="-", count=str(len(units)), sizes=size
    )
    for part, unit in units.items():
        plot = ET.SubElement(
            ET.SubElement(splitter, "DockArea", name=f"{part} ({unit})"),
            "plot",
            mode="TimeSeries",
            style="Lines",
            flip_x="false",
            flip_y="false",
        )
        ET.SubElement(plot, "limitY")
        for i, joint in enumerate(fmu.joints):
            name = f"{prefix}{JOINT_STATES}/{joint}/{part}"
            ET.SubElement(plot, "curve", name=name, color=COLOURS[i % len(COLOURS)])
    ET.SubElement(root, "use_relative_time_offset", enabled="1")
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _foxglove(fmu: Fmu, prefix: str, units: Mapping[str, str], types: Mapping[str, str]) -> str:
    """Return a layout with the robot in 3D, its gains, and plots of the joint states."""
    shown = [prefix + DESCRIPTION, *(name for name, kind in types.items() if kind == POSE)]
    panels: dict[str, object] = {
        "3D!robot": {
            "followTf": fmu.root,
            "cameraState": {"distance": 1.5},
            "topics": {name: {"visible": True} for name in shown},
        }
    }
    for part, unit in units.items():
        paths = [
            {
                "value": f"{prefix}{JOINT_STATES}.{part}[{i}]",
                "label": joint,
                "enabled": True,
                "color": COLOURS[i % len(COLOURS)],
                "timestampMethod": "headerStamp",
            }
            for i, joint in enumerate(fmu.joints)
        ]
        panels[f"Plot!{part}"] = {"foxglovePanelTitle": part, "paths": paths, "yAxisLabel": unit, "showLegend": True}
    *upper, plots = [f"Plot!{part}" for part in units]
    for plot in reversed(upper):
        plots = {"direction": "column", "first": plot, "second": plots}  # type: ignore[assignment]
    left: object = "3D!robot"
    if any(group in GAINS for group in fmu.groups("input")):
        panels["Parameters!gains"] = {"title": "Gains"}
        left = {"direction": "column", "first": left, "second": "Parameters!gains", "splitPercentage": 75}
    mosaic = {"direction": "row", "first": left, "second": plots}
    layout = {"configById": panels, "globalVariables": {}, "userNodes": {}, "layout": mosaic}
    return json.dumps(layout, indent=2) + "\n"
