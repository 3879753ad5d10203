"""`make mutants`: how many small mistakes in the gate, the store and the market their tests notice."""

from __future__ import annotations

import argparse
import random
import sys
from collections import Counter
from pathlib import Path

from lab.mutants.making import Mutant, mutants
from lab.mutants.trying import Outcome, Part, Trial

ROOT = Path(__file__).resolve().parent.parent.parent
SCORE_MIN = 0.9
ALLOCATION = tuple(sorted(str(path.relative_to(ROOT)) for path in (ROOT / "core/allocation").glob("*.py")))
PARTS = {
    "gate": Part(("robot_service/body/gate.py",), ("tests/robot/body/test_gate.py",)),
    "store": Part(("core/store.py",), ("tests/core/store/test_store.py",)),
    "allocation": Part(
        ALLOCATION,
        (
            "tests/core/allocation",
            *(f"tests/robot/brain/test_{name}.py" for name in ("bidding", "deadlines", "queue", "right_of_way")),
        ),
        sample=300,
        without="random_goals",
    ),
}
"""Without the tests that kill processes, since what runs in another process does not see the mistake, and without the
slowest walks of robots."""


def score(root: Path, name: str, part: Part, seed: int, sample: int | None, only: str = "") -> float:
    """Try a part's mutants, tell about them, and return the share that was noticed. `only`: what a file's path must hold."""
    trial = Trial(root, part)
    made = [(file, mutant) for file, source in trial.sources.items() if only in file for mutant in mutants(source)]
    chosen = made if sample is None or sample >= len(made) else _drawn(made, seed, sample)
    outcomes: Counter[Outcome] = Counter()
    try:
        for number, (file, mutant) in enumerate(chosen, 1):
            outcome = trial.try_one(file, mutant)
            outcomes[outcome] += 1
            if outcome in ("survived", "unreached"):
                why = "" if outcome == "survived" else ": no test runs it"
                print(f"{file}:{mutant.line} survived{why}\n{mutant.diff(trial.sources[file])}\n", flush=True)
            if number % 50 == 0:
                print(f"{name}: {number} of {len(chosen)}", file=sys.stderr, flush=True)
    finally:
        trial.close()
    killed, survived = outcomes["killed"] + outcomes["timeout"], outcomes["survived"] + outcomes["unreached"]
    share = killed / len(chosen) if chosen else 0.0
    drawn = f" of {len(made)}, seed {seed}" if len(chosen) < len(made) else ""
    unended, unreached = outcomes["timeout"], outcomes["unreached"]
    print(f"{name}: {len(chosen)} mutants{drawn}; {killed} killed ({unended} by time), {survived} survived", end=" ")
    print(f"({unreached} never run); {share:.1%}", flush=True)
    return share


def _drawn(made: list[tuple[str, Mutant]], seed: int, sample: int) -> list[tuple[str, Mutant]]:
    numbers = sorted(random.Random(seed).sample(range(len(made)), sample))
    return [made[number] for number in numbers]


def main() -> None:
    parser = argparse.ArgumentParser(description="Put small mistakes into the code; do its tests notice?")
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=f"of {', '.join(PARTS)}; all if left out")
    parser.add_argument("--all", action="store_true", help="every mutant, where a run takes a sample otherwise")
    parser.add_argument("--sample", type=int, help="so many mutants of each part")
    parser.add_argument("--only", default="", help="only files whose path holds this")
    parser.add_argument("--seed", type=int, default=1, help="draws the sample")
    given = parser.parse_args()
    if unknown := set(given.parts) - set(PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    shares = []
    for name in given.parts:
        sample = None if given.all else given.sample or PARTS[name].sample
        shares.append(score(ROOT, name, PARTS[name], given.seed, sample, given.only))
    raise SystemExit(0 if min(shares) >= SCORE_MIN else 1)


if __name__ == "__main__":
    main()
