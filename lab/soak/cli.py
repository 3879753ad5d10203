"""`garden soak`: many gardens on all cores, every invariant judged, one line to replay whatever broke."""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Annotated

import typer
from rich.console import Console

from core.errors import ConfigError
from lab.soak.run import Outcome, Plan, as_json, soak

FIRST = 1
CLUSTER_WITHIN_S = 20.0
_ALONE = threading.Lock()


def soak_all(plans: list[Plan], jobs: int, told: Callable[[Outcome], None], cluster: str = "") -> list[Outcome]:
    """Run them on `jobs` processes, or on a Dask cluster; `told` hears of each as it ends. In the order of the plans.

    `cluster` is the address of its scheduler; raises ConfigError when that cannot be reached.
    """
    if not cluster and (jobs <= 1 or len(plans) <= 1):
        return [_told(soak(plan), told) for plan in plans]
    with _on_dask(cluster) if cluster else _on_cores(min(jobs, len(plans))) as pool:
        futures = [pool.submit(_soak_alone, plan) for plan in plans]
        for future in as_completed(futures):
            told(future.result())
        return [future.result() for future in futures]


def _on_cores(jobs: int) -> Executor:
    return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))


@contextmanager
def _on_dask(scheduler: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError("a soak on a cluster needs Dask", hint="pip install 'robot-garden[cluster]'") from error
    try:
        client = Client(scheduler, timeout=CLUSTER_WITHIN_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ConfigError(f"no Dask scheduler at {scheduler}: {error}", hint="`dask scheduler` starts one") from error
    with client:
        yield client.get_executor(pure=False)  # type: ignore[no-untyped-call]


def _soak_alone(plan: Plan) -> Outcome:
    """A garden has its process to itself: workers may have several threads, and the soak changes loops and clocks."""
    with _ALONE:
        return soak(plan)


def _told(outcome: Outcome, told: Callable[[Outcome], None]) -> Outcome:
    told(outcome)
    return outcome


def soak_command(
    days: Annotated[float, typer.Option(min=0.01, help="Garden days a seed")] = 0.5,
    seeds: Annotated[int, typer.Option(min=1, help="How many gardens")] = 2,
    first: Annotated[
        int, typer.Option("--first", "--seed", min=0, help="The first garden's seed; the others follow")
    ] = FIRST,
    hurry: Annotated[float, typer.Option(min=0.1, max=20, help="How much more often things are asked and go wrong")] = 1.0,
    jobs: Annotated[int, typer.Option(min=0, help="Processes; 0: one a core")] = 0,
    cluster: Annotated[str, typer.Option(help="A Dask scheduler (tcp://HOST:8786) whose workers run them")] = "",
    as_one_json: Annotated[bool, typer.Option("--json", help="Print one JSON document")] = False,
) -> None:
    """Live through whole gardens with faults on virtual time and judge every invariant. Exit 1 when one broke."""
    tell = Console(stderr=True)
    plans = [Plan(seed=seed, days=days, hurry=hurry) for seed in range(first, first + seeds)]
    ended = 0

    def told(outcome: Outcome) -> None:
        nonlocal ended
        ended += 1
        broken = f", [bold red]{len(outcome.breaches)} broken[/]" if outcome.breaches else ""
        faults = sum(outcome.faults.values())
        tell.print(f"{ended}/{seeds} seed {outcome.seed}: {outcome.tally.tasks} tasks, {faults} faults{broken}")
        for line in _lines(outcome):
            tell.print(line, highlight=False, markup=False, soft_wrap=True)

    outcomes = soak_all(plans, jobs or len(os.sched_getaffinity(0)), told, cluster)
    document = as_json(outcomes)
    if as_one_json:
        print(json.dumps(document))
    else:
        for name, value in document.items():
            print(f"{name}: {json.dumps(value)}")
    if document["broken_invariants"]:
        sys.exit(1)


def _lines(outcome: Outcome) -> Iterator[str]:
    for breach in outcome.breaches:
        yield f"  {breach.invariant} at {breach.at_s:.1f} s: {breach.what}"
        yield from (f"      {line}" for line in breach.story)
    if outcome.breaches:
        yield f"  replay: {outcome.plan.replay()}"
