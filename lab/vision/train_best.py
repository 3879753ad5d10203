"""`garden train best`: the best detector's network, learnt from labelled photographs and rendered frames (extra `train`).

One run of the command gives the packaged weights again: the split, the order and every change to an image come from
the seed.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import core.perception
from core.errors import ConfigError
from core.perception import best
from lab.vision import augment, dataset
from lab.vision.evaluate import evaluate

try:
    import torch
    from torch.nn import functional

    from lab.vision.best_network import FruitNetwork, onnx_bytes
except ImportError as error:
    raise ConfigError(f"training needs more than running: {error}", hint="uv sync --extra train") from error

Array = NDArray[Any]
Progress = Callable[[str], None]

BATCH = 8
RATE = 2e-3
WEIGHT_DECAY = 1e-4
AVERAGE = 0.998
"""The weights that are kept are a running mean of the last steps' (Polyak and Juditsky 1992), of fewer at the beginning."""
SPREAD = 0.09
"""A fruit's blob in the centre map: standard deviation in parts of its box."""
SIZE_WEIGHT, OFFSET_WEIGHT, COLOUR_WEIGHT = 1.0, 0.5, 0.6
TELL_EVERY = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Trust:
    """How far a folder's colours are believed, of boxes it calls ambiguous too, and its share of what is learnt from."""

    colour: float = 1.0
    ambiguous: float = 0.3
    share: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle:
    """So many steps while the rate rises to RATE and falls to nothing, without the folders of these names.

    `margin_cells`: what lies this near to a fruit that may be found or not is not counted either.
    """

    steps: int
    without: tuple[str, ...]
    margin_cells: float


CYCLES = (
    Cycle(steps=2200, without=("rendered_wide",), margin_cells=0.5),
    Cycle(steps=4000, without=("rendered_wide",), margin_cells=0.5),
    Cycle(steps=2400, without=("rendered",), margin_cells=0.0),
    Cycle(steps=2600, without=("rendered",), margin_cells=0.0),
    Cycle(steps=3200, without=("rendered",), margin_cells=0.0),
)
"""Each goes on from where the one before ended (warm restarts: Loshchilov and Hutter 2017); the last sees more gardens."""
TRUST = {"kaggle_cc0": Trust(colour=0.7, ambiguous=0.2), "rendered_wide": Trust(share=1.5)}
"""Folders whose colours were not labelled by hand, and those that hold more to learn than others."""


def train(data: Sequence[Path], out: Path | None, seed: int, progress: Progress) -> None:
    """Train from the train part of the split, write `best.onnx`, and tell how it does on the validation part.

    Raises ConfigError when there is nothing to learn from.
    """
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    parts = dataset.split(dataset.grouped([p for folder in data for p in dataset.read(folder)]), seed)
    if not parts.train:
        raise ConfigError("no images to train from", hint="give --data a folder with labels.json")
    progress(f"{len(parts.train)} images to learn from, {len(parts.validation)} kept for judging")
    network = fitted(parts.train, seed, progress)
    target = (out or Path(core.perception.__path__[0])) / best.WEIGHTS
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(onnx_bytes(network))
    progress(f"wrote {target} ({target.stat().st_size / 1e6:.2f} MB)")
    judge(target, parts.validation, progress)


def judge(weights: Path, photographs: Sequence[dataset.Photograph], progress: Progress) -> None:
    """Tell red and red+green, folder by folder."""
    detect = best.with_weights(weights.read_bytes())
    for folder in sorted({source(p) for p in photographs}):
        judged = evaluate(detect, [p for p in photographs if source(p) == folder])
        scores = ", ".join(f"{name} P {c.precision:.3f} R {c.recall:.3f} F1 {c.f1:.3f}" for name, c in judged.counts.items())
        progress(f"{folder}: {judged.images} images: {scores}; {judged.ms_per_frame:.0f} ms a frame")


def source(photograph: dataset.Photograph) -> str:
    return photograph.group.split("/")[0]


def fitted(photographs: Sequence[dataset.Photograph], seed: int, progress: Progress) -> FruitNetwork:
    """The network after all cycles."""
    torch.manual_seed(seed)
    network: FruitNetwork = FruitNetwork().to(memory_format=torch.channels_last)
    for index, cycle in enumerate(CYCLES):
        scenes, weights = gathered([p for p in photographs if source(p) not in cycle.without] or photographs)
        network = cycled(network, scenes, weights, cycle, np.random.default_rng([seed, index]), progress)
    return network


def cycled(
    network: FruitNetwork,
    scenes: Sequence[augment.Scene],
    weights: Array,
    cycle: Cycle,
    rng: np.random.Generator,
    progress: Progress,
) -> FruitNetwork:
    """The running mean of the network's weights at the end of one cycle; the network itself is changed too."""
    average: FruitNetwork = copy.deepcopy(network)
    network.train()
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=cycle.steps, pct_start=0.1)
    told: list[Array] = []
    for step in range(cycle.steps):
        batch = [augment.sample(scenes, weights, rng) for _ in range(BATCH)]
        losses = losses_of(network, batch, cycle.margin_cells)
        optimiser.zero_grad()
        sum(losses).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
        schedule.step()
        follow(average, network, min(AVERAGE, (1 + step) / (10 + step)))
        told.append(np.array([float(x.detach()) for x in losses]))
        if (step + 1) % TELL_EVERY == 0:
            fruit, offset, size, colour = np.mean(told, 0)
            told.clear()
            done = f"step {step + 1}/{cycle.steps}"
            progress(f"{done}: fruit {fruit:.3f}, offset {offset:.3f}, size {size:.3f}, colour {colour:.3f}")
    return average


def gathered(photographs: Sequence[dataset.Photograph]) -> tuple[list[augment.Scene], Array]:
    """The images in memory, and how often each is drawn: every folder alike, as its trust says."""
    folders = [source(p) for p in photographs]
    trusts = [TRUST.get(folder, Trust()) for folder in folders]
    scenes = [
        augment.scene(p.image(), p.boxes, trust.colour, trust.ambiguous)
        for p, trust in zip(photographs, trusts, strict=True)
    ]
    weights = np.array([trust.share / folders.count(folder) for folder, trust in zip(folders, trusts, strict=True)])
    return scenes, weights / weights.sum()


def follow(average: FruitNetwork, network: FruitNetwork, keep: float) -> None:
    """Move the running mean towards the network; counts and the like are taken over."""
    with torch.no_grad():
        for mean, now in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
            if mean.dtype.is_floating_point:
                mean.lerp_(now, 1 - keep)
            else:
                mean.copy_(now)


def losses_of(network: FruitNetwork, batch: Sequence[augment.Sample], margin_cells: float) -> tuple[Any, ...]:
    """Fruit (focal, Zhou et al. 2019, equation 1), offset, size (both absolute errors) and colour (cross entropy)."""
    images = torch.from_numpy(np.stack([best.planes(s.image) for s in batch])).contiguous(memory_format=torch.channels_last)
    targets = torch.from_numpy(np.stack([target_maps(s, margin_cells) for s in batch]))
    maps = network(images)
    heat, counted, near = targets[:, 0], targets[:, 1], targets[:, 6]
    chance = torch.sigmoid(maps[:, 0]).clamp(1e-4, 1 - 1e-4)
    at_centre = (heat >= 0.999).float()
    fruit = -(
        at_centre * (1 - chance) ** 2 * chance.log() + (1 - at_centre) * (1 - heat) ** 4 * chance**2 * (1 - chance).log()
    )
    fruits = at_centre.sum().clamp(min=1)
    whole = near.sum().clamp(min=1e-3)
    offset = (maps[:, 1:3] - targets[:, 2:4]).abs().sum(1)
    size = (maps[:, 3:5] - targets[:, 4:6]).abs().sum(1)
    colour = functional.cross_entropy(maps[:, 5:8], targets[:, 7].long(), reduction="none")
    believed = near * targets[:, 8]
    return (
        (fruit * counted).sum() / fruits,
        OFFSET_WEIGHT * (offset * near).sum() / whole,
        SIZE_WEIGHT * (size * near).sum() / whole,
        COLOUR_WEIGHT * (colour * believed).sum() / believed.sum().clamp(min=1e-3),
    )


def target_maps(sample: augment.Sample, margin_cells: float) -> Array:
    """(9, h, w): centre heat; counted; offset right, down; log width, height; nearness; colour; trust in the colour.

    Larger fruit first, so that a small one before a large one keeps its cells.
    """
    cells = augment.SIDE_PX // best.STRIDE_PX
    maps = np.zeros((9, cells, cells), np.float32)
    maps[1] = 1
    y, x = np.mgrid[0:cells, 0:cells] + 0.5
    for k in np.argsort(-sample.boxes[:, 2:].prod(1), kind="stable"):
        u, v, w, h = sample.boxes[k] / best.STRIDE_PX
        if not sample.counted[k]:
            within = (np.abs(x - u) <= w / 2 + margin_cells) & (np.abs(y - v) <= h / 2 + margin_cells)
            maps[1][within & (maps[0] < 0.3)] = 0
            continue
        spread_x, spread_y = max(w * SPREAD, 0.5), max(h * SPREAD, 0.5)
        column, row = min(int(u), cells - 1), min(int(v), cells - 1)
        blob = np.exp(-((x - column - 0.5) ** 2) / (2 * spread_x**2) - (y - row - 0.5) ** 2 / (2 * spread_y**2))
        mine = (blob > 0.2) & (blob >= maps[6])
        maps[0] = np.maximum(maps[0], blob)
        maps[1][blob > 0.2] = 1
        maps[2][mine], maps[3][mine] = (u - x)[mine], (v - y)[mine]
        maps[4][mine] = np.log(w * best.STRIDE_PX / best.SIZE_UNIT_PX)
        maps[5][mine] = np.log(h * best.STRIDE_PX / best.SIZE_UNIT_PX)
        maps[6][mine] = blob[mine]
        maps[7][mine] = sample.colours[k]
        maps[8][mine] = sample.trust[k]
    return maps
