"""The maker of mistakes makes those it says, and the one who tries them tells noticed from unnoticed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lab.mutants.__main__ import PARTS, ROOT
from lab.mutants.making import mutants


def made(source: str) -> set[str]:
    """The lines that differ from the source, as the mutants have them."""
    data = source.encode()
    diffs = [mutant.diff(data) for mutant in mutants(data)]
    return {line[1:].strip() for diff in diffs for line in diff.splitlines() if line.startswith("+")}


@pytest.mark.parametrize(
    ("source", "wanted"),
    [
        ("x = a < b", {"x = (a <= b)", "x = (a >= b)"}),
        ("x = a <= b < c", {"x = (a < b < c)", "x = (a > b < c)", "x = (a <= b <= c)", "x = (a <= b >= c)"}),
        ("x = a and b", {"x = (a or b)", "x = (a)", "x = (b)"}),
        ("x = not a", {"x = (a)"}),
        ("x = a is None", {"x = (a is not None)"}),
        ("x = a + b", {"x = (a - b)"}),
        ("x = [2, 0.5, 0.0, True]", {f"x = [{row}]" for row in ("3, 0.5, 0.0, True", "2, 1.0, 0.0, True")}
         | {f"x = [{row}]" for row in ("2, 0.5, 1.0, True", "2, 0.5, 0.0, False")}),
        ("x = min(a, -b)", {"x = (max(a, -b))", "x = min(a, (b))"}),
        ("x = 'word' if a else b", {"x = 'XXword' if a else b", "x = 'word' if (not (a)) else b"}),
        ("self.x = a", {"pass"}),
        ("call(a)", {"pass"}),
        ("x += a", {"pass", "x -= a"}),
        ("def f(a: int = 1) -> str | None:\n    return a", {"def f(a: int = 2) -> str | None:", "return None"}),
        ("def f(a) -> bool:\n    return a", {"return (not (a))"}),
        ("def f(a) -> float:\n    return a", {"return 0.0"}),
    ],
)  # fmt: skip
def test_one_place_is_changed_at_a_time(source: str, wanted: set[str]) -> None:
    assert made(source) == wanted


@pytest.mark.parametrize(
    "source",
    [
        '"""A docstring."""',
        "Kind = Literal['a', 'b']",
        "x: Literal['a'] | None = None",
        "@dataclass(slots=True)\nclass A:\n    x: int",
        "assert a < b",
        "x = zip(a, b, strict=True)",
        "_log.warning('word', 3)",
        "x = f'{a + 1:.0f} ml'",
        "x = 'words for people'",
        "def f() -> str:\n    return ''",
    ],
)
def test_what_no_test_should_notice_is_left_out_unless_it_is_a_value(source: str) -> None:
    assert made(source) <= {"return 'XX'"}


def test_an_exception_may_be_missing_but_its_words_are_left() -> None:
    assert made("raise Refused(f'{a} is over', hint='later', code=3)") == {"pass"}


PROJECT = {
    "counting.py": """LIMIT = 3


def enough(n: int) -> bool:
    return n >= LIMIT


def count(n: int) -> int:
    done = 0
    while done < n:
        done += 1
    return done


def never(n: int) -> int:
    return n + 1
""",
    "test_counting.py": """from counting import count, enough


def test_enough():
    assert enough(5)
    assert not enough(1)


def test_count():
    assert count(2) == 2
""",
    "pytest.ini": "[pytest]\naddopts = --import-mode=importlib\n",
}
TRY = """
import json
from pathlib import Path
from lab.mutants import trying
from lab.mutants.making import mutants
trying.ALLOWANCE_S = 0.3
trial = trying.Trial(Path.cwd(), trying.Part(("counting.py",), ("test_counting.py",)))
source = Path("counting.py").read_bytes()
wanted = ("LIMIT = 4", "return (n > LIMIT)", "return (n < LIMIT)", "pass", "return (n - 1)")
told = {}
for mutant in mutants(source):
    line = mutant.diff(source).splitlines()[-1][1:].strip()
    if line in wanted:
        told[line] = trial.try_one("counting.py", mutant)
trial.close()
print(json.dumps(told))
"""


def test_noticed_and_unnoticed_mistakes_are_told_apart(tmp_path: Path) -> None:
    for name, text in PROJECT.items():
        (tmp_path / name).write_text(text)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", TRY]
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout) == {
        "LIMIT = 4": "survived",
        "return (n > LIMIT)": "survived",
        "return (n < LIMIT)": "killed",
        "pass": "timeout",
        "return (n - 1)": "unreached",
    }


@pytest.mark.parametrize("name", PARTS)
def test_what_the_parts_name_is_there(name: str) -> None:
    assert PARTS[name].files
    assert all((ROOT / path).exists() for path in (*PARTS[name].files, *PARTS[name].tests))
