from __future__ import annotations

import subprocess
import sys

HEAVY = ("numpy", "scipy", "cv2", "mujoco", "numba")
MODULES = "hw.drivers.probes, hw.drivers.firmata, hw.drivers.iio, hw.protocols.vh400, core.soil, core.estimation.markers"


def test_what_a_pot_needs_of_its_probe_is_light() -> None:
    code = f"import sys, {MODULES}; print([name for name in {HEAVY} if name in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert loaded.stdout.strip() == "[]"
