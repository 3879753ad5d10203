from __future__ import annotations

import os
import subprocess
import sys
from ctypes.util import find_library

import pytest

SCRIPT = """
import mujoco, numpy as np
from sim.camera.egl import EglEye, chosen, instant_of
assert chosen()
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light pos="0 0 3"/>'
    '<geom type="sphere" size=".2" pos="0 0 .5" rgba=".9 .1 .1 1"/><camera name="eye" pos="0 -1 .5" euler="90 0 0"/>'
    '</worldbody></mujoco>')
data = mujoco.MjData(model)
eye = EglEye(model)
film = eye.draw(instant_of(data), "eye", 64, 48)
eye.close()
assert film.shape == (48, 64, 3)
red, green, blue = film[28, 32]
assert red > 3 * max(green, blue), film[28, 32]
assert film[2, 2].max() < 0.05
print("drawn")
"""


@pytest.mark.soak
@pytest.mark.skipif(find_library("EGL") is None, reason="no EGL on this machine")
def test_mujocos_renderer_draws_when_it_is_chosen() -> None:
    """In a process of its own: MuJoCo chooses its GL when it is imported."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=os.environ | {"MUJOCO_GL": "egl"}, capture_output=True, text=True, check=False
    )
    assert done.stdout == "drawn\n", done.stderr
