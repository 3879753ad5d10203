"""Which circles of several pictures are one fruit: the rays of a fruit cross at its centre, and so may others by chance.

Every pair of circles whose rays meet proposes a point. A set of points is sought that uses each circle once and explains
the circles best: a circle that surely is a fruit should belong to one. A point is worth, in log-odds, how much closer its
circles lie to it than chance would put them, less what it costs that a picture should show it and does not. The best point
takes its circles, then the next; then each weak choice is forbidden in turn, and stays so when the whole becomes better
for it: one crossing of two wrong rays often keeps two fruit from being seen.
Positions [m] in the frame that the camera poses are given in, pictures in pixels.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.geometry.pinhole import Camera
from core.perception.detection import COLOURS, Detection

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Circle = tuple[int, Detection]
"""The index of its picture, and the circle; sorted by picture."""
Hits = tuple[int, ...]
"""Indices of circles, at most one of each picture."""

MEET_M = 0.02
"""Rays of one fruit pass each other nearer than this."""
RADII_M = (0.002, 0.024)
"""Of all that hangs, from just set to the largest."""
RIPENING_RADIUS_M_MIN = 0.009
"""Fruit turn when they are full-grown, even the smallest of a truss: smaller red ones are crossed rays."""
SIZES_LOG_MAX = 0.6
"""Two circles of one fruit do not imply radii further apart."""
SIDE_PX, SIDE_RATIO, SIZE_RATIO = 0.75, 0.04, 0.10
"""How far a circle's centre (pixels, and part of its radius) and its radius are off, as a rule; the tails are heavy."""
HIDDEN_RATIO = 2.0
"""A leaf or a neighbour before a fruit makes its circle smaller: so many times as common as larger."""
TAILS = 3.0
"""Degrees of freedom of Student's distribution."""
AGREES = 4.0
"""What a further circle that lies just where it should is worth."""
ABSENT = 0.7
"""What it costs that a picture should show a fruit and does not: a leaf may hang between."""
OTHER_COLOUR = 1.5
"""What a neighbouring colour costs: detectors mistake them seldom. Green and red are never one fruit."""
LONE_RATIO = 0.05
"""So seldom only one of the pictures shows a fruit; a circle left alone costs accordingly."""
DEPTH_M_MIN = 0.05
LOOKED_M_MIN = 0.08
"""Nearer to the camera nothing need be seen."""
ROUNDS = 2
WEAK_HITS = 3
"""Points with no more circles than this may be wrong crossings."""


@dataclass(frozen=True, slots=True)
class Crossing:
    """A point that several pictures agree on."""

    p: Array
    """(3,) [m]."""
    radius_m: float
    hits: dict[int, Detection]
    """By picture."""


@dataclass(frozen=True, slots=True)
class _Points:
    """Proposals and what each picture has to say to them."""

    p: Array
    radii: Array
    gain: Array
    """(N, M): what each circle adds, 0 when it is none of the point's."""
    due: Mask
    """(N, V): whether picture v has the point well inside."""
    uvr: Array
    """(N, V, 3) [px]: where and how large a picture should show it."""
    depth: Array
    """(N, V) [m]."""


def crossings(
    camera: Camera, poses: Sequence[Array], circles: Sequence[Circle], odds: Array, *, careful: bool = True
) -> list[Crossing]:
    """Points that two pictures or more agree on, the best first; `odds` (M,) are each circle's log-odds to be of a fruit.

    `poses` are T (4, 4) of the cameras by picture. Less than `careful`, the first choice is kept.
    """
    p, radii = _proposals(camera, poses, circles)
    if len(p) == 0:
        return []
    starts = np.flatnonzero(np.diff([-1, *(index for index, _ in circles)]))
    for _ in range(ROUNDS):
        p, radii = _refined(camera, poses, circles, starts, p, radii)
    points = _judged(camera, [poses[circles[int(start)][0]] for start in starts], circles, starts, p, radii, odds)
    chosen = _choice(points, starts, points.due, ())
    if careful:
        for _ in range(ROUNDS):
            due = _in_sight(points, chosen.rows)
            chosen = _improved(points, starts, due, _choice(points, starts, due, ()))
    return [
        Crossing(points.p[row], float(points.radii[row]), {circles[hit][0]: circles[hit][1] for hit in hits})
        for row, hits in zip(chosen.rows, chosen.hits, strict=True)
    ]


# Proposals


def _proposals(camera: Camera, poses: Sequence[Array], circles: Sequence[Circle]) -> tuple[Array, Array]:
    """Where the rays of two circles from different pictures meet: points (N, 3) and the radius (N,) [m] they imply."""
    eyes, rays = _rays(camera, poses, circles)
    angles = np.array([circle.radius_px / camera.fx for _, circle in circles])
    view_of = np.array([index for index, _ in circles])
    colour_of = np.array([COLOURS.index(circle.colour) for _, circle in circles])
    a, b = np.triu_indices(len(circles), 1)
    keep = (view_of[a] != view_of[b]) & (np.abs(colour_of[a] - colour_of[b]) < 2)
    a, b = a[keep], b[keep]
    # The nearest points of two lines, p = eye + t ray, with t counted along the optical axis (rays have depth 1).
    w = eyes[a] - eyes[b]
    aa, bb, ab = (rays[a] ** 2).sum(1), (rays[b] ** 2).sum(1), (rays[a] * rays[b]).sum(1)
    aw, bw = (rays[a] * w).sum(1), (rays[b] * w).sum(1)
    lean = np.maximum(aa * bb - ab**2, 1e-9)
    ta, tb = (ab * bw - bb * aw) / lean, (aa * bw - ab * aw) / lean
    pa, pb = eyes[a] + ta[:, None] * rays[a], eyes[b] + tb[:, None] * rays[b]
    ra, rb = ta * angles[a], tb * angles[b]
    radii = np.sqrt(np.maximum(ra * rb, 1e-12))
    near = (ta > DEPTH_M_MIN) & (tb > DEPTH_M_MIN) & (np.linalg.norm(pa - pb, axis=1) < MEET_M)
    least = np.where(np.maximum(colour_of[a], colour_of[b]) > 0, RIPENING_RADIUS_M_MIN, RADII_M[0])
    alike = np.abs(np.log(np.maximum(ra, 1e-6) / np.maximum(rb, 1e-6))) < SIZES_LOG_MAX
    good = near & (radii > least) & (radii < RADII_M[1]) & alike
    return (0.5 * (pa + pb))[good], radii[good]


def _rays(camera: Camera, poses: Sequence[Array], circles: Sequence[Circle]) -> tuple[Array, Array]:
    """Where each circle was seen from (M, 3) [m], and its direction (M, 3), with depth 1 along the optical axis."""
    eyes = np.array([poses[index][:3, 3] for index, _ in circles])
    ahead = np.array([((c.u_px - camera.cx) / camera.fx, (c.v_px - camera.cy) / camera.fy, 1.0) for _, c in circles])
    rays = np.array([poses[index][:3, :3] @ ray for (index, _), ray in zip(circles, ahead, strict=True)])
    return eyes, rays


def _refined(
    camera: Camera, poses: Sequence[Array], circles: Sequence[Circle], starts: NDArray[np.intp], p: Array, radii: Array
) -> tuple[Array, Array]:
    """Each point moved to where the rays of all circles that agree with it come nearest (linear least squares)."""
    eyes, rays = _rays(camera, poses, circles)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    offsets = np.einsum("mab,mb->ma", across, eyes)
    angles = np.array([circle.radius_px / camera.fx for _, circle in circles])
    weights = _own(np.maximum(0.0, AGREES - _surprise(camera, poses, circles, p, radii)), starts)
    enough = (weights > 0.0).sum(axis=1) > 1
    by_range = weights / np.maximum(np.linalg.norm(p[:, None] - eyes, axis=2), DEPTH_M_MIN) ** 2
    normal = np.einsum("nm,mab->nab", by_range, across) + 1e-6 * np.eye(3)
    moved = np.linalg.solve(normal, (np.einsum("nm,ma->na", by_range, offsets) + 1e-6 * p)[..., None])[..., 0]
    enough &= np.linalg.norm(moved - p, axis=1) < 2.5 * MEET_M
    p = np.where(enough[:, None], moved, p)
    implied = (weights * np.linalg.norm(p[:, None] - eyes, axis=2) * angles).sum(axis=1)
    mean = np.clip(implied / np.maximum(weights.sum(axis=1), 1e-9), *RADII_M)
    return p, np.where(enough, mean, radii)


def _surprise(camera: Camera, poses: Sequence[Array], circles: Sequence[Circle], p: Array, radii: Array) -> Array:
    """(N, M): minus the log of how likely each circle lies as it does if it is the point's, beside the likeliest place."""
    off = np.full((len(p), len(circles)), np.inf)
    for column, (index, circle) in enumerate(circles):
        u, v, r, depth = _projected(camera, poses[index], p, radii)
        side = SIDE_PX + SIDE_RATIO * circle.radius_px
        place = ((u - circle.u_px) ** 2 + (v - circle.v_px) ** 2) / side**2
        larger = np.log(np.maximum(r, 1e-6) / circle.radius_px)
        spread = (SIZE_RATIO + 1.0 / circle.radius_px) * np.where(larger > 0.0, HIDDEN_RATIO, 1.0)
        total = 0.5 * (TAILS + 2) * np.log1p(place / TAILS) + 0.5 * (TAILS + 1) * np.log1p((larger / spread) ** 2 / TAILS)
        off[:, column] = np.where(depth > DEPTH_M_MIN, total, np.inf)
    return off


def _projected(camera: Camera, T: Array, p: Array, radii: Array) -> tuple[Array, Array, Array, Array]:
    """Centre u, v and radius [px] of balls in a picture, and their depth [m]; each (N,)."""
    ahead = (p - T[:3, 3]) @ T[:3, :3]
    z = np.maximum(ahead[:, 2], 0.02)
    u, v = camera.fx * ahead[:, 0] / z + camera.cx, camera.fy * ahead[:, 1] / z + camera.cy
    return u, v, camera.fx * radii / z, ahead[:, 2]


# Choosing


@dataclass(frozen=True, slots=True)
class _Choice:
    rows: list[int]
    hits: list[Hits]
    worth: list[float]

    @property
    def total(self) -> float:
        return sum(self.worth)


def _judged(
    camera: Camera,
    poses: Sequence[Array],
    circles: Sequence[Circle],
    starts: NDArray[np.intp],
    p: Array,
    radii: Array,
    odds: Array,
) -> _Points:
    """What each proposal is worth to each circle, those with the same circles once; `poses` of pictures with circles."""
    picture = np.repeat(np.arange(len(starts)), np.diff([*starts, len(circles)]))
    numbered = [(int(n), circle) for n, (_, circle) in zip(picture, circles, strict=True)]
    gain = AGREES - _surprise(camera, poses, numbered, p, radii)
    chance = 1.0 / (1.0 + np.exp(-odds))
    gain = np.where(gain > 0.0, gain - np.log(1.0 - chance + LONE_RATIO * chance), 0.0)
    colour_of = np.array([COLOURS.index(circle.colour) for _, circle in circles])
    own = _own(gain, starts)
    main = np.stack([(own * (colour_of == colour)).sum(axis=1) for colour in range(len(COLOURS))], axis=1).argmax(axis=1)
    gap = np.abs(main[:, None] - colour_of)
    gain = np.where(gap < 2, np.maximum(0.0, gain - OTHER_COLOUR * gap * (gain > 0.0)), 0.0)
    order = np.argsort(-_own(gain, starts).sum(axis=1), kind="stable")
    _, first = np.unique(_own(gain, starts)[order] > 0.0, axis=0, return_index=True)
    rows = order[np.sort(first)]
    p, radii, gain = p[rows], radii[rows], gain[rows]
    projected = np.array([_projected(camera, T, p, radii) for T in poses])
    u, v, r, depth = (projected[:, n].T for n in range(4))
    due = (depth > LOOKED_M_MIN) & (u > r) & (u < camera.width - r) & (v > r) & (v < camera.height - r)
    return _Points(p, radii, gain, due, np.stack([u, v, r], axis=2), depth)


def _own(gain: Array, starts: NDArray[np.intp]) -> Array:
    """Only the best circle of each picture counts."""
    best = np.repeat(np.maximum.reduceat(gain, starts, axis=1), np.diff([*starts, gain.shape[1]]), axis=1)
    return np.where((gain > 0.0) & (gain >= best), gain, 0.0)


def _choice(points: _Points, starts: NDArray[np.intp], due: Mask, forbidden: Collection[Hits]) -> _Choice:
    """The best point takes its circles, then the next, as long as one is worth more than its circles apart."""
    gain, chosen = points.gain.copy(), _Choice([], [], [])
    ends = [*starts[1:], gain.shape[1]]
    while True:
        best = np.maximum.reduceat(gain, starts, axis=1)
        # The first circle tells nothing of how well the others agree.
        worth = best.sum(axis=1) - AGREES - ABSENT * (due & (best <= 0.0)).sum(axis=1)
        worth[(best > 0.0).sum(axis=1) < 2] = 0.0
        row = int(worth.argmax())
        if worth[row] <= 0.0:
            return chosen
        parts = [gain[row, first:end] for first, end in zip(starts, ends, strict=True)]
        hits = tuple(int(first + part.argmax()) for first, part in zip(starts, parts, strict=True) if part.max() > 0.0)
        if hits in forbidden:
            gain[row] = 0.0
            continue
        chosen.rows.append(row)
        chosen.hits.append(hits)
        chosen.worth.append(float(worth[row]))
        gain[:, hits] = 0.0


def _in_sight(points: _Points, rows: Sequence[int]) -> Mask:
    """`due` without what is hidden by the points chosen before."""
    due = points.due.copy()
    for row in rows:
        behind = points.depth > points.depth[row] + points.radii[row] * 0.5
        gap = np.hypot(points.uvr[..., 0] - points.uvr[row, :, 0], points.uvr[..., 1] - points.uvr[row, :, 1])
        before = points.depth[row] > DEPTH_M_MIN
        due &= ~(before & behind & (gap < points.uvr[row, :, 2] + 0.3 * points.uvr[..., 2]))
    return due


def _improved(points: _Points, starts: NDArray[np.intp], due: Mask, chosen: _Choice) -> _Choice:
    """Forbid weak choices, the weakest first, as long as the whole is worth more without."""
    forbidden: set[Hits] = set()
    tried: set[Hits] = set()
    while True:
        weak = [(worth, hits) for hits, worth in zip(chosen.hits, chosen.worth, strict=True) if len(hits) <= WEAK_HITS]
        untried = [hits for _, hits in sorted(weak) if hits not in tried]
        if not untried:
            return chosen
        tried.add(untried[0])
        other = _choice(points, starts, due, forbidden | {untried[0]})
        if other.total > chosen.total + 1e-6:
            forbidden.add(untried[0])
            chosen = other
