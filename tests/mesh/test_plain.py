"""JSON without mercy: the quick look and the close one agree."""

from __future__ import annotations

import json
import random

import pytest

from core.mesh.plain import NotFinite, _look_closer, check, surely_plain

DOCUMENT = {
    "task_id": "plant-1:1:1", "cost_s": 30.5, "n": 7, "more": {"a": [1, {"b": None}], "k": "x"}, "url": "http://a:1/",
}  # fmt: skip
PIECES = (
    b'"', b":", b",", b"{", b"}", b"[", b"]", b"\\", b" ", b"\n", b"NaN", b"1e999", b"9" * 320, b"-", b"\xff", b'"a":1,',
    b'":', b'"k" :2,', b'":x":1,', b"null", b"\x00", b"\xef\xbb\xbf", b'"\\u0061":3,', b"[" * 40,
)  # fmt: skip


def refused(raw: bytes) -> bool:
    try:
        _look_closer(raw)
    except ValueError:
        return True
    return False


@pytest.mark.parametrize("seed", range(4))
def test_what_the_quick_look_passes_the_close_one_passes_too(seed: int) -> None:
    print(f"seed {seed}")
    rng = random.Random(seed)
    compact, passed, bad = json.dumps(DOCUMENT, separators=(",", ":")).encode(), 0, 0
    for _ in range(4000):
        raw = bytearray(rng.choice((compact, json.dumps(DOCUMENT).encode(), compact * 2)))
        for _ in range(rng.randrange(3)):
            at = rng.randrange(len(raw) + 1)
            raw[at : at + rng.choice((0, 0, 1, 5))] = rng.choice(PIECES)
        wrong = refused(bytes(raw))
        bad += wrong
        if surely_plain(bytes(raw)):
            passed += 1
            assert not wrong, bytes(raw)
    assert passed > 200
    assert bad > 1000


@pytest.mark.parametrize(
    "text",
    [
        '{"a":1,"a":1}', '{"a":1,"a" :1}', '{"a":1,"a"\n:1}',
        '{"a":":","a":1}', '{"a":[{"b":1,"b":2}]}', '{"a":1,"\\u0061":1}', '{":a":1,":a":2}',
        '{"a":"b","b":":","b":1}', '[{"a":1},{"a":1,"a":1}]', '{"a"\t:1,"b":":","a"\t:1}',
    ],
)  # fmt: skip
def test_a_doubled_key_is_found_wherever_it_hides(text: str) -> None:
    assert json.loads(text)
    with pytest.raises(ValueError, match="comes twice"):
        check(text.encode())


def test_the_same_key_in_two_objects_is_no_doubled_one_and_own_documents_need_only_the_quick_look() -> None:
    raw = json.dumps([DOCUMENT, DOCUMENT], separators=(",", ":")).encode()
    check(raw)
    assert surely_plain(raw)


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e309", "-1e309", "9" * 309, "1" + "0" * 400 + ".5"])
def test_numbers_that_no_float_holds_are_told_apart(number: str) -> None:
    with pytest.raises(NotFinite):
        check(f'{{"a":[{number}]}}'.encode())
    with pytest.raises(NotFinite):
        check(number.encode())
