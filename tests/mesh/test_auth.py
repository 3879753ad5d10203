"""Only whole, living tokens of this garden are believed."""

from __future__ import annotations

import base64
import json
import random
import stat
from pathlib import Path

import jwt
import pytest

from core.errors import ConfigError, Unauthorised
from core.mesh.auth import Enrolled, GardenKey, Identity, Verifier, make_garden

GARDEN = GardenKey.from_seed(1)
CLAIMS = {"sub": "ann", "role": "operator", "iat": 0, "exp": 100}
AUDIENCE = jwt.decode(GARDEN.issue("a", "viewer", 0).token, options={"verify_signature": False})["aud"]


def b64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def unsigned(claims: dict[str, object]) -> str:
    return f"{b64(json.dumps({'alg': 'none', 'typ': 'JWT'}).encode())}.{b64(json.dumps(claims).encode())}."


def signed(claims: dict[str, object], key: GardenKey = GARDEN) -> str:
    return jwt.encode(claims, key.key, algorithm="EdDSA")


def test_a_token_speaks_for_its_subject_until_it_expires() -> None:
    verifier = GARDEN.verifier()
    token = GARDEN.issue("ann", "operator", now_s=0.0, life_s=100.0).token
    assert (verifier.verify(token, 99.9).subject, verifier.verify(token, 0.0).role) == ("ann", "operator")
    with pytest.raises(Unauthorised, match="expired"):
        verifier.verify(token, 100.0)


BAD = {
    "empty": "",
    "nonsense": "abc",
    "not ascii": "ä.ö.ü",
    "endless": "a" * 100_000,
    "alg none": unsigned(CLAIMS | {"aud": AUDIENCE}),
    "another garden's key": signed(CLAIMS | {"aud": AUDIENCE}, GardenKey.from_seed(2)),
    "another audience": signed(CLAIMS | {"aud": "garden-0"}),
    "no audience": signed(CLAIMS),
    "no expiry": signed({"sub": "a", "role": "operator", "iat": 0, "aud": AUDIENCE}),
    "expiry is a text": signed(CLAIMS | {"aud": AUDIENCE, "exp": "soon"}),
    "no role": signed({"sub": "a", "iat": 0, "exp": 100, "aud": AUDIENCE}),
    "unknown role": signed(CLAIMS | {"aud": AUDIENCE, "role": "king"}),
    "another algorithm": jwt.encode(CLAIMS | {"aud": AUDIENCE}, "s" * 32, algorithm="HS256"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_token_that_is_not_ours_is_not_believed(name: str) -> None:
    with pytest.raises(Unauthorised):
        GARDEN.verifier().verify(BAD[name], 50.0)


def test_a_thousand_tampered_tokens_are_all_refused() -> None:
    seed = 20261122
    print("seed", seed)
    rng = random.Random(seed)
    whole = GARDEN.issue("ann", "viewer", 0.0).token
    verifier = GARDEN.verifier()
    verifier.verify(whole, 1.0)
    letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_."
    for _ in range(1000):
        place = rng.randrange(len(whole) - 1)  # the last letter carries unused bits
        tampered = whole[:place] + rng.choice(letters.replace(whole[place], "")) + whole[place + 1 :]
        with pytest.raises(Unauthorised):
            verifier.verify(tampered, 1.0)


def test_a_known_token_is_not_checked_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    verifier = GARDEN.verifier()
    token = GARDEN.issue("ann", "viewer", 0.0).token
    verifier.verify(token, 1.0)
    monkeypatch.setattr(jwt, "decode", None)
    assert verifier.verify(token, 2.0).subject == "ann"


def test_init_makes_each_node_a_folder_of_its_own(tmp_path: Path) -> None:
    made = make_garden(tmp_path, [Enrolled("plant-1", "plant"), Enrolled("robot-1", "robot", secret=True)], 0.0)
    assert made == ["garden.key", "plant-1", "robot-1", "operator", "viewer"]
    mine = sorted(p.name for p in (tmp_path / "robot-1").iterdir())
    assert mine == ["body.secret", "card", "garden.pub", "node.key", "token"]
    for private in ("garden.key", "plant-1/node.key", "plant-1/token", "robot-1/body.secret"):
        assert stat.S_IMODE((tmp_path / private).stat().st_mode) == 0o600
    identity = Identity.load(tmp_path / "plant-1")
    assert Verifier.load(tmp_path / "robot-1").verify(identity.token, 5.0).role == "plant"


def test_init_again_keeps_what_lives_and_renews_what_expired(tmp_path: Path) -> None:
    make_garden(tmp_path, [Enrolled("plant-1", "plant")], now_s=0.0, life_s=10.0)
    before = Identity.load(tmp_path / "plant-1")
    assert make_garden(tmp_path, [Enrolled("plant-1", "plant")], now_s=5.0, life_s=10.0) == []
    assert Identity.load(tmp_path / "plant-1") == before
    assert make_garden(tmp_path, [Enrolled("plant-1", "plant")], 11.0) == ["plant-1", "operator", "viewer"]
    Verifier.load(tmp_path).verify(Identity.load(tmp_path / "plant-1").token, 12.0)


def test_missing_and_broken_key_files_name_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("nonsense")
    (tmp_path / "garden.pub").write_text("nonsense")
    for load in (Identity.load, Verifier.load, GardenKey.load):
        for folder in (tmp_path, tmp_path / "nowhere"):
            with pytest.raises(ConfigError) as caught:
                load(folder)
            assert "garden init" in caught.value.hint
