"""Layouts for RViz, PlotJuggler and Foxglove name the topics and fields that a run publishes.

The tools are not needed: parsers of YAML, XML and JSON read the files, and each topic and field in them is searched in
a bag.
"""

import json
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
from nodes import recorded
from ruamel.yaml import YAML

import twodof
from twodof.cli.main import main


@pytest.fixture(scope="module", params=["task", "pose", "joint", "effort"])
def bag(request, tmp_path_factory):
    """Return a bag with everything that a layout shows."""
    folder = tmp_path_factory.mktemp("layouts")
    fmu = folder / "Arm 1.fmu"
    twodof.build_fmu(fmu, twodof.FmuOptions(control=request.param))
    twodof.simulate(fmu, twodof.Bag(folder / "bag", scene=True, effort=True), stop_time=0.05)
    twodof.layouts(fmu, folder)
    return folder / "bag"


def dictionaries(tree: Any) -> list[dict[str, Any]]:
    """All dictionaries in a file's content."""
    parts = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return [tree] * isinstance(tree, dict) + [d for part in parts for d in dictionaries(part)]


def test_rviz_shows_the_topics_of_the_bag_as_they_are_offered(bag):
    config = YAML(typ="safe").load(bag.parent / "Arm 1.rviz")
    manager = config["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "world"
    metadata = YAML(typ="safe").load(bag / "metadata.yaml")["rosbag2_bagfile_information"]
    topics = {it["topic_metadata"]["name"]: it["topic_metadata"] for it in metadata["topics_with_message_count"]}
    shown = {}
    for display in manager["Displays"]:
        for topic in dictionaries(display):
            if "Value" in topic:
                shown[topic["Value"]] = display["Class"].rpartition("/")[2]
                qos = YAML(typ="safe").load(topics[topic["Value"]]["offered_qos_profiles"])[0]
                latched = topic["Durability Policy"] == "Transient Local"
                assert (qos["durability"] in (1, "transient_local")) == latched
    kinds = {"RobotModel": "String", "PointStamped": "PointStamped", "Pose": "PoseStamped"}
    for name, display in shown.items():
        assert topics[name]["type"].rpartition("/")[2] == kinds[display]
    assert {"/robot_description", "/end_effector"} <= {*shown} <= {*topics}
    assert ("/target" in shown) == ("/target" in topics)


def test_plotjuggler_draws_each_field_of_each_joint(bag):
    """The names are those that PlotJuggler gives to the fields of a JointState: topic, joint, field."""
    root = ET.parse(bag.parent / "Arm 1.plotjuggler.xml").getroot()
    curves = {curve.get("name") for curve in root.iter("curve")}
    _, names, *_ = recorded(bag)["/joint_states"][0]
    fields = ("position", "velocity", "effort")
    assert curves == {f"/joint_states/{name}/{field}" for name in names for field in fields}


def test_foxglove_draws_the_contents_of_messages(bag):
    layout = json.loads((bag.parent / "Arm 1.foxglove.json").read_text("utf-8"))
    panels, messages = layout["configById"], recorded(bag)
    fields = {"position": 2, "velocity": 3, "effort": 4}
    drawn = []
    for panel in panels.values():
        for path in panel.get("paths", []):
            found = re.fullmatch(r"(\S+)[.](\w+)\[(\d+)\]", path["value"])
            assert found is not None
            topic, field, i = found.groups()
            state = messages[topic][-1]
            assert state[1][int(i)] == path["label"] and len(state[fields[field]]) > int(i)
            drawn.append((field, int(i)))
    assert len({*drawn}) == len(drawn) == 6
    assert {*panels["3D!robot"]["topics"]} <= {*messages}
    leaves, pending = [], [layout["layout"]]
    while pending:
        at = pending.pop()
        pending += [at["first"], at["second"]] if isinstance(at, dict) else []
        leaves += [at] if isinstance(at, str) else []
    assert sorted(leaves) == sorted(panels)
    gains = {"Kp", "Kd", "Kn"} & {*twodof.load_fmu(bag.parent / "Arm 1.fmu").groups("input")}
    assert ("Parameters!gains" in panels) == bool(gains)


def test_names_are_text_and_topics_are_in_the_namespace(native_path, tmp_path, capfd):
    urdf = (Path(__file__).parents[1] / "urdf" / "2dof.urdf").read_text("utf-8")
    (tmp_path / "odd.urdf").write_text(urdf.replace("joint1", "a&quot;&lt;b>"), "utf-8")
    fmu = twodof.build_fmu(tmp_path / "Odd.fmu", twodof.FmuOptions(urdf=tmp_path / "odd.urdf", meshes=False))
    rviz, juggler, foxglove = twodof.layouts(fmu, tmp_path, namespace="left")
    curves = [curve.get("name") for curve in ET.parse(juggler).getroot().iter("curve")]
    assert curves[0] == '/left/joint_states/a"<b>/position'
    label = json.loads(foxglove.read_text())["configById"]["Plot!position"]["paths"][0]["label"]
    assert label == 'a"<b>'
    topics = [d["Value"] for d in dictionaries(YAML(typ="safe").load(rviz)) if "Value" in d]
    assert topics and all(topic.startswith("/left/") for topic in topics)
    for options, culprit in (
        (["--namespace", "a b"], "--namespace 'a b' is not a valid ROS 2 name"),
        (["-o", str(fmu)], "Odd.fmu': File exists"),
    ):
        assert main(["layouts", str(native_path), *options]) == 1
        assert culprit in capfd.readouterr().err
    assert main(["layouts", str(native_path), "-o", str(tmp_path / "none" / "yet")]) == 0
    assert len([*(tmp_path / "none" / "yet").iterdir()]) == 3


def test_layouts_that_were_changed_stay(bag, tmp_path, capsys):
    command = ["layouts", str(bag.parent / "Arm 1.fmu"), "-o", str(tmp_path)]
    assert main(command) == main(command) == 0
    rviz, juggler = tmp_path / "Arm 1.rviz", tmp_path / "Arm 1.plotjuggler.xml"
    written = rviz.read_bytes()
    rviz.write_text("{}")
    juggler.unlink()
    assert main(command) == 1
    refusal = capsys.readouterr().err
    assert f"'{rviz}' exists and differs" in refusal and "--overwrite" in refusal
    assert rviz.read_text() == "{}" and not juggler.exists()
    assert main([*command, "--overwrite"]) == 0
    assert rviz.read_bytes() == written and juggler.exists()


def huge(file: Path) -> None:
    file.touch()
    os.truncate(file, 2**40)


@pytest.mark.parametrize("make", [os.mkfifo, lambda file: file.symlink_to("/dev/zero"), huge])
def test_a_pipe_a_device_or_a_huge_file_in_place_of_a_layout_is_not_read(native_path, tmp_path, make, capsys):
    make(tmp_path / f"{native_path.stem}.rviz")
    assert main(["layouts", str(native_path), "-o", str(tmp_path)]) == 1
    assert f"{native_path.stem}.rviz' exists and differs" in capsys.readouterr().err
