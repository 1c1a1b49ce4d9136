"""The rooms of the package: imports, third-party libraries, and limits of length."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PYTHON = {
    path.relative_to(ROOT): ast.parse(path.read_text("utf-8"))
    for folder in ("twodof", "fmu_src", "meshes")
    for path in sorted((ROOT / folder).rglob("*.py"))
}

ROOMS = {
    "errors": "what can go wrong, in words; needs nothing",
    "signatures": "keywords that functions share",
    "bounds": "on files of others, in numbers",
    "version": "of this package and of others",
    "files": "files and folders, whoever's they are",
    "children": "processes of our own, confined where they read what others wrote",
    "notebook": "HTML of results for notebooks",
    "plant": "the equations and the URDF; goes into the FMU, which has none of what follows",
    "geometry": "of a URDF, for all that shows or transforms",
    "export": "makes an FMU of the plant, and runs none",
    "fmu": "an FMU's file and an instance of it, whoever made it, checked",
    "simulation": "what an FMU is to do, checked, and the master that has it done",
    "linear": "an FMU's derivatives, at an operating point that is checked",
    "ros": "what ROS 2 is told of a run",
    "bag": "what ros says, kept and read back",
    "sweeps": "many runs, and a bag of each",
    "plots": "figures of bags and sweeps",
    "identification": "a robot's parameters, of what bags hold, and a page of them",
    "testing": "assertions for tests of users",
    "pages": "in the browser, what plots know and bags hold",
    "cli": "all of it, by a command",
}
"""From the bottom to the top: each may import those above it in this list, and why it is there."""

LIBRARIES = {
    "coal": {"geometry"},  # meshes
    "cyclonedds": {"ros"},
    "distributed": {"sweeps"},
    "ecospy": {"fmu"},
    "fmpy": {"fmu"},
    "fmuloader": {"fmu"},
    "libcosimpy": {"fmu"},
    "foxglove": {"pages"},
    "lz4": {"bag"},
    "IPython": {"notebook"},
    "imageio_ffmpeg": {"plots"},
    "matplotlib": {"plots"},
    "pandas": {"sweeps", "bag", "plots", "pages", "cli"},  # tables: made, of a recording, drawn, shown, printed
    "pathsim": {"fmu"},
    "pathsim_fmi": {"fmu"},
    "pinocchio": {"plant", "identification"},  # its regressors
    "plotly": {"plots"},
    "pyarrow": {"sweeps", "bag"},
    "pytest": {"testing"},
    "pythonfmu": {"export"},  # the slave in fmu_src is handed its base class
    "rosbags": {"ros", "bag"},
    "scipy": {"export", "geometry", "identification"},  # its rotations; filters and least squares
    "simpleeval": {"export"},
    "tqdm": {"simulation"},
    "trimesh": {"geometry"},
    "websockets": {"pages"},
    "xacro": {"export"},
}

FOR_ALL = ("bounds", "notebook", "signatures", "version")
MOST_LINES, MOST_OF_A_FUNCTION, MOST_FILES, MOST_ARROWS = 350, 60, 10, 79


def imported(path: Path) -> set[str]:
    """Dotted names of the imports of a file, also inside functions and for types alone."""
    names = set()
    for node in ast.walk(PYTHON[path]):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = [*path.parts[: -node.level], node.module] if node.level else [node.module]
            base = ".".join(filter(None, module))
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def room(path: Path) -> str:
    """A folder or a file of the package, or else the folder of the checkout."""
    parts = path.with_suffix("").parts
    return parts[1] if parts[0] == "twodof" else parts[0]


def test_a_room_imports_only_rooms_above_it():
    order = list(ROOMS)
    inside = {path for path in PYTHON if path.parts[0] == "twodof"}
    assert {room(path) for path in inside} == {*order, "__init__", "__main__"}
    for path in inside:
        if room(path) in ROOMS:  # __init__ and __main__ are the door to all
            own = {name.split(".")[1] for name in imported(path) if name.startswith("twodof.")}
            assert own <= {*order[: order.index(room(path)) + 1]}, path


def test_rooms_import_few_others():
    arrows = {
        (room(path), other)
        for path in PYTHON
        for other in {name.split(".")[1] for name in imported(path) if name.startswith("twodof.")}
        if path.parts[0] == "twodof" and other in ROOMS and other not in (room(path), *FOR_ALL)
    }
    assert len(arrows) <= MOST_ARROWS


def test_modules_have_no_import_cycle():
    modules = {".".join(path.with_suffix("").parts): path for path in PYTHON}
    graph = {}
    for module, path in modules.items():
        names = imported(path)
        graph[module] = {*names, *(name.rpartition(".")[0] for name in names)} & modules.keys()
    assert [*TopologicalSorter(graph).static_order()]  # which raises CycleError


def test_a_third_party_library_is_imported_only_in_its_room():
    rooms: dict[str, set[str]] = {library: set() for library in LIBRARIES}
    for path in PYTHON:
        for library in {name.partition(".")[0] for name in imported(path)} & LIBRARIES.keys():
            rooms[library].add(room(path))
    assert rooms == LIBRARIES


def test_files_functions_and_lines_are_short():
    sources = [p for kind in ("*.[ch]", "*.js") for p in (ROOT / "fmu_src").rglob(kind)]
    sources += (ROOT / "twodof").rglob("*.js")
    files = [*PYTHON, *(path.relative_to(ROOT) for path in sources)]
    lines = {str(path): (ROOT / path).read_text("utf-8").count("\n") for path in files}
    long = {name for name, count in lines.items() if count > MOST_LINES}
    for path, tree in PYTHON.items():
        functions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
        for f in functions:
            if f.end_lineno is not None and f.end_lineno - f.lineno >= MOST_OF_A_FUNCTION:
                long.add(f"{path}:{f.name}")
    assert not long


def test_the_package_has_few_files_outside_of_its_rooms():
    files = {path.name for path in (ROOT / "twodof").glob("*.py")}
    assert len(files) <= MOST_FILES


def test_no_two_files_of_the_package_have_one_name():
    names = [path.name for path in PYTHON if path.parts[0] == "twodof" and path.name != "__init__.py"]
    assert len(names) == len({*names}), sorted(name for name in names if names.count(name) > 1)


RIDDLES = {"What", "Of", "Who", "Whose", "How", "That", "Which", "Beside", "Whether", "Where", "When", "If"}
VERBS = re.findall(
    r"\w+",
    """
    Add Advance Append Apply Bound Build Change Check Close Compare Compile Complete Compose Confine Convert Count
    Assert Create Decode Deserialise Design Determine Discard Do Draw End Execute Exit Expand Find Fit Flush Format Free
    Import Install Instantiate Integrate Join Judge Keep Let Limit Load Lock Make Mark Match Measure Merge Move Name
    Note Open Pack Parse Pass Prevent Print Publish Put Queue Quote Raise Read Receive Refuse Register Reject Remove
    Replace Replay Report Reset Resolve Restart Restore Restrict Return Rotate Round Run Sample Save Say Send Set
    Show Simulate Split Start Stay Step Stop Store Subtract Take Transform Wait Warn Write Yield
    """,
)
"""The first words of a function's docstring."""


def is_property(node: ast.AST) -> bool:
    return any("property" in ast.unparse(decorator) for decorator in getattr(node, "decorator_list", []))


def fragments(tree: ast.AST) -> list[str]:
    """Return first lines of docstrings that are not a noun phrase or, for functions, do not begin with a verb."""
    nodes = (node for node in ast.walk(tree) if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef))
    found = []
    for node in nodes:
        words = (ast.get_docstring(node) or "Return it.").split()
        is_phrase = isinstance(node, ast.Module | ast.ClassDef) or is_property(node)
        first = words[0].rstrip(":,.")
        if len(words) < 2 or first in RIDDLES or not (is_phrase or first in VERBS):
            found.append((ast.get_docstring(node) or "").partition("\n")[0])
    return found


def test_a_docstring_begins_with_a_verb_or_is_a_noun_phrase():
    texts = [(ROOT / folder).rglob("*.py") for folder in ("docs", "benchmarks")]
    scripts = {path.relative_to(ROOT): ast.parse(path.read_text("utf-8")) for paths in texts for path in paths}
    found = [f"{path}: {line}" for path, tree in (PYTHON | scripts).items() for line in fragments(tree)]
    for path in (ROOT / "tests").glob("*.py"):
        lines = re.findall(r'^ *"""(\w+)[^\n]*', path.read_text("utf-8"), re.MULTILINE)
        found += [f"{path.name}: a docstring begins with {word}" for word in lines if word in RIDDLES]
    assert not found, "\n".join(found)


def test_a_message_of_the_library_names_arguments():
    """The command line translates them; exceptions are commands on sweep pages and options of the pytest plugin."""
    option = re.compile(r"(?<!pip install)(?:^|[\s'`(])--[a-z]")
    library = (path for path in PYTHON if "cli" not in path.parts and path.name not in ("maps.py", "plugin.py"))
    found = [
        f"{path}:{node.lineno}: {node.value}"
        for path in library
        for node in ast.walk(PYTHON[path])
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and option.search(node.value)
    ]
    assert not found, "\n".join(found)


def test_one_function_prints():
    """It escapes control and bidirectional characters."""
    calls = {
        str(path)
        for path, tree in PYTHON.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print"
    }
    assert {path for path in calls if path.startswith("twodof")} == {"twodof/cli/printing.py"}
