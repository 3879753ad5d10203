"""A test of the tests: every mistake of `bugs` must be found by the soak, soon."""

from statistics import median

import bugs
import pytest

from lab.soak.run import Plan, soak

SEEDS_MAX = 200
QUICK = ("acknowledged_before_fsync", "a_repeated_award_is_keyed_and_differs")
"""Found by the first seeds: these run in every test."""


def seeds_until_found(name, seeds_max=SEEDS_MAX):
    """How many gardens are needed, and the invariant that broke; None when none of them found it."""
    for seed in range(1, seeds_max + 1):
        plan = Plan(seed=seed, days=0.05, hurry=3.0, one_breach=True)
        with bugs.BUGS[name]():
            outcome = soak(plan)
        if outcome.breaches:
            assert not soak(plan).breaches, f"seed {seed} breaks without the mistake, too"
            return seed, outcome.breaches[0]
    return None


@pytest.mark.parametrize("name", QUICK)
def test_a_plain_mistake_is_found_by_the_first_seeds(name):
    found = seeds_until_found(name, 3)
    assert found is not None
    print(name, *found)


@pytest.mark.soak
def test_every_planted_bug_is_found_within_200_seeds():
    needed = {}
    for name in bugs.BUGS:
        found = seeds_until_found(name)
        assert found is not None, f"{name} was not found by {SEEDS_MAX} seeds"
        needed[name] = found[0]
        print(f"{name}: seed {found[0]}, {found[1].invariant} {found[1].what}")
    print(f"median {median(needed.values())} of {len(needed)}")
    assert len(needed) >= 12
