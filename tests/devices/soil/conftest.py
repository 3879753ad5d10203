"""A fake IIO sysfs tree."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def iio_device(tmp_path: Path) -> Callable[..., Path]:
    """Makes `iio:deviceN` below a temporary root, with the attributes the kernel would show; returns its folder."""

    def make(index: int, name: str, **attributes: object) -> Path:
        folder = tmp_path / f"iio:device{index}"
        folder.mkdir()
        for attribute, value in {"name": name, **attributes}.items():
            (folder / attribute).write_text(f"{value}\n", encoding="ascii")
        return folder

    return make
