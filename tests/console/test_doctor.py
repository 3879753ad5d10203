"""`garden doctor` names what is missing and how to get it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from console.cli import app


def findings(folder: Path, path: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, str]]:
    monkeypatch.setenv("PATH", path)
    result = CliRunner().invoke(app, ["doctor", "--json", "--data", str(folder / "data")])
    assert result.exit_code == 0, result.output
    return {finding["what"]: finding for finding in json.loads(result.stdout)}


def tool(folder: Path, name: str) -> None:
    (folder / name).write_text("#!/bin/sh\n")
    (folder / name).chmod(0o755)


def test_a_tool_that_is_missing_is_named_with_its_use_and_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "console.doctor.TOOLS", {"routing": (("babeld-x", "ip-x"), "finding peers by routes: `make debian`")}
    )
    tool(tmp_path, "ip-x")
    told = findings(tmp_path, str(tmp_path), monkeypatch)["routing"]
    assert told == {
        "what": "routing", "state": "note", "told": "missing: babeld-x (only for finding peers by routes: `make debian`)"
    }  # fmt: skip
    tool(tmp_path, "babeld-x")
    assert findings(tmp_path, str(tmp_path), monkeypatch)["routing"]["told"] == "found: babeld-x, ip-x"


def test_what_doctor_sends_people_to_make_for_is_a_target_of_the_makefile() -> None:
    from console.doctor import TOOLS

    root = Path(__file__).parents[2]
    for _, use in TOOLS.values():
        words = use.split("`")[1].split()
        assert words[0] == "make"
        folder = root / words[2] if words[1] == "-C" else root
        assert f"\n{words[-1]}:" in (folder / "Makefile").read_text()
