"""Expand a xacro file to a URDF, by the xacro package in a confined process.

A xacro file is a program: it has Python expressions, includes files and reads the environment. Here, simpleeval
evaluates the expressions, which have access to numbers, texts and data only. Files are read only from folders that may
contain a URDF's meshes. The environment is empty, and memory and time are limited.
"""

import ast
import errno
import io
import json
import logging
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from subprocess import DEVNULL

from ..bounds import MAX_XACRO_MEMORY, MAX_XACRO_SECONDS, MAX_XACRO_WAIT
from ..children import Child, confine, limit_time
from ..errors import BuildError
from ..files import check_file, fits, parsed
from ..version import install

LOG = logging.getLogger(__name__)
ALLOWED = {"builtins.id", "compile", "glob.glob/2", "sys._getframe"}  # audit events without effect outside the process
LONGEST = 6  # bytes of a character in JSON
MAX_REMARKS = 2000  # characters


def expand(path: Path, folders: Sequence[Path], most: int) -> str:
    """Return the URDF of a xacro file with the default values of its arguments.

    The file, its includes and packages must be in the folders. Each file and the URDF have at most ``most`` bytes. A
    BuildError names a refused access or another fault.
    """
    missing = [name for name in ("xacro", "simpleeval") if find_spec(name) is None]
    if missing:
        raise BuildError(f"cannot expand '{path}': there is no {' and no '.join(missing)}; {install('xacro')}")
    environment = {"LC_ALL": "C.UTF-8"}
    with Child(_expand, path, folders, most, MAX_XACRO_SECONDS, environment=environment, output=DEVNULL) as child:
        try:
            answer = parsed(child.receive(LONGEST * (most + 3 * MAX_REMARKS), MAX_XACRO_WAIT))
        except (EOFError, ValueError, RecursionError) as error:
            raise BuildError(f"cannot expand '{path}': {error}") from error
    if not fits(answer, (str, str, str)):
        raise BuildError(f"cannot expand '{path}': the answer of its reader is invalid")
    text, remarks, failure = answer
    if failure:
        raise BuildError(failure[:MAX_REMARKS])
    if remarks:
        LOG.warning("%s: xacro reports: %s", path, " ".join(remarks.split()))
    return str(text)


def _expand(pipe: Connection, path: Path, folders: Sequence[Path], most: int, seconds: int) -> None:
    """Expand the file in the child; send the URDF, the messages of xacro and a failure, as JSON and never as a pickle.

    The file may control this process once it has found an error in a library that reads it.
    """
    remarks, text, failure = io.StringIO(), "", ""
    try:
        text = _expanded(path, folders, most, seconds, remarks)
    except BuildError as error:
        failure = str(error)
    pipe.send_bytes(json.dumps([text, remarks.getvalue()[:MAX_REMARKS], failure[:MAX_REMARKS]]).encode())


def _expanded(path: Path, folders: Sequence[Path], most: int, seconds: int, remarks: io.StringIO) -> str:
    """Confine this process and return the URDF."""
    import xacro
    from xacro import substitution_args

    import_module("yaml")  # xacro imports it on use, which a confined process cannot
    os.environ.clear()
    xacro.safe_eval = _evaluate
    substitution_args._eval = _refuse_eval
    substitution_args._eval_find = lambda name: str(_package(name, folders))
    for name in ("isinstance", "repr", "type", "vars"):
        del xacro._global_symbols["python"][name]
    xacro.process_doc(xacro.parse("<a b='${math.pi}'/>"))  # imports the remaining modules
    confine(MAX_XACRO_MEMORY, 2 * seconds, folders)
    limit_time(seconds)  # SIGXCPU, before the kernel's SIGKILL
    sys.addaudithook(_guard(folders, most))
    try:
        with redirect_stdout(remarks), redirect_stderr(remarks):
            xacro.init_stacks(str(path))
            document = xacro.parse(None, str(path))
            xacro.process_doc(document)
            text = document.documentElement.toxml() + "\n"
    except Exception as error:
        raise BuildError(f"cannot expand '{path}': {_reason(error)}") from None
    if len(text) > most:
        raise BuildError(f"'{path}' expands to {len(text)} bytes; at most {most} are supported")
    return str(text)


def _reason(error: Exception) -> str:
    """Return an error in one line, with the remedy, if any."""
    from xacro.substitution_args import ArgException

    cause = error
    while getattr(cause, "exc", None) is not None:
        cause = cause.exc  # type: ignore[attr-defined]
    if isinstance(cause, ArgException):
        return (
            f"its argument '{cause}' has no default; expand it by the command xacro, which takes"
            " arguments, and build the result"
        )
    if isinstance(cause, OSError) and cause.filename is not None:
        return f"'{cause.filename}' cannot be read: {cause.strerror}"
    text = f"{cause}" or type(cause).__name__
    return " ".join(f"{text} {getattr(error, 'suffix', None) or ''}".split())


class _Every(set[str]):
    """Set that contains every name."""

    def __contains__(self, name: object) -> bool:
        return True


def _evaluate(expression: str, symbols: dict[str, object], _: object = None) -> object:
    """Return the value of an expression; this function replaces xacro's, which calls ``eval``."""
    import xacro
    from simpleeval import BASIC_ALLOWED_ATTRS, EvalWithCompoundTypes

    attributes = {
        **BASIC_ALLOWED_ATTRS,
        xacro.NameSpace: _Every(),
        xacro.YamlDictWrapper: _Every(),
        xacro.YamlListWrapper: BASIC_ALLOWED_ATTRS[list],
    }
    functions = {name: f for name, f in xacro._global_symbols.items() if callable(f)}
    evaluator = EvalWithCompoundTypes(functions=functions, names=symbols, allowed_attrs=attributes)
    tree = ast.parse(expression.strip(), mode="eval").body
    value: object = evaluator.eval(expression, previously_parsed=tree)
    return value


def _refuse_eval(*_: object) -> str:
    raise ValueError("$(eval …) is not supported; write ${…}")


def _package(name: str, folders: Sequence[Path]) -> Path:
    """Return the folder of a package, by the name of the folder or by its package.xml."""
    for folder in folders:
        for candidate in (folder / name, folder):
            declared = candidate / "package.xml"
            if candidate.is_dir() and (
                candidate.name == name or (declared.is_file() and f"<name>{name}</name>" in declared.read_text("utf-8"))
            ):
                return candidate
    where = " or ".join(f"'{folder}'" for folder in dict.fromkeys(folders))
    raise ValueError(f"package '{name}' not found in {where}; give the folder of the packages with `mesh_dir`")


def _guard(folders: Sequence[Path], most: int) -> Callable[[str, tuple[str, ...]], None]:
    """Install an audit hook that allows reading files in the folders, and no other system access."""

    def guard(event: str, arguments: tuple[str, ...]) -> None:
        if event in ("glob.glob", "open", "os.listdir", "os.scandir"):
            path = Path(os.path.realpath(arguments[0]))
            if not any(path.is_relative_to(folder) for folder in folders):
                where = " or ".join(f"'{folder}'" for folder in dict.fromkeys(folders))
                raise PermissionError(
                    errno.EACCES, f"it is not in {where}, the only folders that may be read", str(path)
                )
            if event == "open":
                if arguments[1] not in ("r", "rb"):
                    raise PermissionError(errno.EACCES, "a xacro file may not write", str(path))
                check_file(path, most)
        elif event not in ALLOWED:
            raise RuntimeError(f"a xacro file may not do that ({event})")

    return guard
