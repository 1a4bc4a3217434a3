"""The floors of the house: what each room may import, and which room owns each outside library."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "amhe_cli"

#: From the ground up; a room imports only from itself and from rooms before it.
FLOORS = (
    "core",
    "executors",
    "logs",
    "system",
    "engine",
    "go1",
    "go1_link",
    "poses",
    "first_errors",
    "first_states",
    "windows",
    "matching",
    "estimation",
    "online",
    "control",
    "emulator",
    "live",
    "evaluation",
    "report",
    "assembly",
    "replay_assembly",
    "run_assembly",
    "go1_assembly",
    "run_files",
    "eval_assembly",
    "probing",
    "cli",
)

#: Rooms on the same floor that leave each other alone, but for the file that says otherwise.
STRANGERS = {("system", "logs"), ("engine", "logs")}
EXCEPTIONS = {("system/init.py", "logs"), ("system/guess_signals.py", "logs")}

#: Outside library -> the rooms, or single files, that may know it.
WALLS = {
    "click": ("cli",),
    "cmaes": ("estimation",),
    "cyclonedds": ("poses",),
    "distributed": ("executors",),
    "imageio_ffmpeg": ("go1/video.py",),
    "jinja2": ("report",),
    "matplotlib": ("report",),
    "mcap": ("logs",),
    "motioncapture": ("poses",),
    "mujoco": ("system", "engine", "go1"),
    "natnet": ("poses",),
    "rich": ("report", "cli"),
    "rosbags": ("logs",),
    "yaml": ("logs", "system", "report/belief_file.py"),
}

MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
ROOMED = [module for module in MODULES if module not in ("__init__.py", "__main__.py")]


def room_of(module: str) -> str:
    return module.split("/")[0].removesuffix(".py")


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
    return {part[1] for part in parts if part[0] == "amhe_cli" and len(part) > 1} - {"__version__"}


@pytest.mark.parametrize("module", ROOMED)
def test_a_module_imports_only_from_its_own_room_and_the_floors_below(module: str) -> None:
    room = room_of(module)
    assert room in FLOORS, f"{room} has no floor yet: give it one here and in docs/ARCHITECTURE.md"
    for other in rooms_imported(module):
        assert FLOORS.index(other) <= FLOORS.index(room), f"{module} imports {other} from above"
        if (module, other) not in EXCEPTIONS:
            assert (room, other) not in STRANGERS, f"{module} imports its neighbour {other}"


@pytest.mark.parametrize("module", ROOMED)
def test_an_outside_library_is_known_to_one_room(module: str) -> None:
    for library in {name.split(".")[0] for name in imports_of(module)} & set(WALLS):
        owners = WALLS[library]
        assert room_of(module) in owners or module in owners, f"{module} imports {library}; {owners} may"


@pytest.mark.parametrize("module", ROOMED)
def test_a_module_stays_short(module: str) -> None:
    assert len((PACKAGE / module).read_text(encoding="utf-8").splitlines()) <= 350
