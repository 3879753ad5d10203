"""Pictures of the simulated world, made without any graphics library."""


def warm() -> None:
    """Compile the drawing kernels into numba's cache, so that nobody's first picture waits some ten seconds."""
    import numpy as np

    from sim.camera import overview
    from sim.camera.geoms import Geoms, Paint

    nothing = Geoms(
        kind=np.zeros(0, dtype=np.int32),
        size=np.zeros((0, 3)),
        pos=np.zeros((0, 3)),
        mat=np.zeros((0, 9)),
        visible=np.zeros(0, dtype=np.bool_),
        leaf=np.zeros(0, dtype=np.bool_),
    )
    bare = Paint(rgba=np.zeros((0, 4)), texture=np.zeros(0, dtype=np.int32), gloss=np.zeros(0))
    room = overview.Arena(length_m=4.0, width_m=3.0, ceiling_m=2.6)
    overview.draw(nothing, bare, room, [], "")
