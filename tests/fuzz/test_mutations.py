"""Commands on mutated files succeed, or fail with one clear line.

Case i of a kind uses ``random.Random(i)``, so that a failing case runs again by its name, which contains the seed.
"""

from __future__ import annotations

import re
import shutil
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path
from random import Random

import mutations
import pytest
from bags import SECOND, joint_message, write_third_party
from jail import SECRET, Jail, Outcome, check_reading
from jail import jail as jail
from jail import the_jail as the_jail
from rosbags.rosbag2 import StoragePlugin

import twodof

pytestmark = pytest.mark.long

CASES, ALL_CASES = 20, 1000
ROOT = Path(__file__).parents[2]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Generate all cases with --full."""
    if "seed" in metafunc.fixturenames:
        full = metafunc.config.getoption("full")
        metafunc.parametrize("seed", range(ALL_CASES if full else CASES))


# --- FMUs ---

TEXTS = {
    "modelDescription.xml": mutations.xml,
    "modelDescription.xm": mutations.xml,
    "resources/.*urdf": mutations.xml,
    "resources/.*stl": mutations.blind,
    "(documentation|sources|model.png)": mutations.text,
}
FMU = mutations.several(mutations.container, mutations.member(TEXTS, kept="binaries/"), most=1)
PYTHON_FMU = mutations.member({"resources/.*[.]py": mutations.text, "resources/.*(txt|json)": mutations.json_tree})


@pytest.fixture(scope="module")
def fmi3_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default arm's native FMU of FMI 3.0, whose vectors are arrays."""
    options = twodof.FmuOptions(native=True, fmi=3)
    return twodof.build_fmu(tmp_path_factory.mktemp("fmi3") / "TwoDof-3.fmu", options)


def test_mutated_fmu(seed: int, jail: Jail, native_path: Path, fmi3_path: Path, fmu_path: Path) -> None:
    rng = Random(seed)
    python = rng.random() < 0.1
    native = rng.choice((native_path, fmi3_path))
    mutation = PYTHON_FMU if python and rng.random() < 0.7 else FMU
    fmu = jail.input / "mutated.fmu"
    fmu.write_bytes(mutation(rng, (fmu_path if python else native).read_bytes()))
    bag = jail.target / "bag"
    jail.run("info", fmu)
    assert list(jail.target.iterdir()) == []
    scene = rng.choice(([], ["--scene"]))
    outcome = jail.run("run", fmu, "--stop-time", "0.05", "-o", bag, *scene, prints=python)
    check_bag(jail, bag, outcome)


def check_bag(jail: Jail, bag: Path, outcome: Outcome) -> None:
    """Assert that a refused run leaves no bag, and a run that ended later a readable bag."""
    if outcome.status == 0 or bag.exists():
        assert jail.run("info", bag).status == 0
    assert set(jail.target.iterdir()) <= {bag}


# --- SSP files ---

SYSTEM = mutations.member({".*ssd": mutations.xml, ".*ssv": mutations.xml})
SSP = mutations.several(mutations.container, SYSTEM, SYSTEM, SYSTEM, most=1)


@pytest.fixture(scope="module")
def ssp(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The split default arm, with a stated unit of one connector and a transformation of one connection."""
    path = twodof.build_fmu(tmp_path_factory.mktemp("ssp") / "arm.ssp", twodof.FmuOptions(part="split"))
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    text = members["SystemStructure.ssd"].decode()
    text, angles = re.subn(r'(name="q\[1\]" kind="input">\s*<ssc:Real) />', r'\1 unit="rad"/>', text)
    turn = '<ssc:LinearTransformation factor="2" offset="0.1"/></ssd:Connection>'
    text, turns = re.subn(r'(<ssd:Connection [^>]*startConnector="v\[1\]"[^>]*) />', rf"\1>{turn}", text)
    assert (angles, turns) == (1, 1)
    unit = '<ssc:Unit name="rad"><ssc:BaseUnit rad="1"/></ssc:Unit>'
    text = text.replace("<ssd:DefaultExperiment", f"<ssd:Units>{unit}</ssd:Units><ssd:DefaultExperiment")
    members["SystemStructure.ssd"] = text.encode()
    path.write_bytes(mutations.zip_of(members))
    assert twodof.simulate(path, stop_time=0.02).verdict.samples == 3
    return path.read_bytes()


def test_mutated_ssp(seed: int, jail: Jail, ssp: bytes) -> None:
    system = jail.input / "mutated.ssp"
    system.write_bytes(SSP(Random(seed), ssp))
    bag = jail.target / "bag"
    jail.run("info", system)
    assert list(jail.target.iterdir()) == []
    check_bag(jail, bag, jail.run("run", system, "--stop-time", "0.05", "-o", bag))


# --- URDFs ---


@pytest.fixture(scope="module")
def urdfs(ur5: str, panda: str) -> list[tuple[bytes, list[str]]]:
    """URDFs and their options on the command line."""
    shipped = (ROOT / "urdf/2dof.urdf").read_bytes()
    robots = [(shipped, ["--frame", "EndEffector", "--axes", "xy"])]
    for text, frame in ((ur5, "tool0"), (panda, "panda_link8")):
        tree = ET.fromstring(text)
        for mesh in tree.iter("mesh"):  # small ones: their size is not what is tested
            mesh.set("filename", "package://meshes/link1.stl")
        for i, joint in enumerate(tree.iter("joint")):
            if i % 3 == 1 and joint.get("type") == "revolute":
                joint.set("type", "prismatic")
        robots.append((ET.tostring(tree), ["--frame", frame]))
    return robots


def test_mutated_urdf(seed: int, jail: Jail, urdfs: list[tuple[bytes, list[str]]]) -> None:
    rng = Random(seed)
    data, options = rng.choice(urdfs)
    urdf = jail.input / "mutated.urdf"
    urdf.write_bytes(mutations.xml(rng, data))
    meshes = jail.input / "meshes"
    shutil.copytree(ROOT / "meshes", meshes, ignore=shutil.ignore_patterns("*.py"))
    fmu = jail.target / "new.fmu"
    outcome = jail.run("build", "--urdf", urdf, "--mesh-dir", meshes, "-o", fmu, *options)
    assert list(jail.target.iterdir()) == ([] if outcome.status else [fmu])
    if outcome.status == 0:
        with zipfile.ZipFile(fmu) as archive:
            contents = [archive.read(name) for name in archive.namelist()]
        assert not any(SECRET in content or b"root:x:0:0" in content for content in contents)


# --- CSVs ---


def test_mutated_csv(seed: int, jail: Jail, native_path: Path) -> None:
    rng = Random(seed)
    rows = [f"{0.005 * k:g},{0.2 + 0.001 * k:g},{0.05 - 0.002 * k:g},{80 + k}" for k in range(20)]
    csv = jail.input / "mutated.csv"
    csv.write_bytes(mutations.csv(rng, "\n".join(["time,x_des[1],x_des[2],Kp[1]", *rows]).encode()))
    bag = jail.target / "bag"
    outcome = jail.run("run", native_path, "--input", csv, "--stop-time", "0.1", "-o", bag)
    check_bag(jail, bag, outcome)


# --- bags ---

STORAGE_FILES = {".mcap": mutations.mcap, ".db3": mutations.sqlite}
BAG_FILES = {**STORAGE_FILES, ".yaml": mutations.text, ".json": mutations.json_tree}
BAGS = ("mcap", "mcap scene", "sqlite3", "sqlite3 scene", "mcap zstd", "sqlite3 foreign")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory, native_path: Path) -> dict[str, Path]:
    """Bags of this package, and of rosbags with other options."""
    folder = tmp_path_factory.mktemp("bags")
    for name in BAGS:
        storage, _, kind = name.partition(" ")
        if kind in ("", "scene"):
            run = twodof.experiment(native_path, stop_time=0.3)
            twodof.simulate(run, twodof.Bag(folder / name, storage=storage, scene=bool(kind)))
        else:
            write_foreign_bag(folder / name, StoragePlugin[storage.upper()], zstd=kind == "zstd")
    return {name: folder / name for name in BAGS}


def write_foreign_bag(path: Path, storage: StoragePlugin, *, zstd: bool) -> None:
    messages = (
        (topic, k * SECOND // 10, joint_message(k * SECOND // 10, "ab", (k, -k / 7), (k, -k / 7)))
        for k in range(40)
        for topic in ("/arm/joint_states", "/joint_states")
    )
    write_third_party(path, messages, storage_plugin=storage, zstd=zstd)


def test_mutated_bag(seed: int, jail: Jail, bags: dict[str, Path]) -> None:
    rng = Random(seed)
    bag = jail.target / "bag"
    shutil.copytree(bags[rng.choice(BAGS)], bag)
    mutate_bag(rng, bag, bags)
    check_reading(jail, bag)


def mutate_bag(rng: Random, bag: Path, bags: dict[str, Path]) -> None:
    """Change the content of its files once or twice, and sometimes the files themselves."""
    for _ in range(rng.randint(1, 2)):
        files = sorted(path for path in bag.iterdir() if path.suffix in BAG_FILES)
        storage = [path for path in files if path.suffix in STORAGE_FILES]
        file = rng.choice(rng.choice((storage, storage, storage, files)) or [bag / "x.mcap"])
        kind = rng.randrange(10)
        if kind == 0 and file.exists():
            file.unlink()
        elif kind == 1 and file.exists():
            file.rename(bag / rng.choice(("x_1.mcap", "x_1.db3", "metadata.yaml", "run.json", "x")))
        elif kind == 2:  # a file of another bag
            other = rng.choice(sorted(bags[rng.choice(BAGS)].iterdir()))
            shutil.copyfile(other, bag / rng.choice((file.name, other.name)))
        elif kind == 3:  # what SQLite would take for its own, and our reserve
            ending = rng.choice(("-wal", "-journal", "-shm", ".zstd", ".unfinished"))
            (bag / (file.name + ending)).write_bytes(file.read_bytes() if file.exists() else b"x")
        elif file.exists():
            file.write_bytes(BAG_FILES[file.suffix](rng, file.read_bytes()))
