"""Gardens under faults on virtual time: nothing that must hold may break, and what runs is a function of its seed."""

import json
import os
import subprocess
import sys

import pytest

from lab.soak.cli import soak_all
from lab.soak.run import Plan, as_json, soak

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
    script = "from lab.soak.run import *; o = soak(Plan(seed=3, days=0.01, hurry=2.0)); print(o.trace, o.faults)"
    runs = [_output(script, os.environ | {"PYTHONHASHSEED": seed}) for seed in ("1", "2")]
    assert runs[0] == runs[1] != ""


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
    outcomes = soak_all([Plan(seed=seed, days=0.5) for seed in range(1001, 1061)], 2, lambda outcome: print(outcome.seed))
    assert not any(outcome.breaches for outcome in outcomes), "\n".join(map(told, outcomes))


@pytest.mark.soak
def test_six_weeks_of_one_garden_break_nothing():
    outcome = soak(Plan(seed=42, days=42.0))
    assert not outcome.breaches, told(outcome)
