"""Meshes that end their reader: one warning names them, and the others are drawn."""

import json
import math
import resource
import struct
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

import twodof
from twodof.bounds import MAX_FATAL_MESHES, MAX_MESH_MEMORY, MAX_TRIANGLES
from twodof.cli.main import main
from twodof.geometry import meshes as meshes_module
from twodof.geometry.meshes import Meshes

ONE = np.ones(3)
FACET = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
STL = bytes(80) + struct.pack("<I", 1) + FACET
TRIANGLE_DAE = b"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><up_axis>Z_UP</up_axis></asset><library_effects><effect id="e"><profile_COMMON>
<technique sid="t"><phong><diffuse><color>1 0 0 1</color></diffuse></phong></technique>
</profile_COMMON></effect></library_effects><library_materials><material id="m">
<instance_effect url="#e"/></material></library_materials><library_geometries><geometry id="g">
<mesh><source id="s"><float_array id="a" count="9">0 0 0 1 0 0 0 1 0</float_array>
<technique_common><accessor source="#a" count="3" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices><triangles count="1"
material="c"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh>
</geometry></library_geometries><library_visual_scenes><visual_scene id="w"><node>
<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="c"
target="#m"/></technique_common></bind_material></instance_geometry></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#w"/></scene></COLLADA>"""
GEOMETRY = TRIANGLE_DAE[TRIANGLE_DAE.index(b"<instance_geometry") : TRIANGLE_DAE.index(b"</node>")]
LIBRARY = b"<library_visual_scenes>"
ITSELF = TRIANGLE_DAE.replace(b"<node>", b'<node id="n"><instance_node url="#n"/>')
"""A node that instances itself: the reader calls itself until its stack ends."""


def doubling(levels: int) -> bytes:
    """A DAE of 2^levels instances of one triangle."""
    twice = '<node id="n{}"><instance_node url="#n{}"/><instance_node url="#n{}"/></node>'
    nodes = "".join(twice.format(i, i + 1, i + 1) for i in range(levels)).encode()
    nodes += b'<node id="n%d">' % levels + GEOMETRY + b"</node>"
    scene = b'<instance_node url="#n0"/>'
    content = TRIANGLE_DAE.replace(GEOMETRY + b"</node></visual", scene + b"</node></visual")
    return content.replace(LIBRARY, b"<library_nodes>" + nodes + b"</library_nodes>" + LIBRARY)


def ply(vertices: int) -> bytes:
    """A binary PLY whose header states more vertices than it has bytes."""
    columns = "".join(f"property float {axis}\n" for axis in "xyz")
    return (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n{columns}"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode() + bytes(100)


OFF = b"OFF\n%d %d 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
HOSTILE = {
    "an instance of itself": (".dae", ITSELF, "it crashes its reader: Segmentation fault"),
    "2^24 instances": (".dae", doubling(24), "it crashes its reader: CPU time limit exceeded"),
    "a billion vertices": (".ply", ply(10**9), "it takes more than 1024 MiB"),
    "a billion faces": (".off", OFF % (10**9, 10**9), "it takes more than 1024 MiB"),
    "more faces than lines": (".off", OFF % (3, 2 * 10**9), "it takes more than 1024 MiB"),
}


def processor_time_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.parametrize(("suffix", "content", "reason"), HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_mesh_is_one_warning(suffix, content, reason, caplog):
    """The meshes before and after it are drawn; time and memory are bounded."""
    files = {"a.stl": STL, f"bad{suffix}": content, "b.stl": STL}
    before, peak = processor_time_of_children(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    with Meshes(files.get) as meshes:
        counts = [len(meshes.scaled(name, ONE)) for name in [*files, f"bad{suffix}"]]
    assert counts == [1, 0, 1, 0]
    (record,) = caplog.records
    assert record.getMessage() == f"mesh 'bad{suffix}' is left out: {reason}"
    assert processor_time_of_children() - before < 10
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # the peak of a child includes that of its parent
    after = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    assert after * 1024 < max(MAX_MESH_MEMORY, max(peak, own) * 1024 + 1)


def test_instances_that_can_be_drawn_are():
    with Meshes({"a.dae": doubling(5)}.get) as meshes:
        assert sum(len(part.triangles) for part in meshes.scaled("a.dae", ONE)) == 32


def test_few_meshes_may_end_their_reader(caplog):
    """Each costs the start of a process: a thousand of them would take minutes."""
    names = [f"{i}.dae" for i in range(50)]
    with Meshes(dict.fromkeys(names, ITSELF).get) as meshes:
        assert not any(meshes.scaled(name, ONE) for name in names)
    texts = [record.getMessage() for record in caplog.records]
    assert sum("it crashes its reader" in text for text in texts) == MAX_FATAL_MESHES
    assert sum("other meshes crash their reader" in text for text in texts) == 50 - MAX_FATAL_MESHES


def test_time_of_a_robots_meshes_is_bounded(monkeypatch, caplog):
    """Each takes less than the limit of one mesh; a new reader has the remaining time.

    The limit is four times what this machine takes for the first mesh; 24 meshes would take more than twelve times.
    """
    before = processor_time_of_children()
    with Meshes({"a.dae": doubling(11)}.get) as meshes:
        assert len(meshes.scaled("a.dae", ONE)) == 2**11
    limit = math.ceil(4 * (processor_time_of_children() - before))
    monkeypatch.setattr(meshes_module, "MAX_MESHES_SECONDS", limit)
    monkeypatch.setattr(meshes_module, "MAX_TRIANGLES", 2**40)
    monkeypatch.setattr(meshes_module, "MAX_SURFACES", 2**20)
    names = [f"{i}.dae" for i in range(24)]
    before = processor_time_of_children()
    with Meshes(dict.fromkeys(names, doubling(11)).get) as meshes:
        drawn = [len(meshes.scaled(name, ONE)) for name in names]
    assert drawn[0] == 2**11 and drawn[-1] == 0
    assert f"have taken more than {limit} s" in caplog.text
    assert processor_time_of_children() - before < 2 * limit


def test_triangles_of_a_robot_are_bounded(caplog):
    """A page of them would take gigabytes, whether from one file or from many uses of one."""
    many = MAX_TRIANGLES // 4
    content = bytes(80) + struct.pack("<I", many) + FACET * many
    with Meshes({"a.stl": content}.get) as meshes:
        drawn = [len(meshes.scaled("a.stl", ONE)) for _ in range(6)]
    assert drawn == [1, 1, 1, 1, 0, 0]
    (record,) = caplog.records
    assert f"more than {MAX_TRIANGLES} triangles" in record.getMessage()


def test_without_trimesh_a_dae_has_no_colours(monkeypatch):
    monkeypatch.setattr(meshes_module, "find_spec", {"collada": True}.get)
    with Meshes({"a.dae": doubling(1)}.get) as meshes:
        (part,) = meshes.scaled("a.dae", ONE)
        assert [*meshes._readers] == ["shape"]
    assert part.colour is None and len(part.triangles) == 2


def test_without_coal_a_mesh_is_left_out(tmp_path, monkeypatch, caplog):
    """One child names the missing package for all meshes."""
    (tmp_path / "coal.py").write_text("raise ImportError('there is no coal', name='coal')")
    monkeypatch.syspath_prepend(tmp_path)
    with Meshes({"a.stl": STL, "b.stl": STL}.get) as meshes:
        assert meshes.scaled("a.stl", ONE) == []
        reader = meshes._readers["shape"]
        assert meshes.scaled("b.stl", ONE) == []
        assert meshes._readers["shape"] is reader
    texts = [record.getMessage() for record in caplog.records]
    reason = "there is no coal; install the package 'coal'"
    assert texts == [f"mesh '{name}.stl' is left out: {reason}" for name in "ab"]


def head(*rows: tuple[object, ...]) -> bytes:
    return json.dumps(rows).encode()


POINTS, TRIANGLE = np.eye(3).tobytes(), struct.pack("<3I", 0, 1, 2)
WHITE = (3, 1, 1, 1, 1)
FORGED = {
    "no JSON": ([b"\x80\x04cos\nsystem\n"], "answer is invalid"),
    "other JSON": ([b'{"a": 1}'], "answer is invalid"),
    "other numbers": ([head((3, 1, 1, 1))], "answer is invalid"),
    "a small negative size": ([head((-1, 0, 1, 1, 1), (4, 1, 1, 1, 1)), POINTS, TRIANGLE], "answer is invalid"),
    "nothing drawn": ([b"[]", b"", b""], "no triangles"),
    "a negative size": ([head((-8, 1, 1, 1, 1), (11, 0, 1, 1, 1))], "answer is invalid"),
    "too many": ([head((10**12, 1, 1, 1, 1))], "answer is too long"),
    "deep JSON": ([b"[" * 100_000], "answer is invalid"),
    "a vertex beyond": ([head(WHITE), POINTS, struct.pack("<3I", 0, 1, 3)], "do not exist"),
    "a vertex too few": ([head(WHITE), POINTS[24:], TRIANGLE], "answer is invalid"),
    "half a vertex": ([head(WHITE), POINTS[4:], TRIANGLE], "answer is invalid"),
    "no number": ([head(WHITE), np.full(9, np.nan).tobytes(), TRIANGLE], "not finite"),
    "a flood": ([bytes(10**8)], "crashes its reader"),
    "nothing": ([], "crashes its reader"),
}


@pytest.mark.parametrize(("answers", "reason"), FORGED.values(), ids=FORGED)
def test_forged_answers_of_a_reader_are_refused(answers, reason, monkeypatch, caplog):
    """Injected code may send any answer; a pickle would run code."""
    monkeypatch.setattr(meshes_module, "serve", forging(answers))
    with Meshes({"a.stl": STL}.get) as meshes:
        assert meshes.scaled("a.stl", ONE) == []
    assert reason in caplog.text and len(caplog.records) == 1


class forging:  # noqa: N801
    """A reader with a forged answer; a class, because a function that is sent to a child needs a name."""

    def __init__(self, answers: list[bytes]) -> None:
        self.answers = answers

    def __call__(self, pipe: Connection, kind: str, folder: Path, seconds: int) -> None:
        pipe.recv()
        for answer in self.answers:
            pipe.send_bytes(answer)


ROBOT = """<robot name="pair"><link name="base"/><link name="arm"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><geometry><mesh filename="bad.dae"/></geometry></visual>
<visual><geometry><mesh filename="good.stl"/></geometry></visual></link>
<joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
</joint></robot>"""


def test_all_that_draws_goes_on(tmp_path, monkeypatch, caplog):
    """run --scene, view and page of a robot with such a mesh; build includes the file."""
    monkeypatch.chdir(tmp_path)
    for name, content in {"r.urdf": ROBOT.encode(), "bad.dae": ITSELF, "good.stl": STL}.items():
        Path(name).write_bytes(content)
    assert main(["build", "--native", "r.urdf", "--axes", "x", "-o", "R.fmu", "--frame", "arm"]) == 0
    run, view = "run R.fmu --scene --stop-time 0.1 -o bag", "view bag --export bag.html"
    for command in (run, view, "page R.fmu -o page.html"):
        caplog.clear()
        assert main(command.split()) == 0, command
        warnings = [r.getMessage() for r in caplog.records if "bad.dae" in r.getMessage()]
        assert len(warnings) == 1, (command, caplog.text)
        assert "Segmentation fault" in warnings[0]
    assert twodof.read_bag("bag").q.shape == (11, 1)
