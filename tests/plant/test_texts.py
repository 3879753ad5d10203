"""The inventory's JSON, made of what is known already: always the document itself."""

from __future__ import annotations

import json
import random

from core.wire.fruit import Fruit, Inventory
from plant_service.inventory import InventoryDocument
from plant_service.texts import FruitTexts

COLOURS = ("green", "turning", "red")


def a_fruit(rng: random.Random, number: int) -> Fruit:
    pose = {"x_m": rng.random(), "y_m": 0.0, "yaw_rad": 0.1} if rng.random() < 0.5 else None
    body = {"fruit_id": f"f{number}", "colour": rng.choice(COLOURS), "robot_pose": pose, "radius_m": 0.01}
    return Fruit.model_validate(body | {axis: rng.uniform(-1.0, 1.0) for axis in ("x_m", "y_m", "z_m")})


def test_after_any_changes_the_text_reads_back_as_the_document() -> None:
    seed = 3
    print("seed", seed)
    rng, texts = random.Random(seed), FruitTexts()
    inventory = Inventory(plant_id="plant-1")
    for number in range(60):
        fruits = [each for each in inventory.fruits if rng.random() < 0.95] + [a_fruit(rng, number)]
        if rng.random() < 0.3:
            fruits[0] = fruits[0].model_copy(update={"colour": "red", "last_seen_s": float(number)})
        inventory = inventory.model_copy(update={"generation": number, "fruits": fruits})
        document = InventoryDocument(inventory=inventory, used=number, scans=["a"])
        assert InventoryDocument.model_validate_json(texts.stored(document)) == document
        assert Inventory.model_validate_json(texts.inventory(inventory)) == inventory


def test_an_empty_inventory_is_a_document_too() -> None:
    inventory = Inventory(plant_id="plant-1")
    assert json.loads(FruitTexts().inventory(inventory))["fruits"] == []
    document = InventoryDocument(inventory=inventory)
    assert InventoryDocument.model_validate_json(FruitTexts().stored(document)) == document
