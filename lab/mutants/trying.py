"""Whether the tests of a part notice a mistake: each mutant in a forked process that imports the part anew.

The tests run once without any mistake, watched: how long each takes, and which lines of the part it runs. A mutant is tried
by those that run its statement, the quickest first, until one fails. A test that takes ten times its time, and two seconds,
is taken for one that never ends; that counts as noticed.
"""

from __future__ import annotations

import ast
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import resource
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any, Literal

import pytest

from lab.mutants.making import Mutant

ALLOWANCE_S, ALLOWANCE_RATIO = 2.0, 10.0
MEMORY_BYTES = 6 * 2**30
MARKS = "not soak and not alone and not compose"
Outcome = Literal["killed", "timeout", "survived", "unreached"]


class TestsFailError(RuntimeError):
    """The tests do not pass without any mistake, so that nothing can be said."""


@dataclass(frozen=True, slots=True)
class Part:
    """Files and the tests that vouch for them, as paths from the root."""

    files: tuple[str, ...]
    tests: tuple[str, ...]
    sample: int | None = None
    """So many mutants a run, drawn by the seed; None: all."""
    without: str = ""
    """Tests whose name holds this are left out."""


@dataclass(slots=True)
class Watched:
    """What was seen of the tests without a mistake."""

    took_s: dict[str, float] = field(default_factory=dict)
    lines: dict[str, dict[str, list[int]]] = field(default_factory=dict)
    """Test -> file -> lines."""
    modules: list[str] = field(default_factory=list)
    """Of others, that the tests import: loaded once for all mutants."""

    def tests_of(self, file: str, mutant: Mutant, users: Collection[str], importers: Collection[str]) -> list[str]:
        """Those that run the mutant's statement, the quickest first.

        When it runs at import: all that run one of `users`, and those of the test files `importers`.
        """
        if mutant.lines:
            seen = [test for test in self.took_s if set(mutant.lines) & set(self.lines[test].get(file, ()))]
        else:
            seen = [t for t in self.took_s if self.lines[t].keys() & set(users) or t.split("::")[0] in importers]
        return sorted(seen, key=lambda test: (self.took_s[test], test))


class Trial:
    """The tests of one part, ready to be run on one mutant after the other."""

    def __init__(self, root: Path, part: Part) -> None:
        """Raises TestsFailError."""
        self._root, self._part = root, part
        self.sources = {file: (root / file).read_bytes() for file in part.files}
        self._temporary = tempfile.TemporaryDirectory()
        self._told = Path(self._temporary.name) / "told.json"
        os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = f"{self._temporary.name}/hypothesis"
        if (code := self._in_child(self._watch, 3600.0)) != 0:
            raise TestsFailError(f"pytest {' '.join(part.tests)} ends with {code} when nothing is changed")
        self.watched = Watched(**json.loads(self._told.read_text()))
        self._test_files = {test.split("::")[0] for test in self.watched.took_s}
        for name in self.watched.modules:
            with suppress(Exception):
                importlib.import_module(name)
        tests = list(self.watched.took_s)
        if (code := self._in_child(lambda: self._run(tests), 3600.0)) != 0:
            raise TestsFailError(f"the tests end with {code} in a second process when nothing is changed")

    def close(self) -> None:
        self._temporary.cleanup()

    def try_one(self, file: str, mutant: Mutant) -> Outcome:
        """What the tests say to a mutant of one of the part's files."""
        users = _users(self._root, self._part.files, file)
        names = {_module(each) for each in users}
        importers = [each for each in self._test_files if _imported(self._root / each) & names]
        tests = self.watched.tests_of(file, mutant, users, importers)
        if not tests:
            return "unreached"
        source = mutant.put_into(self.sources[file])
        limit_s = sum(self._allowed_s(test) for test in tests)
        code = self._in_child(lambda: self._run(tests, _Altered(self._root / file, _module(file), source)), limit_s)
        if code == -signal.SIGALRM:
            return "timeout"
        return "survived" if code == 0 else "killed"

    def _allowed_s(self, test: str) -> float:
        return ALLOWANCE_S + ALLOWANCE_RATIO * self.watched.took_s[test]

    def _in_child(self, work: Callable[[], int], limit_s: float) -> int:
        """The exit code of a forked process, negative when a signal ended it."""
        sys.stdout.flush()
        sys.stderr.flush()
        if (pid := os.fork()) != 0:
            return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        code = 99
        try:
            nowhere = os.open(os.devnull, os.O_RDWR)
            for fd in (0, 1, 2):
                os.dup2(nowhere, fd)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_REAL, ALLOWANCE_S + limit_s)
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, resource.RLIM_INFINITY))
            os.chdir(self._root)
            code = work()
        finally:
            os._exit(code)

    def _pytest(self, tests: Sequence[str], plugin: object) -> int:
        return int(
            pytest.main(
                [
                    "-x", "-q", "-m", MARKS, "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:schemathesis",
                    "--hypothesis-seed=0", "-W", "ignore::pytest.PytestAssertRewriteWarning", f"--rootdir={self._root}",
                    f"--basetemp={self._temporary.name}/tmp", *tests,
                ],
                plugins=[plugin],
            )
        )  # fmt: skip

    def _watch(self) -> int:
        watcher = _Watcher(self._root, self._part.files)
        named = ("-k", f"not {self._part.without}") if self._part.without else ()
        code = self._pytest((*self._part.tests, *named), watcher)
        names = [name for name, module in list(sys.modules.items()) if self._is_foreign(module)]
        lines = {test: {file: sorted(seen) for file, seen in files.items()} for test, files in watcher.lines.items()}
        self._told.write_text(json.dumps({"took_s": watcher.took_s, "lines": lines, "modules": names}))
        return code

    def _is_foreign(self, module: ModuleType) -> bool:
        path = getattr(module, "__file__", None)
        return path is not None and ("site-packages" in path or not Path(path).is_relative_to(self._root))

    def _run(self, tests: Sequence[str], altered: _Altered | None = None) -> int:
        if altered is not None:
            sys.meta_path.insert(0, altered)
        files = list(dict.fromkeys(test.split("::")[0] for test in tests))
        code = self._pytest(files, _Chosen(tests, self._allowed_s))
        assert altered is None or altered.loaded or code != 0, "the tests ran on something else"
        return code


class _Altered(importlib.abc.MetaPathFinder):
    """Imports one module from another source."""

    def __init__(self, path: Path, name: str, source: bytes) -> None:
        self.path, self.name, self.source, self.loaded = path, name, source, False
        assert name not in sys.modules, "what is imported already cannot be changed"

    def find_spec(self, fullname: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        if fullname != self.name:
            return None
        return importlib.util.spec_from_file_location(fullname, self.path, loader=_AlteredLoader(self))


class _AlteredLoader(importlib.machinery.SourceFileLoader):
    def __init__(self, altered: _Altered) -> None:
        super().__init__(altered.name, str(altered.path))
        self._altered = altered

    def get_code(self, fullname: str) -> CodeType:
        self._altered.loaded = True
        code: CodeType = compile(self._altered.source, self.path, "exec", dont_inherit=True)
        return code


class _Chosen:
    """A pytest plugin: only these tests, in this order, each with its time."""

    def __init__(self, tests: Sequence[str], allowed_s: Callable[[str], float]) -> None:
        self._place = {test: number for number, test in enumerate(tests)}
        self._allowed_s = allowed_s

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        chosen = [item for item in items if item.nodeid in self._place]
        items[:] = sorted(chosen, key=lambda item: self._place[item.nodeid])

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        signal.setitimer(signal.ITIMER_REAL, self._allowed_s(item.nodeid))
        return (yield)


class _Watcher:
    """A pytest plugin: which lines of some files each test runs, and how long it takes."""

    def __init__(self, root: Path, files: Sequence[str]) -> None:
        self._files = {str(root / file): file for file in files}
        self.lines: dict[str, dict[str, set[int]]] = {}
        self.took_s: dict[str, float] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        seen: dict[str, set[int]] = {}

        def enter(frame: FrameType, event: str, arg: Any) -> Any:
            if (file := self._files.get(frame.f_code.co_filename)) is None:
                return None
            lines = seen.setdefault(file, set())
            lines.add(frame.f_lineno)
            if lines >= _lines_of(frame.f_code):
                return None

            def step(frame: FrameType, event: str, arg: Any) -> Any:
                lines.add(frame.f_lineno)
                return step

            return step

        began_s = time.perf_counter()
        threading.settrace(enter)
        sys.settrace(enter)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            threading.settrace(None)
            self.took_s[item.nodeid] = time.perf_counter() - began_s
            self.lines[item.nodeid] = seen


@cache
def _lines_of(code: CodeType) -> frozenset[int]:
    return frozenset(line for _, _, line in code.co_lines() if line)


@cache
def _users(root: Path, files: tuple[str, ...], file: str) -> frozenset[str]:
    """The file, and those of `files` that import it, directly or through others."""
    found, before = {file}, set[str]()
    while found != before:
        before, names = set(found), {_module(each) for each in found}
        found |= {each for each in files if _imported(root / each) & names}
    return frozenset(found)


@cache
def _imported(path: Path) -> frozenset[str]:
    """Modules that a file imports from, and whatever it imports from them as if it were a module."""
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
    return frozenset(
        name for node in nodes for name in (node.module or "", *(f"{node.module}.{each.name}" for each in node.names))
    )


def _module(file: str) -> str:
    return file.removesuffix(".py").replace("/", ".")
