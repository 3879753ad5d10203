"""docs/protocol.md says what the code does: its documents, its numbers, its worked example."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from core.allocation import permits
from core.allocation.plant_side import Market
from core.allocation.plant_state import Grant, Kill, Rules, Solicit
from core.allocation.queue import TaskQueue
from core.errors import GardenError
from core.mesh import parcels
from core.mesh.auth import ROLES, Enrolled, GardenKey, Identity, Verifier, make_garden
from core.mesh.client import Answer
from core.mesh.parcels import ANSWER_HEADERS, BODY_BYTES_MAX, LIFE_S, REQUEST_HEADERS, Parcel, opened, sealed, sealed_answer
from core.mesh.presence import introducer
from core.mesh.strict import parse
from core.wire import documents, fruit, market, plant, robot
from core.wire.geometry import Point3, Pose2
from core.wire.market import Bid, PermitRequest, PlantCard, Report

DOC = Path(__file__).resolve().parents[2] / "docs" / "protocol.md"
TEXT = DOC.read_text()
FENCED = re.findall(r"^```(\w+) (\w+)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
MODELS = {
    model.__name__: model
    for model in (
        documents.NodeCard, documents.Problem, fruit.Pick, market.Announcement, market.Award, market.Bid, market.Permit,
        market.PermitRequest, market.Report, market.ReportAnswer, market.Reservation, market.ReservationRequest,
        market.Task, parcels.Parcel, parcels.ParcelAnswer, parcels.ParcelAnswers, plant.PlantState, robot.QueuedTask,
    )
}  # fmt: skip
EXAMPLES = [(name, body) for kind, name, body in FENCED if kind == "json" and name in MODELS]


def test_every_json_of_the_document_is_named_and_every_document_has_an_example() -> None:
    assert TEXT.count("```json") == len([kind for kind, _, _ in FENCED if kind == "json"])
    assert {name for kind, name, _ in FENCED if kind == "json"} == MODELS.keys() | {"header", "claims", "question", "reply"}


@pytest.mark.parametrize(("name", "body"), EXAMPLES, ids=[f"{name}-{i}" for i, (name, _) in enumerate(EXAMPLES)])
def test_an_example_is_taken_as_the_document_it_is_named_after(name: str, body: str) -> None:
    parse(MODELS[name], body.encode())


@pytest.mark.parametrize("name", MODELS)
def test_the_examples_of_a_document_show_every_field_it_has(name: str) -> None:
    shown = {field for kind, body in EXAMPLES if kind == name for field in json.loads(body)}
    assert shown == set(MODELS[name].model_fields)


def test_the_fields_that_a_task_and_a_problem_must_have_are_told() -> None:
    for told, model in (("Must be there: `(.*?)`;", market.Task), ("Only `(.*?)` must be there", documents.Problem)):
        found = re.search(told, TEXT)
        assert found is not None
        required = [field for field, info in model.model_fields.items() if info.is_required()]
        assert sorted(re.findall(r"\w+", found[1].replace(" and ", " "))) == sorted(required)


def test_a_token_of_the_garden_is_as_the_document_says() -> None:
    parts = {name: json.loads(body) for kind, name, body in FENCED if name in ("header", "claims")}
    key = GardenKey.from_seed(1)
    import jwt

    token = key.issue("robot-1", "robot", 0.0).token
    assert jwt.get_unverified_header(token) == parts["header"]
    claims = jwt.decode(token, options={"verify_signature": False})
    assert claims.keys() == parts["claims"].keys()
    assert re.fullmatch(r"garden-[0-9a-f]{16}", claims["aud"])
    assert re.fullmatch(r"garden-[0-9a-f]{16}", parts["claims"]["aud"])
    assert f"`role` is one of `{' '.join(ROLES)}`" in TEXT


def test_the_seals_of_parcels_are_as_the_document_says(tmp_path: Path) -> None:
    make_garden(tmp_path, [Enrolled("plant-1", "plant")], now_s=0.0)
    me = introducer(Identity.load(tmp_path / "plant-1"), "plant", "http://10.77.0.1:8100")
    assert me is not None
    told = {name: json.loads(body) for kind, name, body in FENCED if name in ("question", "reply")}
    import jwt

    headers = {"content-type": "application/json"}
    question = sealed(me, "1-1", "*robot", "POST", "/bids", headers, b"{}", 1.0)
    taken = opened(Parcel(seal=question, body="e30=", via=["plant-1"], within_s=1.0), Verifier.load(tmp_path), 1.0, 0.0)
    reply = sealed_answer(me, taken, Answer(200, b"{}", headers))
    for name, seal in (("question", question), ("reply", reply)):
        claims = jwt.decode(seal, options={"verify_signature": False})
        assert claims.keys() == told[name].keys()
        assert {key: claims[key] for key in ("aud", "headers", "sha256")} == {
            key: told[name][key] for key in ("aud", "headers", "sha256")
        }
    section = TEXT.partition("## 8.")[2]
    assert all(f"`{name}`" in section for name in (*REQUEST_HEADERS, *ANSWER_HEADERS))
    assert f"at most {BODY_BYTES_MAX:,} bytes" in section
    assert f"`iat` lies within {LIFE_S:g} s" in section


def test_the_numbers_are_the_markets() -> None:
    rows = dict(re.findall(r"^\| ([^|]+?) \| ([\d.]+)(?: \w+(?:/s)?)? \| (?:plant|robot) \|$", TEXT, re.MULTILINE))
    rules = Rules()
    assert {name: float(value) for name, value in rows.items()} == {
        "bid window": rules.bid_window_s,
        "lease": rules.lease_s,
        "a report at least every": rules.lease_s / 4,
        "an award without an answer is sent again every": rules.resend_s,
        "re-allocation every": rules.reallocate_s,
        "margin of a re-allocation": rules.margin_ratio,
        "validity of a permit": rules.permit_valid_s,
        "slowest pump reckoned with": permits.FLOW_MLPS_MIN,
        "least dose": permits.DOSE_ML_MIN,
    }
    assert permits.longest_act_s(100.0) == 100.0 / permits.FLOW_MLPS_MIN + 5.0


def test_every_state_is_in_the_table_of_states() -> None:
    section = TEXT.partition("## 4.")[2].partition("## 5.")[0]
    for state in market.TaskState.__args__:
        assert f"`{state}`" in section


def test_every_operation_it_names_is_one_that_the_services_have() -> None:
    table = (DOC.parent / "security-table.md").read_text()
    known = set(re.findall(r"^\| `(\w+ /[^`]*)` \|", table, re.MULTILINE))
    named = {re.sub(r"\?.*", "", operation) for operation in re.findall(r"`((?:GET|POST|DELETE|PATCH|PUT) /[^`]*)`", TEXT)}
    assert len(named) >= 12
    assert named <= known


# ------------------------------------------------------------------ figure 13


class Trace:
    """One plant's market and two robots' queues, played by hand; every message becomes a line."""

    def __init__(self) -> None:
        point = Point3(x_m=0.0, y_m=0.0, z_m=0.25)
        card = PlantCard(
            plant_id="plant-1", url="http://plant-1", stem=point, dock=Pose2(x_m=0.55, y_m=0.0, yaw_rad=3.14), nozzle=point
        )
        self.market = Market(card, None, 0.0)
        self.queues = {"robot-1": TaskQueue(), "robot-2": TaskQueue()}
        self.costs: dict[str, float] = {}
        self.lines: list[str] = []
        self.now_s = 0.0

    def say(self, who: str, whom: str, request: str, answer: str) -> None:
        self.lines.append(f"{self.now_s:7.1f}  {who:<7} -> {whom:<7}  {request:<43} {answer}")

    def plant_acts(self, now_s: float) -> None:
        """Tick, and carry every effect out until nothing follows."""
        self.now_s = now_s
        self.market.tick(now_s, list(self.queues))
        while effects := [effect for effect in self.market.take_effects() if isinstance(effect, Solicit | Grant | Kill)]:
            for effect in effects:
                {Solicit: self.solicit, Grant: self.grant, Kill: self.kill}[type(effect)](effect)

    def solicit(self, ask: Any) -> None:
        for name in ask.robots:
            task_id, cost_s = ask.announcement.task_id, self.costs[name]
            self.say("plant-1", name, "POST /bids", f"200 cost_s {cost_s:g}")
            bid = Bid(task_id=task_id, robot_id=name, cost_s=cost_s)
            self.market.bid(task_id, ask.round_number, name, bid, self.now_s)

    def grant(self, grant: Any) -> None:
        self.queues[grant.robot_id].award(grant.award, self.now_s)
        self.say("plant-1", grant.robot_id, f"POST /tasks  epoch {grant.award.epoch}", "201 queued")
        self.market.award_answered(grant.award.announcement.task_id, grant.award.epoch, "", self.now_s)

    def kill(self, kill: Any) -> None:
        queue = self.queues[kill.robot_id]
        queue.drop(queue.get(kill.task_id))
        self.say("plant-1", kill.robot_id, f"DELETE /tasks/{kill.task_id}?epoch={kill.epoch}", "200")

    def report(self, name: str, epoch: int, state: str, now_s: float, **more: Any) -> None:
        self.now_s = now_s
        told = Report(robot_id=name, epoch=epoch, state=state, **more)  # type: ignore[arg-type]
        answer = self.market.report("plant-1:1:1", told, now_s)
        word = f"200 keep {str(answer.keep).lower()}" + (f": {answer.reason}" if answer.reason else "")
        self.say(name, "plant-1", f"POST .../reports  {state}, epoch {epoch}", word)

    def permit(self, name: str, epoch: int, now_s: float) -> None:
        self.now_s = now_s
        wish = PermitRequest(robot_id=name, epoch=epoch, act="water", amount_ml=150.0)
        try:
            given = self.market.permit("plant-1:1:1", wish, f"permit-{epoch}", now_s)
            word = f"200 {given.permit_id}, {given.dose_ml:g} ml, {given.valid_for_s:g} s"
        except GardenError as error:
            word = f"{error.status} {error}"
        self.say(name, "plant-1", f"POST .../permits  epoch {epoch}", word)


def fig13() -> Trace:
    """Robot 1 wins with 3, then says 7; robot 2 says 4 and gets the task (paper 000, figure 13)."""
    trace = Trace()
    trace.market.soil(0.176, "", 0.0)
    trace.market.ask("water", 150.0, "soil", "too dry", 0.0)
    trace.costs = {"robot-1": 3.0, "robot-2": 4.0}
    trace.plant_acts(0.0)
    trace.report("robot-1", 1, "awarded", 0.1)
    for now_s in (2.0, 4.0, 6.0, 8.0):
        trace.market.report("plant-1:1:1", Report(robot_id="robot-1", epoch=1, state="awarded"), now_s)
    trace.costs = {"robot-1": 7.0, "robot-2": 4.0}
    trace.plant_acts(10.0)
    trace.report("robot-1", 1, "running", 10.1)
    trace.permit("robot-1", 1, 10.2)
    trace.report("robot-2", 2, "running", 10.3)
    for now_s in (12.0, 14.0):
        trace.market.report("plant-1:1:1", Report(robot_id="robot-2", epoch=2, state="running"), now_s)
    trace.permit("robot-2", 2, 15.0)
    trace.permit("robot-2", 2, 15.5)
    trace.report("robot-2", 2, "done", 36.0, delivered_ml=149.4)
    trace.market.soil(0.225, "", 36.0 + trace.market.limits.soak_s)
    return trace


def test_the_worked_example_is_what_the_markets_machine_does() -> None:
    trace = fig13()
    told = next(body for kind, name, body in FENCED if (kind, name) == ("text", "trace"))
    print("\n".join(trace.lines))
    assert told.splitlines() == trace.lines
    task = trace.market.task("plant-1:1:1")
    assert (task.state, task.robot_id, task.epoch, task.permits) == ("done", "robot-2", 2, 1)
