"""Gardens under faults on virtual time: nothing that must hold may break, and what runs is a function of its seed."""

import json
import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import bugs
import pytest
import typer
from typer.testing import CliRunner

from core.errors import ConfigError
from lab.soak.cli import soak_all, soak_command
from lab.soak.run import Plan, as_json, soak

DOC = (Path(__file__).resolve().parents[3] / "docs" / "reliability.md").read_text()
APP = typer.Typer()
APP.command()(soak_command)
FIVE_DAYS = [Plan(seed=seed, days=1.0, hurry=0.3) for seed in range(1, 6)]


def told(outcome):
    return "\n".join([f"{b.invariant} at {b.at_s:.1f}: {b.what}" for b in outcome.breaches] + [outcome.plan.replay()])


@pytest.mark.parametrize("plan", FIVE_DAYS, ids=lambda plan: f"seed-{plan.seed}")
def test_a_garden_day_under_faults_breaks_nothing(plan):
    print(plan.replay())
    outcome = soak(plan)
    assert not outcome.breaches, told(outcome)
    assert outcome.tally.done >= 8 * plan.days
    assert sum(outcome.faults.values()) >= 50 * plan.days


def _output(script, env):
    command = [sys.executable, "-W", "ignore", "-c", script]
    return subprocess.run(command, env=env, capture_output=True, check=True, text=True).stdout


def test_a_garden_is_a_function_of_its_seed():
    """Every byte that was said, in processes that hash differently."""
    script = "from lab.soak.run import *; o = soak(Plan(seed={}, days=0.01, hurry=2.0)); print(o.trace, o.faults)"
    runs = [_output(script.format(3), os.environ | {"PYTHONHASHSEED": seed}) for seed in ("1", "2", "3")]
    assert runs[0] == runs[1] == runs[2] != ""
    assert len(runs[0].partition("/")[0]) == 64
    assert soak(Plan(seed=4, days=0.01, hurry=2.0)).trace not in runs[0]


def test_a_broken_invariant_comes_with_a_line_that_breaks_it_again():
    with bugs.BUGS["acknowledged_before_fsync"]():
        words = ["--days", "0.05", "--hurry", "3", "--seeds", "1", "--jobs", "1", "--json"]
        first = next(found for seed in range(1, 4) if (found := _soaked(*words, "--seed", str(seed))).exit_code)
        document = json.loads(first.stdout)
        assert set(document) >= {"simulated_days", "seeds", "tasks", "faults", "broken_invariants", "replay"}
        assert document["broken_invariants"] == len(document["broken"]) >= 1
        (line,) = document["replay"]
        command, _, code = line.partition("  # ")
        assert re.fullmatch(r"commit [0-9a-f]{10,}( \+ changes)?|version \S+", code)
        again = _soaked(*shlex.split(command)[2:], "--jobs", "1", "--json")
        assert again.exit_code == 1
        assert json.loads(again.stdout) == document
        assert line in first.stderr


ON_A_CLUSTER = """
from distributed import LocalCluster
from core.errors import ConfigError
from lab.soak.cli import soak_all
from lab.soak.run import Plan

if __name__ == "__main__":
    with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None) as cluster:
        plans = [Plan(seed=seed, days=0.01, hurry=2.0) for seed in (3, 4)]
        told = []
        outcomes = soak_all(plans, 0, told.append, cluster.scheduler_address)
        assert sorted(each.seed for each in told) == [3, 4]
        print([(each.seed, each.trace) for each in outcomes])
"""


def test_a_cluster_lives_through_the_same_gardens(tmp_path):
    (tmp_path / "on_a_cluster.py").write_text(ON_A_CLUSTER)
    root = str(Path(__file__).resolve().parents[3])
    command = [sys.executable, "-W", "ignore", str(tmp_path / "on_a_cluster.py")]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": root}, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr[-3000:]
    here = [(seed, soak(Plan(seed=seed, days=0.01, hurry=2.0)).trace) for seed in (3, 4)]
    assert done.stdout.splitlines()[-1] == str(here)


def test_a_cluster_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr("lab.soak.cli.CLUSTER_WITHIN_S", 0.5)
    with pytest.raises(ConfigError, match=r"tcp://127\.0\.0\.1:9") as error:
        soak_all([Plan(seed=1, days=0.01)], 1, print, "tcp://127.0.0.1:9")
    assert "dask scheduler" in error.value.hint


def _soaked(*words):
    return CliRunner().invoke(APP, list(words))


def test_the_report_counts_days_seeds_faults_and_tells_how_to_replay_what_broke():
    outcomes = [soak(Plan(seed=seed, days=0.01, hurry=2.0)) for seed in (1, 2)]
    document = json.loads(json.dumps(as_json(outcomes)))
    assert (document["simulated_days"], document["seeds"]) == (0.02, 2)
    assert document["broken_invariants"] == len(document["broken"]) == 0
    assert document["replay"] == []
    assert document["tasks"] > 0
    assert all(count > 0 for count in document["faults"].values())


@pytest.mark.soak
def test_thirty_days_over_fresh_seeds_break_nothing():
    first = int(os.environ.get("SOAK_FIRST") or time.time())
    print(f"seeds {first} to {first + 59}; SOAK_FIRST={first} runs them again")
    outcomes = soak_all([Plan(seed=seed, days=0.5) for seed in range(first, first + 60)], 2, lambda outcome: None)
    assert not any(outcome.breaches for outcome in outcomes), "\n".join(map(told, outcomes))
    document = as_json(outcomes)
    print(json.dumps(document))
    assert document["tasks"] > 1000 < document["doses"] + document["picks"]
    assert _named_faults() <= set(document["faults"]), "a fault of docs/reliability.md did not strike once"


def _named_faults():
    """What docs/reliability.md calls the worst instants."""
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", DOC, re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`(\w+)`", row)}


def test_the_worst_instants_are_named():
    assert len(_named_faults()) >= 20


@pytest.mark.soak
def test_six_weeks_of_one_garden_break_nothing():
    outcome = soak(Plan(seed=42, days=42.0))
    print(json.dumps(as_json([outcome])))
    assert not outcome.breaches, told(outcome)
    assert outcome.tally.done > 1000
    assert outcome.tally.doses > 300
    assert outcome.tally.picks > 100
    assert sum(outcome.faults.values()) > 10_000
