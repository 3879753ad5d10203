"""A scenario becomes a process list, the same here and in containers."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath

import pytest
import yaml
from typer.testing import CliRunner

from console import cli, toml
from console.compose import compose, describe, place, render
from console.folder import Folder
from console.processes import Place, World, enrolled, ports_of, processes
from core import scenario as scenarios
from core.mesh import tls
from core.mesh.peers import Peer
from core.mesh.runtime import GardenSettings
from core.scenario import Scenario, device_ports
from plant_service.settings import PlantSettings
from robot_service.body.settings import BodySettings
from robot_service.settings import RobotSettings
from sim.settings import SimSettings

ROOT = Path(__file__).resolve().parents[2]
GARDEN = scenarios.find("garden")


def test_the_default_garden_is_eleven_processes_world_first() -> None:
    names = [process.name for process in processes(GARDEN, Folder(Path("data")).place())]
    assert names[0] == "sim"
    bodies = ["robot-1-body", "robot-2-body"]
    assert sorted(names) == sorted([*ports_of(GARDEN), *bodies])
    assert len(names) == 11


def test_an_external_pot_is_a_peer_with_port_keys_and_probe_but_no_process_of_ours() -> None:
    *ours, last = GARDEN.plants
    garden = GARDEN.model_copy(update={"plants": (*ours, last.model_copy(update={"external": True}))})
    listed = processes(garden, Folder(Path("data")).place())
    assert last.id not in {process.name for process in listed}
    assert last.id in {node.id for node in enrolled(garden)}
    assert last.id in {peer["id"] for process in listed for peer in json.loads(process.env["GARDEN_PEERS"])}
    assert device_ports(garden)[f"{last.id}.soil"] in listed[0].devices


@pytest.mark.parametrize("there", [Folder(Path("data")).place(), place("garden")], ids=["here", "container"])
def test_under_tls_every_address_is_https_and_every_process_is_told(there: Place) -> None:
    for process in processes(scenarios.find("garden", tls=True), there):
        assert process.env["GARDEN_TLS"] == "true", process.name
        assert "http://" not in json.dumps(process.env), process.name
        GardenSettings(clock=process.env["GARDEN_CLOCK"], tls=True)
    assert not any("GARDEN_TLS" in process.env for process in processes(GARDEN, there))


def test_tls_is_one_word_in_a_scenario_and_one_on_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(toml.dump(GARDEN.model_copy(update={"tls": True})))
    assert scenarios.find(str(tmp_path / "mine.toml")).tls
    assert not GARDEN.tls
    assert scenarios.find("garden", tls=True) == GARDEN.model_copy(update={"tls": True})
    printed = CliRunner().invoke(cli.app, ["compose", "--tls", "--json"])
    assert '"GARDEN_TLS": "true"' in printed.stdout


def test_whoever_enrols_gets_certificates_for_all_and_an_authority_for_people(tmp_path: Path) -> None:
    folder = Folder(tmp_path)
    folder.enrol(GARDEN)
    for node in enrolled(GARDEN):
        tls.serving(folder.keys / node.id)
    assert folder.trusted() is not None
    assert Folder(tmp_path / "nothing").trusted() is None


SETTINGS = {
    "sim": SimSettings,
    "plant": PlantSettings,
    "station": PlantSettings,
    "robot": RobotSettings,
    "body": BodySettings,
}


@pytest.mark.parametrize("where", ["here", "container"])
def test_every_service_accepts_its_environment(where: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    there = Folder(tmp_path).place() if where == "here" else place("garden")
    for process in processes(GARDEN, there, World(seed=3, speed=2.0, fresh=True)):
        if process.kind not in SETTINGS:
            continue
        with monkeypatch.context() as env:
            for name, value in process.env.items():
                env.setenv(name, value)
            settings = SETTINGS[process.kind]()  # type: ignore[call-arg]
        assert getattr(settings, "id", process.name) in (process.name, process.keys)


def test_everybody_knows_everybody_and_nobody_shares_a_port_or_a_folder() -> None:
    listed = processes(GARDEN, Folder(Path("data")).place())
    ports = [port for process in listed for port in (process.port, *process.devices) if port]
    assert len(set(ports)) == len(ports)
    data = [value for process in listed for name, value in process.env.items() if name.endswith("_DATA")]
    assert len(set(data)) == len(listed)
    for process in listed:
        peers = {Peer.model_validate(peer).id for peer in json.loads(process.env["GARDEN_PEERS"])}
        assert peers == set(ports_of(GARDEN))
        assert PurePosixPath(process.env["GARDEN_KEYS"]).name == process.keys


def test_every_node_is_enrolled_once_and_robots_get_a_secret() -> None:
    nodes = {node.id: node for node in enrolled(GARDEN)}
    assert set(nodes) == set(ports_of(GARDEN))
    assert [name for name, node in nodes.items() if node.secret] == ["robot-1", "robot-2"]
    assert "operator" not in {node.role for node in nodes.values()}


def test_a_scenario_written_back_is_read_the_same(tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_text(toml.dump(GARDEN))
    assert scenarios.load(tmp_path) == GARDEN


def test_a_shift_moves_every_port() -> None:
    moved = toml.shifted(GARDEN, 100)
    assert {name: port - 100 for name, port in ports_of(moved).items()} == ports_of(GARDEN)
    with pytest.raises(ValueError, match="ports"):
        toml.shifted(GARDEN, 60000)


def test_a_socket_path_is_never_too_long(tmp_path: Path) -> None:
    assert len(str(Folder(tmp_path / ("x" * 120)).socket_path("robot-1"))) < 100


def compose_of(scenario: Scenario) -> dict[str, object]:
    document: dict[str, object] = yaml.safe_load(render(describe(scenario, "garden")))
    return document


def test_the_compose_file_in_the_repository_is_the_generated_one() -> None:
    assert (ROOT / "docker-compose.yml").read_text() == render(describe(GARDEN, "garden")), (
        "run: garden compose > docker-compose.yml"
    )


def test_the_yaml_means_what_was_described() -> None:
    assert compose_of(GARDEN) == json.loads(json.dumps(describe(GARDEN, "garden")))


def test_a_scenario_of_ones_own_is_mounted_where_it_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.toml").write_text(toml.dump(GARDEN))
    compose(str(tmp_path / "mine.toml"), as_json=True)
    services = json.loads(capsys.readouterr().out)["services"]
    for name in ("init", "sim"):
        assert f"{tmp_path}/mine.toml:/scenario.toml:ro" in services[name]["volumes"]
    assert services["sim"]["environment"]["SIM_SCENARIO"] == "/scenario.toml"
