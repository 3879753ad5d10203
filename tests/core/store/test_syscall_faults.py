"""System calls that fail, injected by strace into a real process: nothing is acknowledged that is not there afterwards."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from tracing import untraceable

from core.store import DurableDocument

FILES, COMMITS = 12, 4
WRITER = f"""
import json, sys
from pathlib import Path
from core.clock import WallClock
from core.errors import StorageError
from core.store import DurableDocument
told = {{}}
for k in range({FILES}):
    path = Path(sys.argv[1]) / f"{{k}}" / "doc.json"
    file, acknowledged, refused = DurableDocument(path, "fault/1", WallClock()), [], 0
    try:
        file.load()
        for n in range(1, {COMMITS} + 1):
            try:
                file.commit({{"n": n}})
                acknowledged.append(n)
            except StorageError:
                refused += 1
    except StorageError:
        refused = -1
    told[k] = [acknowledged, refused, file.broken]
    file.close()
print(json.dumps(told))
"""
FAULTS = [
    ("write", "EIO", 5), ("write", "ENOSPC", 3), ("fsync", "EIO", 5), ("rename", "EIO", 3), ("link", "ENOSPC", 3),
    ("unlink", "EIO", 3), ("openat", "EMFILE", 7), ("openat", "EIO", 5),
]  # fmt: skip
"""Call, error, and that every so many-th call fails."""


@pytest.mark.parametrize(("call", "error", "every"), FAULTS, ids=lambda value: str(value))
def test_a_system_call_that_fails_is_never_answered_with_success(tmp_path: Path, call: str, error: str, every: int) -> None:
    if why := untraceable():
        pytest.skip(why)
    folders = [tmp_path / str(k) for k in range(FILES)]
    for folder in folders:
        folder.mkdir()
    paths = [str(path) for f in folders for path in (f, f / "doc.json", f / "doc.json.tmp", f / "doc.json.1")]
    log = tmp_path / "strace.log"
    command = [
        "strace",
        "-f",
        "-o",
        str(log),
        "-e",
        f"trace={call}",
        "-e",
        f"inject={call}:error={error}:when={every}+{every}",
    ]
    command += [part for path in paths for part in ("-P", path)] + [sys.executable, "-c", WRITER, str(tmp_path)]
    ran = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    injected = log.read_text().count("(INJECTED)")
    told = json.loads(ran.stdout)
    for k, folder in enumerate(folders):
        acknowledged, refused, broken = told[str(k)]
        file = DurableDocument(folder / "doc.json", "fault/1", clock=None)  # type: ignore[arg-type]
        found = file.load()
        file.close()
        n = 0 if found is None else found["n"]
        assert n >= max(acknowledged, default=0), f"{acknowledged} was acknowledged, {n} is there"
        assert acknowledged == sorted(acknowledged)
        if broken:
            assert refused == COMMITS - len(acknowledged)
    assert injected >= 2
    assert sum(abs(refused) for _, refused, _ in told.values()) >= (0 if call in ("link", "unlink") else 2)
    print(f"{injected} faults, {sum(len(acknowledged) for acknowledged, _, _ in told.values())} acknowledged")
