"""The last centimetres by feeling: what the fingers do by the squeeze that the force sensor tells of."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from core.manipulation.approach import READY_M, approaches
from core.manipulation.arm import hand_point
from robot_service.skills.pick import DEEPER_M, FURTHER_M, _grasp

FRUIT = (0.42, 0.05, 0.50)


class Hand:
    """A robot whose arm is where it is told to be, and whose closed fingers squeeze with what `squeezes_n` tells in turn."""

    def __init__(self, way, squeezes_n):
        self.now_s, self.left, self.force_n = 0.0, list(squeezes_n), 0.0
        self.closed_at = []
        self.settings = SimpleNamespace(wrist="roll")
        self.clock = SimpleNamespace(now=lambda: self.now_s)
        self.body = SimpleNamespace(state=SimpleNamespace(arm_rad=way.look), want=self.want, rest=lambda _: None)

    def want(self, *, arm, arm_s, gripper_m, roll_rad=None):
        self.body.state.arm_rad = arm
        if gripper_m == 0.0 and not self.force_n:
            self.force_n = self.left.pop(0)
            self.closed_at.append(hand_point(arm))
        elif gripper_m > 0.0:
            self.force_n = 0.0

    async def tick(self):
        self.now_s += 0.02

    def state(self):
        return SimpleNamespace(force_n=self.force_n)


def grasped(*squeezes_n):
    """Whether anything is held, and how far beyond the fruit's middle the fingers closed, one after another [m]."""
    way = approaches(FRUIT, 0.0135, [])[0]
    hand = Hand(way, squeezes_n)
    held = asyncio.run(_grasp(hand, way, FRUIT, READY_M, DEEPER_M[0]))
    before = hand_point(way.look)
    length = sum((a - b) ** 2 for a, b in zip(FRUIT, before, strict=True)) ** 0.5
    ahead = [(f - b) / length for f, b in zip(FRUIT, before, strict=True)]
    return held, [sum(n * (p - f) for n, p, f in zip(ahead, at, FRUIT, strict=True)) for at in hand.closed_at]


def test_a_fruit_between_the_pads_is_held_at_once():
    held, beyond_m = grasped(6.0)
    assert held
    assert beyond_m == pytest.approx([DEEPER_M[0]])


def test_a_fruit_that_only_the_finger_tips_hold_is_let_go_and_taken_a_centimetre_further_in():
    held, beyond_m = grasped(4.9, 6.0)
    assert held
    assert beyond_m == pytest.approx([DEEPER_M[0], DEEPER_M[0] + FURTHER_M])


def test_a_squeeze_on_nothing_holds_nothing():
    assert grasped(0.1) == (False, pytest.approx([DEEPER_M[0]]))
    assert not grasped(4.9, 0.1)[0], "it slid away between the two"
