"""The house: which room may import which, and which room owns each outside library."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

import amhe_cli

PACKAGE = Path(__file__).parents[1] / "amhe_cli"

#: Room -> the rooms that it may import, besides itself. A new import needs a new entry, and a reason.
ALLOWED: dict[str, set[str]] = {
    "core": set(),
    "logs": {"core"},
    "system": {"core"},
    "init": {"core", "logs", "system"},
    "engine": {"core", "system"},
    "matching": {"core", "system", "engine"},
    "estimation": {"core", "logs", "system", "engine", "matching"},
    "check": {"core", "logs", "system", "engine", "matching", "estimation"},
    "web": {"core"},
    "view": {"core", "logs", "system", "engine", "matching", "estimation", "web"},
    "control": {"core", "engine"},
    "live": {"core", "logs", "system", "engine", "estimation", "control"},
    "robots/go1": {"core", "logs", "system", "engine", "estimation", "control", "live"},
    "study": {"core", "system", "engine", "estimation", "robots/go1"},
    "audit": {"core", "system", "init", "engine", "estimation", "check"},
    "report": {"core", "logs", "system", "estimation", "study", "check", "audit", "web"},
    "api": {"core", "logs", "system", "engine", "estimation", "live", "report", "robots/go1", "view"},
    "cli": {
        "api",
        "core", "logs", "system", "init", "engine", "estimation", "audit", "live", "report", "study",
        "robots/go1", "view", "check",
    },
}  # fmt: skip

#: Room -> its inner rooms, each of which may import those before it; '' are the files beside them.
INNER: dict[str, tuple[str, ...]] = {"system": ("model", "parameters", "description", "", "export")}

#: Functions that are still longer than 60 lines: these are to be cut, and none added.
STILL_LONG: set[tuple[str, str]] = set()

#: Outside library -> the rooms, or single files, that may import it.
WALLS = {
    "click": ("cli",),
    "cmaes": ("estimation",),
    "cupy": ("engine",),
    "cyclonedds": ("logs",),
    "distributed": ("study/executors.py",),
    "foxglove": ("logs",),
    "google": ("logs",),
    "h5py": ("logs",),
    "jinja2": ("web",),
    "lz4": ("logs",),
    "markupsafe": ("web", "report", "view"),
    "mcap": ("logs",),
    "motioncapture": ("robots/go1",),
    "mujoco": ("system", "init", "check", "audit", "engine", "view", "robots/go1", "api/identify.py"),
    "mujoco_menagerie": ("init",),
    "mujoco_warp": ("engine",),
    "natnet": ("robots/go1",),
    "pyarrow": ("logs",),
    "pyulog": ("logs",),
    "rich": ("report", "api", "cli"),
    "rosbags": ("logs",),
    "warp": ("engine",),
    "yaml": ("logs", "system", "init", "core/belief.py", "core/yaml_file.py"),
    "zenoh": ("logs",),
    "zstandard": ("logs",),
}

#: Functions that import a module by its name.
DYNAMIC = ("import_module", "__import__")

MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
ROOMED = [module for module in MODULES if module not in ("__init__.py", "__main__.py")]


def room_of(parts: list[str]) -> str:
    """'robots/go1' of robots/go1/link/packets.py; else the first folder."""
    depth = 2 if parts[0] == "robots" else 1
    return "/".join(part.removesuffix(".py") for part in parts[:depth])


def text_of(module: str) -> str:
    return (PACKAGE / module).read_text(encoding="utf-8")


class Content(NamedTuple):
    """What the tests ask of a text; it is parsed once for all of them."""

    imports: frozenset[str]
    """Dotted names that it imports anywhere, in function bodies and for type checking too. Names that are
    taken from `import amhe_cli` are among them, and those that `import_module` is called with."""
    long: set[str]
    """Functions of more than 60 lines, without their signatures and docstrings."""
    classes: list[str]
    """Public ones."""
    texts: list[str]
    """String constants, docstrings left out."""


@cache
def content_of(text: str) -> Content:
    nodes = list(ast.walk(ast.parse(text)))
    documented = [node for node in nodes if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))]
    docs = {id(node.body[0].value) for node in documented if node.body and isinstance(node.body[0], ast.Expr)}
    return Content(
        frozenset(_imports(nodes)),
        {node.name for node in nodes if isinstance(node, ast.FunctionDef) and len(lines_of(node)) > 60},
        [node.name for node in nodes if isinstance(node, ast.ClassDef) and not node.name.startswith("_")],
        [
            node.value
            for node in nodes
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs
        ],
    )


def _imports(nodes: list[ast.AST]) -> Iterator[str]:
    package = {"amhe_cli"}
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
            package |= {alias.asname for alias in node.names if alias.name == "amhe_cli" and alias.asname}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "a relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif (
            isinstance(node, ast.Call)
            and getattr(node.func, "attr", getattr(node.func, "id", None)) in DYNAMIC
        ):
            name = ast.literal_eval(leading(node.args[0]))
            assert not name.startswith("."), "a relative import"
            yield name
    for node in nodes:
        if isinstance(node, ast.Attribute) and (dotted := dotted_name(node)):
            first, rest = dotted.split(".", 1)
            if first in package:
                yield f"amhe_cli.{rest}"


def dotted_name(node: ast.Attribute) -> str | None:
    """a.b.c of attributes of a plain name; None of anything else, as f().b."""
    if isinstance(node.value, ast.Name):
        return f"{node.value.id}.{node.attr}"
    inner = dotted_name(node.value) if isinstance(node.value, ast.Attribute) else None
    return f"{inner}.{node.attr}" if inner else None


def leading(name: ast.expr) -> ast.expr:
    """The constant that a name is or begins with, as in f"mujoco.{kind}"."""
    return name.values[0] if isinstance(name, ast.JoinedStr) else name


def inside_of(text: str) -> Iterator[list[str]]:
    """Dotted names within the package that a text imports, split; one that it exports counts for its home."""
    names = {f"amhe_cli.{name}": home for name, home in amhe_cli._HOMES.items()}
    parts = [names.get(name, name).split(".") for name in content_of(text).imports]
    yield from (part[1:] for part in parts if part[0] == "amhe_cli" and len(part) > 1)


def rooms_imported(text: str) -> set[str]:
    """Rooms that a module's text imports."""
    return {room_of(part) for part in inside_of(text) if not part[0].startswith("__")}


def modules_imported(text: str) -> set[str]:
    """Modules that a text imports, or imports names from."""
    found: set[str] = set()
    for part in inside_of(text):
        paths = ("/".join(part[:length]) + ".py" for length in range(len(part), 0, -1))
        found |= set(list(filter(MODULES.__contains__, paths))[:1])
    return found


def circles_of(imports: dict[str, set[str]]) -> list[set[str]]:
    """Groups of modules of which each imports, on some way, each other one."""
    reached: dict[str, set[str]] = {}
    for module in imports:
        waiting, reached[module] = [module], set()
        while waiting:
            fresh = imports[waiting.pop()] - reached[module]
            reached[module] |= fresh
            waiting += fresh
    groups = {
        frozenset(other for other in reached[module] if module in reached[other])
        for module in imports
        if module in reached[module]
    }
    return sorted(map(set, groups), key=sorted)


def inner_room_of(module: str) -> str:
    """'model' of system/model/urdf.py, '' of system/system.py."""
    return "/".join(module.split("/")[1:-1])


def forbidden(module: str, text: str) -> set[str]:
    room = room_of(module.split("/"))
    return rooms_imported(text) - {room} - ALLOWED.get(room, set())


def test_each_room_imports_only_what_it_may() -> None:
    wrong = {module: rooms for module in ROOMED if (rooms := forbidden(module, text_of(module)))}
    assert not wrong, "see ALLOWED, and docs/ARCHITECTURE.md"


@pytest.mark.parametrize(
    ("text", "rooms"),
    [
        ("from amhe_cli.control.mpopi import Mpopi", {"control"}),
        ("from amhe_cli import control", {"control"}),
        ("import amhe_cli.robots.go1.plant as plant", {"robots/go1"}),
        ("def late():\n    from amhe_cli.robots.go1 import plant", {"robots/go1"}),
        ("if TYPE_CHECKING:\n    from amhe_cli.live.recorder import Loop", {"live"}),
        ("import amhe_cli\namhe_cli.run()", {"api"}),
        ("import amhe_cli as amhe\namhe.Estimator(system).update({})", {"api"}),
        ("from amhe_cli import run", {"api"}),
        ("import amhe_cli.core.log\namhe_cli.live.loop.run()", {"live"}),
        ("from importlib import import_module\nimport_module('amhe_cli.robots.go1.plant')", {"robots/go1"}),
        ("import importlib\nimportlib.import_module(f'amhe_cli.robots.go1.{name}')", {"robots/go1"}),
        ("__import__('amhe_cli.cli.main')", {"cli"}),
        ("from amhe_cli.core.log import Log\nimport amhe_cli\nprint(amhe_cli.__version__)", set()),
    ],
)
def test_a_forbidden_import_is_found_however_it_is_written(text: str, rooms: set[str]) -> None:
    assert forbidden("matching/made_up.py", text) == rooms


@pytest.mark.parametrize("text", ["from . import cost", "import_module('.cost', __package__)"])
def test_a_relative_import_is_refused(text: str) -> None:
    with pytest.raises(AssertionError, match="relative"):
        forbidden("matching/made_up.py", text)


def test_the_controller_and_its_loop_know_no_legs() -> None:
    modules = [module for module in ROOMED if module.startswith(("control/", "live/"))]
    assert [m for m in modules if re.search(r"\b(foot|feet|legs?|gaits?|trunk)\b", text_of(m), re.I)] == []


def test_allowed_imports_make_no_circle() -> None:
    left = dict(ALLOWED)
    while left:
        free = {room for room, below in left.items() if not below & set(left)}
        assert free, f"these import each other: {sorted(left)}"
        left = {room: below for room, below in left.items() if room not in free}


def test_no_modules_import_each_other() -> None:
    imports = {module: modules_imported(text_of(module)) & set(ROOMED) for module in ROOMED}
    assert circles_of(imports) == []


def test_a_circle_is_found() -> None:
    imports = {"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set[str](), "e": {"e", "a"}}
    assert circles_of(imports) == [{"b", "c"}, {"e"}]
    late = "def late():\n    from amhe_cli.core import log\nimport amhe_cli.core.belief\namhe_cli.run()"
    assert modules_imported(late) == {"core/log.py", "core/belief.py", "api/runs.py"}


@pytest.mark.parametrize("room", INNER)
def test_inner_rooms_import_only_those_before_them(room: str) -> None:
    order = INNER[room]
    inside = [module for module in ROOMED if module.startswith(f"{room}/")]
    assert {inner_room_of(module) for module in inside} == set(order)
    climbs = {
        (module, other)
        for module in inside
        for other in modules_imported(text_of(module))
        if other.startswith(f"{room}/")
        and order.index(inner_room_of(other)) > order.index(inner_room_of(module))
    }
    assert not climbs


@pytest.mark.parametrize("library", WALLS)
def test_an_outside_library_is_imported_by_its_own_room(library: str) -> None:
    owners = WALLS[library]
    wrong = [
        module
        for module in ROOMED
        if library in {name.split(".")[0] for name in content_of(text_of(module)).imports}
        and room_of(module.split("/")) not in owners
        and module not in owners
    ]
    assert not wrong, f"{library} belongs to {owners}"


def test_functions_stay_short() -> None:
    long = {(module, name) for module in ROOMED for name in content_of(text_of(module)).long}
    assert long <= STILL_LONG


def lines_of(function: ast.FunctionDef) -> range:
    """Lines of a function, without its signature and its docstring."""
    body = function.body[1:] if ast.get_docstring(function) and function.body[1:] else function.body
    return range(body[0].lineno, (function.end_lineno or 0) + 1)


def test_a_class_name_means_one_thing() -> None:
    places: dict[str, list[str]] = {}
    for module in ROOMED:
        for name in content_of(text_of(module)).classes:
            places.setdefault(name, []).append(module)
    places["Path"] = ["pathlib", *places.get("Path", ())]
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


#: Texts may name the options of a whole command: 'amhe eval --report', 'dask worker ... --nthreads'.
OF_A_COMMAND = re.compile(r"`?(amhe \w+|dask worker|mavlogdump.py)[^`]*|--nthreads 1`")


def test_the_library_speaks_of_arguments_not_of_options() -> None:
    option = re.compile(r"(^|[\s('\"`])--[a-z]")
    library = [module for module in ROOMED if not module.startswith("cli/")]
    texts = [(module, text) for module in library for text in content_of(text_of(module)).texts]
    wrong = [(module, text) for module, text in texts if option.search(OF_A_COMMAND.sub("", text))]
    assert not wrong, "write the argument in backquotes; the command line makes an option of it"


def test_the_library_reads_no_environment_and_no_arguments() -> None:
    """But for the environment of a child process."""
    own = "robots/go1/link/process.py"
    library = [m for m in ROOMED if not m.startswith("cli/") and m != own]
    wrong = [m for m in library if re.search(r"os\.environ|os\.getenv|sys\.argv", text_of(m))]
    assert not wrong
