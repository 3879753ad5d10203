"""What `garden reproduce` and `garden bench` print can be read by a program."""

import json

import structlog
import typer
from typer.testing import CliRunner

from lab import reproduce
from lab.bench import cli
from lab.results import Result, held


def chatty(trials, seed, swap, progress):
    structlog.get_logger("robot").info("link up")
    progress("one line for people")
    ours = {"error_m": 0.01}
    return Result(name="chatty", seed=seed, trials=trials, paper={}, ours=ours, bars=held(ours, ("error_m", "<=", 0.02)))


def rows(n):
    structlog.get_logger("robot").info("link up")
    return [{"name": "chatty", "ours": 1.0, "peer": None, "ratio": None, "unit": "s", "n": n}]


def printed(command, *words):
    app = typer.Typer()
    app.command()(command)
    outcome = CliRunner().invoke(app, words)
    return outcome.exit_code, outcome.stdout


def test_json_is_all_that_an_experiment_prints_to_stdout(monkeypatch):
    monkeypatch.setitem(reproduce.EXPERIMENTS, "chatty", f"{__name__}:chatty")
    monkeypatch.setattr(reproduce, "load_object", lambda spec: chatty)
    code, text = printed(reproduce.reproduce_command, "chatty", "--trials", "2", "--json")
    assert code == 0
    assert json.loads(text)["bars"] == [{"metric": "error_m", "value": 0.01, "op": "<=", "bar": 0.02, "ok": True}]


def test_json_is_all_that_a_bench_prints_to_stdout(monkeypatch):
    monkeypatch.setitem(cli.BENCHES, "chatty", "chatty")
    monkeypatch.setattr(cli, "load_object", lambda spec: rows)
    code, text = printed(cli.bench_command, "chatty", "--n", "3", "--json")
    assert code == 0
    assert json.loads(text)[0]["n"] == 3


def test_an_unknown_experiment_names_the_known_ones():
    code, _ = printed(reproduce.reproduce_command, "perpetual-motion")
    assert code == 2
