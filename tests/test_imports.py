"""Imports run one way: app → sources → estimators; config describes and may know only the errors."""

import re

from config.extensions import extensions
from tests import ROOT
from tests.imports import PACKAGES, edges, imported, modules
from tests.without import problems, with_dependents

MAY_IMPORT = {
    "estimators": ("estimators",),
    "sources": ("sources", "estimators"),
    "config": ("config", "estimators.errors"),
    "app": ("app", "sources", "config", "estimators"),
}
ROOMS = {
    "twin": set(),
    "engine": {"twin"},
    "study": {"twin"},
    "derive": {"engine", "study", "twin"},
    "charts": {"derive", "engine"},
    "render": {"charts", "derive", "engine", "study", "twin"},
    "scene": {"charts", "engine"},
    "explore": {"charts", "engine"},
    "record": {"explore", "engine", "twin"},
    "web": {"scene", "explore", "record", "render", "charts", "derive", "study", "engine", "twin"},
    "cli": {"web", "record", "render", "study", "engine", "twin"},
}
"""What each room of `app` imports of the others. Modules beside the rooms belong to all, and import none."""
IMPURE = {"os", "io", "time", "datetime", "logging", "socket", "subprocess", "threading", "asyncio", "random"}
"""What the numerics may not touch: files, clocks, logs, threads."""
IMPURE_HERE = {
    "numerics/cache.py": {"os"},  # where the compile cache is
    "numerics/cache_entries.py": {"os"},  # reads and writes the compile cache
    "numerics/jit.py": {"os"},  # whether the user says where, and how threads wait
    "model/check.py": {"random"},  # to know what it refuses
    "model/user_file.py": {"os"},  # a model that would end the program
    "compiled/orphan.py": {"os", "threading"},  # a worker that ends with its parent
}


def within(name: str, allowed: str) -> bool:
    return name == allowed or name.startswith(allowed + ".")


def test_direction():
    wrong = {}
    for path in modules().values():
        parts = path.relative_to(ROOT).parts
        names = imported(path.read_text(), ".".join(parts[:-1]))
        inner = [name for name in names if name.split(".")[0] in PACKAGES]
        if upward := [name for name in inner if not any(within(name, allowed) for allowed in MAY_IMPORT[parts[0]])]:
            wrong["/".join(parts)] = upward
    assert wrong == {}


def test_rooms_of_the_app():
    def room_of(name: str) -> str:
        return next((room for room in (*ROOMS, "extensions") if within(name, f"app.{room}")), "")

    found: dict[str, set[str]] = {}
    for name, to in edges("app").items():
        here = room_of(name)
        found.setdefault(here, set()).update({room_of(there) for there in to} - {here, ""})
    del found["extensions"]
    assert found == {"": set()} | ROOMS


def test_estimators_are_pure():
    touched = {}
    for path in (ROOT / "estimators").rglob("*.py"):
        package = ".".join(path.relative_to(ROOT).parent.parts)
        found = {name.split(".")[0] for name in imported(path.read_text(), package)} & IMPURE
        if found:
            touched[str(path.relative_to(ROOT / "estimators"))] = found
    assert touched == IMPURE_HERE


def room(name: str) -> str:
    """The folder of a module; a module that stands in no room of its package is a room by itself."""
    parts = name.split(".")
    return ".".join(parts[:-1]) if len(parts) > 2 else name


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups that import one another, directly or through others: what is left once nobody else can be taken away."""
    left = {name: set(to) for name, to in graph.items()}
    while free := [name for name, to in left.items() if not to & left.keys()]:
        for name in free:
            del left[name]
    while free := [name for name in left if not any(name in to for to in left.values())]:
        for name in free:
            del left[name]
    return [sorted(left)] if left else []


def extension(name: str) -> str:
    """The extension that a module, or a test, belongs to; nothing for the core."""
    parts = name.split(".")
    return parts[2] if parts[0] in ("app", "tests") and parts[1:2] == ["extensions"] and len(parts) > 2 else ""


def test_an_extension_is_imported_only_by_those_that_need_it():
    wrong = {
        (here, there)
        for here, to in edges().items()
        for there in to
        if extension(there)
        not in ("", extension(here), *(extensions()[extension(here)].needs if extension(here) else ()))
    }
    assert wrong == set()


def test_tests_of_the_core_need_no_extension():
    core = tuple(f"tests.{package}." for package in PACKAGES)
    found = edges(*PACKAGES, "tests").items()
    assert {name for name, to in found if name.startswith(core) and any(map(extension, to))} == set()


def test_the_core_works_without_any_extension():
    assert with_dependents(["mqtt"]) == {"mqtt", "fleet"}
    assert problems({*extensions()}) == []


def test_no_module_imports_in_a_circle():
    assert circles(edges()) == []


def test_no_room_imports_in_a_circle():
    graph: dict[str, set[str]] = {}
    for name, to in edges().items():
        here = room(name)
        # An inner room belongs to the one around it.
        graph.setdefault(here, set()).update(
            there for there in map(room, to) if not within(there, here) and not within(here, there)
        )
    assert circles(graph) == []


def test_no_script_of_the_page_imports_in_a_circle():
    page = ROOT / "app" / "web" / "page"
    scripts = {path.resolve(): path.read_text() for path in page.rglob("*.js") if "vendor" not in path.parts}
    graph = {
        str(path.relative_to(page)): {
            str((path.parent / name).resolve().relative_to(page)) for name in re.findall(r'from "(\.[^"]+)"', text)
        }
        for path, text in scripts.items()
    }
    assert "http.js" in graph["session.js"]
    assert circles(graph) == []


def test_circles_are_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [["b", "c"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_the_reader_of_imports_sees_every_form():
    source = """
import app.live
from app import live
from . import errors
from .errors import ModelError
from ..sources import can_bus
def later():
    from sources.source import Source
if TYPE_CHECKING:
    import config.schema as schema
"""
    assert imported(source, "estimators.models") == [
        "app.live",
        "app.live",
        "estimators.models.errors",
        "estimators.models.errors.ModelError",
        "estimators.sources.can_bus",
        "sources.source.Source",
        "config.schema",
    ]
