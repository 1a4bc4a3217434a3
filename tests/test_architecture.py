"""The house: which room may import which, and which room owns each outside library."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

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
    "control": {"core", "engine"},
    "live": {"core", "logs", "system", "engine", "estimation", "control"},
    "robots/go1": {"core", "logs", "system", "engine", "estimation", "control", "live"},
    "study": {"core", "system", "engine", "estimation", "robots/go1"},
    "report": {"core", "logs", "system", "estimation", "study"},
    "api": {"core", "logs", "system", "engine", "estimation", "live", "report", "robots/go1"},
    "cli": {
        "api",
        "core", "logs", "system", "init", "engine", "estimation", "live", "report", "study", "robots/go1",
    },
}  # fmt: skip
#: Imports that the move left behind; each is to go.
TO_GO: dict[str, set[str]] = {}

#: Outside library -> the rooms, or single files, that may import it.
WALLS = {
    "click": ("cli",),
    "cmaes": ("estimation",),
    "cyclonedds": ("robots/go1",),
    "distributed": ("core/executors.py",),
    "h5py": ("logs",),
    "imageio_ffmpeg": ("robots/go1/video.py",),
    "jinja2": ("report",),
    "lz4": ("logs",),
    "markupsafe": ("report",),
    "matplotlib": ("report",),
    "mcap": ("logs",),
    "motioncapture": ("robots/go1",),
    "mujoco": ("system", "init", "engine", "robots/go1", "api/identify.py"),
    "natnet": ("robots/go1",),
    "pyarrow": ("logs",),
    "pyulog": ("logs",),
    "rich": ("report", "api", "cli"),
    "rosbags": ("logs",),
    "yaml": ("logs", "system", "init", "core/belief_file.py", "core/yaml_file.py"),
    "zstandard": ("logs",),
}

MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
ROOMED = [module for module in MODULES if module not in ("__init__.py", "__main__.py")]


def room_of(parts: list[str]) -> str:
    """'robots/go1' of robots/go1/link/wire.py; else the first folder."""
    depth = 2 if parts[0] == "robots" else 1
    return "/".join(part.removesuffix(".py") for part in parts[:depth])


def imports_of(module: str) -> Iterator[str]:
    """Dotted names that a module imports anywhere, in function bodies and for type checking too."""
    for node in ast.walk(ast.parse((PACKAGE / module).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def rooms_imported(module: str) -> set[str]:
    parts = [name.split(".") for name in imports_of(module)]
    return {room_of(part[1:]) for part in parts if part[0] == "amhe_cli" and len(part) > 1} - {"__version__"}


def forbidden(module: str) -> set[str]:
    room = room_of(module.split("/"))
    return rooms_imported(module) - {room} - ALLOWED.get(room, set()) - TO_GO.get(room, set())


def test_each_room_imports_only_what_it_may() -> None:
    wrong = {
        module: rooms for module in ROOMED if (rooms := forbidden(module)) and module != "robots/__init__.py"
    }
    assert not wrong, "see ALLOWED, and docs/ARCHITECTURE.md"


def test_allowed_imports_make_no_circle() -> None:
    left = dict(ALLOWED)
    while left:
        free = {room for room, below in left.items() if not below & set(left)}
        assert free, f"these import each other: {sorted(left)}"
        left = {room: below for room, below in left.items() if room not in free}


@pytest.mark.parametrize("library", WALLS)
def test_an_outside_library_is_imported_by_its_own_room(library: str) -> None:
    owners = WALLS[library]
    wrong = [
        module
        for module in ROOMED
        if library in {name.split(".")[0] for name in imports_of(module)}
        and room_of(module.split("/")) not in owners
        and module not in owners
    ]
    assert not wrong, f"{library} belongs to {owners}"


def test_modules_stay_short() -> None:
    lines = {m: len((PACKAGE / m).read_text(encoding="utf-8").splitlines()) for m in ROOMED}
    assert {module: count for module, count in lines.items() if count > 350} == {}


def test_a_class_name_means_one_thing() -> None:
    places: dict[str, list[str]] = {}
    for module in MODULES:
        for node in ast.walk(ast.parse((PACKAGE / module).read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(module)
    places["Path"] = ["pathlib", *places.get("Path", ())]
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


def texts_of(module: str) -> Iterator[str]:
    """String constants of a module, docstrings left out."""
    tree = ast.parse((PACKAGE / module).read_text(encoding="utf-8"))
    docs = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            yield node.value


#: Texts may name the options of a whole command: 'amhe eval --report', 'dask worker ... --nthreads'.
OF_A_COMMAND = re.compile(r"`?(amhe \w+|dask worker|mavlogdump.py)[^`]*|--nthreads 1`")


def test_the_library_speaks_of_arguments_not_of_options() -> None:
    option = re.compile(r"(^|[\s('\"`])--[a-z]")
    library = [module for module in ROOMED if not module.startswith("cli/")]
    wrong = [(m, text) for m in library for text in texts_of(m) if option.search(OF_A_COMMAND.sub("", text))]
    assert not wrong, "write the argument in backquotes; cli/wording.py makes an option of it"


def test_the_library_reads_no_environment_and_no_arguments() -> None:
    """But for the environment of child processes, and MuJoCo's own variable for its renderer."""
    own = {"core/executors.py", "robots/go1/link/child.py", "robots/go1/video.py"}
    library = [m for m in ROOMED if not m.startswith("cli/") and m not in own]
    wrong = [m for m in library if re.search(r"os\.environ|os\.getenv|sys\.argv", (PACKAGE / m).read_text())]
    assert not wrong
