"""Real services in network namespaces find one another, know how far away everybody is, and notice who went."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path

import pytest
from namespaces import Namespaces, unable, until

from core.mesh.auth import Enrolled, make_garden

pytestmark = pytest.mark.alone
WITHIN_S = 60.0
LINE = [(1, 2), (2, 3), (3, 4)]
RING = [(1, 2), (2, 3), (3, 4), (4, 5), (5, 1)]
GRID = [(1, 2), (2, 3), (4, 5), (5, 6), (7, 8), (8, 9), (1, 4), (4, 7), (2, 5), (5, 8), (3, 6), (6, 9)]


def distances(links: Iterable[tuple[int, int]], start: int) -> dict[int, int]:
    """Hops to every other host, by breadth first search."""
    links = list(links)
    found, queue = {start: 0}, deque([start])
    while queue:
        here = queue.popleft()
        for a, b in links:
            for one, other in ((a, b), (b, a)):
                if one == here and other not in found:
                    found[other] = found[here] + 1
                    queue.append(other)
    return {host: hops for host, hops in found.items() if host != start}


def keys_of(folder: Path, hosts: Iterable[int]) -> Path:
    make_garden(folder / "keys", [Enrolled(f"station-{host}", "plant") for host in hosts], time.time())
    return folder / "keys"


@pytest.mark.parametrize(
    "links",
    [
        pytest.param(LINE, id="line"),
        pytest.param(RING, id="ring", marks=pytest.mark.soak),
        pytest.param(GRID, id="grid", marks=pytest.mark.soak),
    ],
)
def test_hop_counts_are_those_of_the_mesh_and_follow_a_cut_link(links: list[tuple[int, int]], tmp_path: Path) -> None:
    if why := unable("babeld"):
        pytest.skip(why)
    hosts = sorted({host for link in links for host in link})
    keys = keys_of(tmp_path, hosts)
    with Namespaces(tmp_path, "hop") as mesh:
        mesh.build(hosts, links)
        mesh.route()
        for host in hosts:
            mesh.station(host, "routes", keys)
        for host in hosts:
            wanted = distances(links, host)
            until(lambda h=host, w=wanted: mesh.hops(h) == w, WITHIN_S, f"station-{host} knows {wanted}")
        assert mesh.get(1, "/readyz")["discovery"] == ["static list", "kernel routes"]
        mesh.cut(*links[0])
        for host in (1, 2):
            wanted = distances(links[1:], host)
            until(lambda h=host, w=wanted: mesh.hops(h) == w, WITHIN_S, f"station-{host} knows {wanted} after the cut")


def test_neighbours_on_one_link_find_each_other_by_multicast_dns_and_hear_a_goodbye(tmp_path: Path) -> None:
    if why := unable():
        pytest.skip(why)
    keys = keys_of(tmp_path, (1, 2))
    with Namespaces(tmp_path, "dns") as mesh:
        mesh.build((1, 2), [(1, 2)])
        for host, other in ((1, 2), (2, 1)):
            mesh.ip(host, "addr", "add", f"{mesh.address(host)}/24", "dev", f"to{other}")
            mesh.ip(host, "addr", "del", f"{mesh.address(host)}/32", "dev", "lo")
            mesh.ip(host, "route", "add", "224.0.0.0/4", "dev", f"to{other}")
        nodes = {host: mesh.station(host, "mdns", keys) for host in (1, 2)}
        for host, other in ((1, 2), (2, 1)):
            until(lambda h=host, o=other: mesh.hops(h) == {o: 1}, WITHIN_S, f"station-{host} finds station-{other}")
        nodes[2].terminate()
        until(lambda: mesh.hops(1) == {}, 15.0, "station-1 hears the goodbye")
        assert [peer["id"] for peer in mesh.get(1, "/peers")] == ["station-2"]
