"""The example's market machine against rude robots: random events in random order, judged by what a plant must hold to.

docs/protocol.md, section 6: one holder and one live epoch, at most one permit between two measurements, none beyond the
day's cap or while the soil is not measured, one robot at the dock, ids that never repeat.
"""

from __future__ import annotations

import json
import random
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "cgi-pot"
PATH = "/usr/sbin:/usr/bin:/bin:/usr/local/bin"
PHP = shutil.which("php", path=PATH)
DRIVER = """
require $argv[1] . '/market.php';
$set = json_decode($argv[2], true);
$state = FRESH;
while (($line = fgets(STDIN)) !== false) {
    [$now, $event, $args] = json_decode($line, true);
    $market = new Market($state, $now, $set);
    try {
        $said = ['ok' => $market->$event(...$args)];
    } catch (Refusal $no) {
        $said = ['no' => $no->status, 'why' => $no->getMessage()];
    }
    $state = json_decode(json_encode($market->s, JSON_PRESERVE_ZERO_FRACTION), true);
    echo json_encode($said + ['task' => $state['task'], 'permit' => $state['permit'], 'tasks' => count($state['ended'])],
        JSON_PRESERVE_ZERO_FRACTION), "\\n";
}
"""
PLACE = {"x_m": 0.0, "y_m": 0.0, "z_m": 0.0}
SETTINGS = {
    "id": "plant-5", "port": 8105, "stem": PLACE, "dock": PLACE, "nozzle": PLACE, "threshold_ratio": 0.2,
    "target_ratio": 0.24, "dose_ml": 150.0, "day_cap_ml": 350.0, "soak_s": 60.0,
}  # fmt: skip
ROBOTS = ("robot-1", "robot-2", "robot-3")
VALID_S, SLOWEST_MLPS, ACT_EXTRA_S, DAY_S = 15.0, 5.0, 5.0, 86400.0
pytestmark = pytest.mark.skipif(PHP is None, reason="the example needs php: see examples/cgi-pot/README.md")


class Played:
    """The machine in a PHP process, and what we know must hold."""

    def __init__(self, rng: random.Random) -> None:
        assert PHP is not None
        command = [PHP, "-n", "-r", DRIVER, "--", str(EXAMPLE), json.dumps(SETTINGS)]
        self.php = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.rng, self.now_s, self.ratio = rng, 1000.0, 0.15
        self.task: dict[str, Any] | None = None
        self.epochs: dict[str, int] = {}
        self.permits: list[tuple[float, float]] = []
        """When each was given [garden s], and its millilitres."""
        self.ids: set[str] = set()
        self.finished_s: float | None = None
        """When the open permit's holder said that its act was over."""
        self.open: dict[str, Any] | None = None
        self.measured_s = -1e9
        self.docked: tuple[str, float] = ("", 0.0)
        self.counts = {"permits": 0, "refused": 0, "cut by the cap": 0}

    def call(self, event: str, *args: Any) -> dict[str, Any]:
        assert self.php.stdin is not None
        assert self.php.stdout is not None
        self.php.stdin.write(json.dumps([self.now_s, event, args]) + "\n")
        self.php.stdin.flush()
        said: dict[str, Any] = json.loads(self.php.stdout.readline())
        self._check(said)
        return said

    def _check(self, said: dict[str, Any]) -> None:
        task = said["task"]
        if task is not None:
            before = self.epochs.get(task["task_id"], 0)
            assert task["epoch"] >= before, "an epoch went back"
            if before == task["epoch"] and self.task is not None and self.task["task_id"] == task["task_id"]:
                assert task["robot_id"] in ("", self.task["robot_id"]), "another holder under the same epoch"
            self.epochs[task["task_id"]] = task["epoch"]
            assert (task["state"] == "announced") == (task["robot_id"] == "")
        self.task = task
        if self.open is not None and said["permit"] is None:
            self._settled(self.open)
        self.open = said["permit"]

    def _settled(self, permit: dict[str, Any]) -> None:
        """Only a measurement closes a permit, and never before the act must be over and its water has soaked in."""
        assert self.measured_s == self.now_s
        over_s = permit["t_s"] + VALID_S + permit["dose_ml"] / SLOWEST_MLPS + ACT_EXTRA_S
        if self.finished_s is not None:
            over_s = max(self.finished_s, permit["t_s"] + VALID_S)
        assert self.now_s >= over_s + SETTINGS["soak_s"] - 1e-6
        self.finished_s = None

    def end(self) -> None:
        assert self.php.stdin is not None
        assert self.php.stdout is not None
        self.php.stdin.close()
        print(self.php.stdout.read(), end="")
        self.php.stdout.close()
        self.php.wait(10)

    # ------------------------------------------------------------------ what happens

    def measure(self) -> None:
        good = self.rng.random() < 0.9
        soil = {"state": "good" if good else "open", "ratio": self.ratio if good else None, "why": ""}
        if good:
            self.measured_s = self.now_s
        self.call("measured", soil | {"volts": self.rng.random()})
        todo = self.call("todo")["ok"]
        if todo["ask"] is not None:
            self.auction(todo["ask"])
        if todo["award"] is not None and self.rng.random() < 0.7:
            refused = "busy" if self.rng.random() < 0.2 else ""
            self.call("award_answered", todo["award"]["announcement"]["task_id"], todo["award"]["epoch"], refused)

    def auction(self, asked: dict[str, Any]) -> None:
        costs = {name: self.rng.choice((None, self.rng.uniform(1, 99))) for name in ROBOTS}
        bids = [
            {"task_id": asked["task_id"], "robot_id": name, "cost_s": cost, "reason": ""} for name, cost in costs.items()
        ]
        award = self.call("bids", asked["task_id"], bids)["ok"]
        able = [(cost, name) for name, cost in costs.items() if cost is not None]
        assert (award is None) == (not able)
        if award is not None:
            assert award["announcement"]["holder"] == min(able)[1]

    def anybody(self) -> tuple[str, str, int]:
        """A task's id, a robot and an epoch: mostly the right ones."""
        if self.task is None or self.rng.random() < 0.05:
            return self.rng.choice([*self.epochs, "plant-5:1:999"]), self.rng.choice(ROBOTS), self.rng.randrange(4)
        robot = self.task["robot_id"] if self.task["robot_id"] and self.rng.random() < 0.85 else self.rng.choice(ROBOTS)
        late = 1 if self.rng.random() < 0.15 else 0
        return self.task["task_id"], robot, max(0, self.task["epoch"] - late)

    def report(self) -> None:
        task_id, robot, epoch = self.anybody()
        state = self.rng.choice(("awarded", "running", "running", "running", "done", "failed"))
        delivered_ml = self.rng.choice((None, 0.0, 150.0))
        holder, open_ = self.task, self.open
        told = {"robot_id": robot, "epoch": epoch, "state": state, "delivered_ml": delivered_ml, "phase": "", "reason": ""}
        mine = holder is not None and (task_id, robot, epoch) == (holder["task_id"], holder["robot_id"], holder["epoch"])
        of_permit = open_ is not None and (task_id, robot, epoch) == (open_["task_id"], open_["robot_id"], open_["epoch"])
        if of_permit and state in ("done", "failed") and self.finished_s is None:
            self.finished_s = self.now_s
            if delivered_ml is not None:
                self.permits[-1] = (self.permits[-1][0], delivered_ml)
        said = self.call("report", task_id, told)
        if "ok" in said and holder is not None and task_id == holder["task_id"]:
            assert said["ok"]["keep"] == mine, "somebody else's word was taken, or the holder's was not"

    def permit(self) -> None:
        task_id, robot, epoch = self.anybody()
        key = self.rng.choice(("k", f"{task_id}/{epoch}"))
        holder, open_ = self.task, self.open
        wish = {"robot_id": robot, "epoch": epoch, "act": self.rng.choice(("water",) * 9 + ("pick",)), "amount_ml": 150.0}
        said = self.call("permit", task_id, wish, key)
        if "no" in said:
            self.counts["refused"] += 1
            return
        permit = said["ok"]
        if open_ is not None:
            same = (open_["task_id"], open_["robot_id"], open_["epoch"], open_["key"]) == (task_id, robot, epoch, key)
            assert same, "a second permit before a measurement"
            assert permit["permit_id"] == open_["permit_id"]
            assert permit["valid_for_s"] <= VALID_S
            return
        self.counts["permits"] += 1
        assert holder is not None
        assert (task_id, robot, epoch) == (holder["task_id"], holder["robot_id"], holder["epoch"])
        self.counts["cut by the cap"] += permit["dose_ml"] < holder["dose_ml"]
        assert permit["permit_id"] not in self.ids
        assert self.now_s - self.measured_s <= 60.0
        self.ids.add(permit["permit_id"])
        self.permits.append((self.now_s, permit["dose_ml"]))
        today_ml = sum(ml for t_s, ml in self.permits if t_s > self.now_s - DAY_S)
        assert today_ml <= SETTINGS["day_cap_ml"] + 1e-6

    def dock(self) -> None:
        robot = self.rng.choice(ROBOTS)
        said = self.call("reserve", {"robot_id": robot, "for_s": 30.0})
        holder, until_s = self.docked
        free = self.now_s >= until_s or holder in ("", robot)
        assert ("ok" in said) == free
        if "ok" in said:
            self.docked = (robot, self.now_s + 30.0)
            if self.rng.random() < 0.3:
                self.call("release_dock", said["ok"]["reservation_id"], robot)
                self.docked = ("", 0.0)

    def people(self) -> None:
        if self.task is not None and self.rng.random() < 0.5:
            self.call("cancel", self.task["task_id"], "operator")
        else:
            self.call("ask", {"kind": "water", "dose_ml": self.rng.choice((None, 20.0))}, "operator")

    def pass_time(self) -> None:
        far = self.rng.random()
        self.now_s += 90000.0 if far < 0.025 else 70.0 if far < 0.15 else self.rng.choice((0.1, 1.0, 2.0, 5.0))
        self.ratio = min(0.3, max(0.1, self.ratio + self.rng.uniform(-0.01, 0.012)))


SEEDS = range(3)


def test_whatever_robots_do_a_pot_holds_to_the_protocol() -> None:
    counts: Counter[str] = Counter()
    for seed in SEEDS:
        print(f"seed {seed}")
        rng = random.Random(seed)
        played = Played(rng)
        moves = (played.measure, played.measure, played.report, played.report, played.permit, played.dock, played.pass_time)
        try:
            for _ in range(1700):
                rng.choice(moves if rng.random() < 0.98 else (played.people,))()
        finally:
            played.end()
        counts.update(played.counts)
    print(counts)
    # So much was tried that what is forbidden had its chance.
    assert counts["permits"] >= 20
    assert counts["refused"] >= 300
    assert counts["cut by the cap"] >= 1
