"""Laws that hold for every file: who imports whom, what a pot carries, who may ask for the time."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ALLOWED: dict[str, set[str]] = {
    "core": set(),
    "hw": {"core"},
    "sim": {"core", "hw"},
    "plant_service": {"core", "hw"},
    "robot_service": {"core", "hw"},
    "console": {"core"},
    "lab": {"core", "hw", "sim", "plant_service", "robot_service", "console"},
}
NODE_CODE = ("core", "hw", "plant_service", "robot_service")
HEAVY = ("numpy", "scipy", "cv2", "mujoco", "numba")
CLOCKS = {"core/clock.py"}
"""Where garden time is made from the machine's."""


def files(folder: str) -> Iterator[tuple[str, ast.Module]]:
    for path in sorted((ROOT / folder).rglob("*.py")):
        yield str(path.relative_to(ROOT)), ast.parse(path.read_text(), str(path))


def imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute here"
            yield node.module or ""


@pytest.mark.parametrize("folder", ALLOWED)
def test_a_folder_imports_only_what_lies_below_it(folder: str) -> None:
    found = 0
    for path, tree in files(folder):
        ours = {name.partition(".")[0] for name in imported(tree)} & ALLOWED.keys()
        assert ours - {folder} <= ALLOWED[folder], path
        found += 1
    assert found > 0


def dotted(node: ast.expr) -> str:
    """`a.b.c` of an expression, or nothing."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        inner = dotted(node.value)
        return f"{inner}.{node.attr}" if inner else ""
    return ""


FORBIDDEN = {
    "time.time",
    "time.sleep",
    "time.monotonic",
    "time.perf_counter",
    "datetime.now",
    "datetime.datetime.now",
    "datetime.utcnow",
    "uuid.uuid4",
    "uuid4",
    "asyncio.to_thread",
    "threading.Thread",
}
CHANCE = ("random.", "np.random.", "numpy.random.")
SEEDED = {"random.Random", "np.random.Generator", "numpy.random.Generator", "np.random.default_rng"}


def forbidden_calls(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        if name in FORBIDDEN or (name.startswith(CHANCE) and name not in SEEDED):
            yield f"line {node.lineno}: {name}"
        elif name in SEEDED and not node.args:
            yield f"line {node.lineno}: {name} without a seed"


@pytest.mark.parametrize("folder", NODE_CODE)
def test_node_code_asks_the_clock_for_time_and_the_seed_for_chance(folder: str) -> None:
    for path, tree in files(folder):
        if path not in CLOCKS:
            assert list(forbidden_calls(tree)) == [], path


def test_the_search_for_forbidden_calls_finds_them() -> None:
    bad = "import time, random\ntime.time()\nrandom.random()\nrandom.Random()\nrandom.Random(7).random()\n"
    assert list(forbidden_calls(ast.parse(bad))) == [
        "line 2: time.time",
        "line 3: random.random",
        "line 4: random.Random without a seed",
    ]


def endpoints(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Functions under a route's decorator that are not async: they would run in a thread, past the virtual clock."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            for decorator in node.decorator_list:
                name = dotted(decorator.func) if isinstance(decorator, ast.Call) else ""
                if name.rpartition(".")[2] in {"get", "post", "put", "patch", "delete"}:
                    yield node


@pytest.mark.parametrize("folder", [*NODE_CODE, "sim", "console"])
def test_no_endpoint_runs_in_a_thread(folder: str) -> None:
    for path, tree in files(folder):
        assert [node.name for node in endpoints(tree)] == [], path


def loaded_by(module: str) -> set[str]:
    code = f"import sys, {module}; print(' '.join(sys.modules))"
    told = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in told.stdout.split()}


@pytest.mark.parametrize("module", ["plant_service.__main__", "console.__main__"])
def test_a_pot_and_a_console_carry_no_heavy_library(module: str) -> None:
    loaded = loaded_by(module)
    assert "fastapi" in loaded
    assert loaded & set(HEAVY) == set()
