"""The planner: shortest ways, none through anything, out of tight places, and none where there is none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from core.planning import kernels, warm
from core.planning.grid import GridMap
from core.planning.wavefront import Path, path_length_m, plan, wavefront

R_M = 0.18


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    warm()


def garden() -> GridMap:
    grid = GridMap.of_arena(4.0, 3.0)
    for x, y in ((-0.55, 0.75), (0.55, 0.75), (-0.55, -0.75), (0.55, -0.75)):
        grid.add_disc(x, y, 0.14)
    return grid


def walked(path: Path) -> np.ndarray:
    """The path as points 5 mm apart."""
    pieces = []
    for a, b in zip(path.points_m, path.points_m[1:], strict=False):
        n = max(2, math.ceil(np.linalg.norm(b - a) / 0.005))
        pieces.append(a + np.linspace(0, 1, n)[:, None] * (b - a))
    return np.concatenate(pieces)


def test_an_empty_arena_is_crossed_in_a_straight_line() -> None:
    path = plan(GridMap.of_arena(4.0, 3.0), (-1.0, -0.7), (1.1, 0.4), radius_m=R_M)
    assert path is not None
    assert path.length_m == pytest.approx(math.hypot(2.1, 1.1), rel=0.005)
    assert tuple(path.points_m[0]) == (-1.0, -0.7)
    assert tuple(path.points_m[-1]) == (1.1, 0.4)


def test_a_path_touches_nothing_between_its_corners() -> None:
    grid, rng = garden(), np.random.default_rng(4)
    space = grid.inflate(R_M)
    tried = 0
    while tried < 25:
        (ax, ay), (bx, by) = rng.uniform((-1.8, -1.3), (1.8, 1.3), (2, 2))
        if not (space.is_free(ax, ay) and space.is_free(bx, by)):
            continue
        tried += 1
        path = plan(grid, (ax, ay), (bx, by), radius_m=R_M)
        assert path is not None
        assert all(space.clearance_at_m(x, y) > R_M - 0.015 for x, y in walked(path))


def test_length_is_within_5_percent_of_the_taut_string_round_a_disc() -> None:
    grid = GridMap.of_arena(4.0, 3.0)
    grid.add_disc(0.0, 0.0, 0.3)
    path = plan(grid, (-1.0, 0.0), (1.0, 0.0), radius_m=0.2, comfort_m=0.0)
    assert path is not None
    tangent = math.sqrt(1.0 - 0.5**2)
    string_m = 2 * tangent + 0.5 * (math.pi - 2 * math.acos(0.5))
    assert string_m - 0.01 <= path.length_m <= 1.05 * string_m


def test_comfort_keeps_more_distance_where_there_is_room() -> None:
    grid = GridMap.of_arena(4.0, 3.0)
    grid.add_disc(0.0, 0.0, 0.3)
    space = grid.inflate(0.2)
    nearest = []
    for comfort_m in (0.0, 0.08):
        path = plan(grid, (-1.0, 0.05), (1.0, 0.0), radius_m=0.2, comfort_m=comfort_m)
        assert path is not None
        nearest.append(min(space.clearance_at_m(x, y) for x, y in walked(path)))
    assert nearest[1] >= nearest[0] + 0.02


def test_a_start_too_near_to_something_escapes_first() -> None:
    grid = garden()
    path = plan(grid, (-0.55 - 0.14 - 0.10, 0.75), (1.5, 0.0), radius_m=R_M)
    assert path is not None
    assert 0.05 < path.escape_m < 0.2
    assert tuple(path.points_m[-1]) == (1.5, 0.0)


@pytest.mark.parametrize("goal", [(-0.55, 0.75), (2.5, 0.0), (1.95, 0.0)])
def test_there_is_no_path_to_where_the_robot_cannot_stand(goal: tuple[float, float]) -> None:
    assert plan(garden(), (0.0, 0.0), goal, radius_m=R_M) is None


def test_a_wall_without_a_door_has_no_way_round() -> None:
    grid = GridMap.of_arena(4.0, 3.0)
    grid.add_box(0.0, 0.0, math.pi / 2, 3.2, 0.1)
    assert plan(grid, (-1.0, 0.0), (1.0, 0.0), radius_m=R_M) is None


def test_another_robot_in_the_door_closes_it_and_the_map_is_not_changed_by_asking() -> None:
    grid = GridMap.of_arena(4.0, 3.0)
    grid.add_box(0.0, -0.9, math.pi / 2, 1.2, 0.1)
    grid.add_box(0.0, 0.9, math.pi / 2, 1.2, 0.1)
    before = grid.occupied.copy()
    assert plan(grid, (-1.0, 0.0), (1.0, 0.0), radius_m=R_M) is not None
    closed = grid.copy()
    closed.add_disc(0.0, 0.0, 0.174)
    assert plan(closed, (-1.0, 0.0), (1.0, 0.0), radius_m=R_M) is None
    assert np.array_equal(grid.occupied, before)


def test_one_field_serves_all_starts_as_planning_each_does() -> None:
    grid = garden()
    field = wavefront(grid.inflate(R_M, 0.08), (1.2, -0.2))
    assert field is not None
    for start in ((-1.5, 1.0), (0.0, 1.2), (1.5, -1.2)):
        one, other = field.path_from(start), plan(grid, start, (1.2, -0.2), radius_m=R_M, comfort_m=0.08)
        assert one is not None
        assert other is not None
        assert np.allclose(one.points_m, other.points_m)


def test_the_field_costs_what_a_plain_dijkstra_says() -> None:
    import heapq

    rng = np.random.default_rng(8)
    blocked = rng.random((40, 50)) < 0.3
    blocked[20, 25] = False
    blocked[0, :] = blocked[-1, :] = blocked[:, 0] = blocked[:, -1] = True
    for weight in (np.ones(blocked.shape, np.uint8), rng.integers(1, 5, blocked.shape).astype(np.uint8)):
        dist = np.where(blocked, np.int32(-1), kernels.FAR).ravel()
        if weight.max() == 1:
            kernels.plain_field(dist, 50, 20 * 50 + 25)
        else:
            kernels.weighted_field(dist, weight.ravel(), 50, 20 * 50 + 25)
        best, heap = {(20, 25): 0}, [(0, 20, 25)]
        while heap:
            d, r, c = heapq.heappop(heap)
            if d > best[r, c]:
                continue
            for i in (-1, 0, 1):
                for j in (-1, 0, 1):
                    k = (r + i, c + j)
                    # The field runs from the goal: the cell that is entered on the way there is (r, c).
                    cost = d + (7 if i and j else 5) * int(weight[r, c])
                    if (i or j) and not blocked[k] and cost < best.get(k, 10**9):
                        best[k] = cost
                        heapq.heappush(heap, (cost, *k))
        assert {(i // 50, i % 50): int(dist[i]) for i in np.flatnonzero((dist >= 0) & (dist < kernels.FAR))} == best


def test_a_boxs_cells_are_those_inside_it() -> None:
    grid = GridMap.of_arena(2.0, 2.0)
    grid.add_box(0.3, -0.2, 0.6, 0.8, 0.4)
    assert grid.occupied.sum() * grid.cell_m**2 == pytest.approx(0.32, rel=0.02)
    assert grid.occupied[grid.cell(0.3 + 0.35 * math.cos(0.6), -0.2 + 0.35 * math.sin(0.6))]
    assert not grid.occupied[grid.cell(0.3 - 0.35 * math.sin(0.6), -0.2 + 0.35 * math.cos(0.6))]


def test_things_partly_outside_the_arena_are_drawn_as_far_as_they_are_in_it() -> None:
    grid = GridMap.of_arena(2.0, 2.0)
    grid.add_disc(1.0, 0.0, 0.2)
    assert grid.occupied.sum() * grid.cell_m**2 == pytest.approx(math.pi * 0.04 / 2, rel=0.05)


def test_path_length_is_the_polylines() -> None:
    assert path_length_m(np.array([(0.0, 0.0), (3.0, 4.0), (3.0, 5.0)])) == pytest.approx(6.0)
