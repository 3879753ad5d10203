"""Labelled images: `labels.json` beside `images/`, split by what they show.

`labels.json` is `[{"file", "width", "height", "boxes": [{"x", "y", "w", "h", "label", "difficult"?, "ambiguous"?,
"visible_ratio"?}], "group"?}]`, pixels, origin top left. Rendered frames carry `visible_ratio` and a `group`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from core.errors import ConfigError
from core.perception.detection import Box, Image

LABELS = "labels.json"
GROUPS = Path(__file__).with_name("groups.json")
"""Groups of the development photographs, found once by `compared`."""
VISIBLE_RATIO_MIN = 0.4
"""Rendered fruit hidden more than this allows are `difficult` (DESIGN, section 8)."""
VALIDATION_SHARE = 0.3
SPLIT_SEED = 7
SAME_SCENE_INLIERS = 8
"""So many points of two photographs moved alike say that they show the same plant; unrelated ones had at most 6."""
ALIKE_BITS = 40
"""Descriptors (of 256 bits) that differ by fewer are taken for the same corner."""
NEIGHBOURS = 3
"""Photographs of one folder whose numbers differ by no more are taken as one visit."""

Array = NDArray[Any]


class LabelBox(BaseModel):
    """One box of `labels.json`; what else it says (where a label came from) is not read."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    x: float
    y: float
    w: Annotated[float, Field(gt=0)]
    h: Annotated[float, Field(gt=0)]
    label: Literal["green", "turning", "red"]
    difficult: bool = False
    ambiguous: bool = False
    visible_ratio: Annotated[float, Field(ge=0, le=1)] | None = None

    def box(self) -> Box:
        hidden = self.visible_ratio is not None and self.visible_ratio < VISIBLE_RATIO_MIN
        return Box(
            x_px=self.x,
            y_px=self.y,
            width_px=self.w,
            height_px=self.h,
            label=self.label,
            difficult=self.difficult or hidden,
            ambiguous=self.ambiguous,
        )


class LabelledImage(BaseModel):
    """One image of `labels.json`."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    file: str
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]
    boxes: tuple[LabelBox, ...]
    group: str | int | None = None


_LABELS = TypeAdapter(tuple[LabelledImage, ...])


class Example(Protocol):
    """A labelled image, wherever it comes from."""

    @property
    def boxes(self) -> tuple[Box, ...]: ...
    @property
    def group(self) -> str: ...
    def image(self) -> Image: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Photograph:
    """A labelled image file. Images of one `group` show the same thing and stay on one side of a split."""

    path: Path
    boxes: tuple[Box, ...]
    group: str

    def image(self) -> Image:
        """The pixels; raises ConfigError when the file is not an image."""
        pixels = cv2.imread(str(self.path), cv2.IMREAD_COLOR)
        if pixels is None:
            raise ConfigError(f"cannot read an image from {self.path}")
        return np.asarray(pixels, np.uint8)


@dataclass(frozen=True, slots=True)
class Split:
    """What may be learnt from, and what is kept for judging."""

    train: tuple[Photograph, ...]
    validation: tuple[Photograph, ...]


def read(folder: Path, labels: Path | None = None) -> tuple[Photograph, ...]:
    """The labelled images of a folder, or of its sub-folders that hold a `labels.json`.

    Without a `group` of its own an image is its own group (`grouped` finds those that belong together). Raises
    ConfigError when there are none or a file is wrong.
    """
    if labels is not None:
        return tuple(_read(folder, labels))
    found = [folder] if (folder / LABELS).is_file() else sorted(path.parent for path in folder.glob(f"*/{LABELS}"))
    if not found:
        raise ConfigError(f"no {LABELS} in {folder} or the folders in it", hint="see lab/vision/dataset.py for the form")
    return tuple(photograph for part in found for photograph in _read(part, part / LABELS))


def _read(folder: Path, labels: Path) -> Iterator[Photograph]:
    try:
        entries = _LABELS.validate_json(labels.read_bytes())
    except (OSError, ValidationError) as error:
        raise ConfigError(f"cannot read {labels}: {error}") from error
    for entry in entries:
        path = folder / entry.file
        group = f"{folder.name}/{entry.file if entry.group is None else entry.group}"
        yield Photograph(path=path, boxes=tuple(box.box() for box in entry.boxes), group=group)


def write(folder: Path, entries: Sequence[dict[str, Any]]) -> None:
    """Write `labels.json` (the images are the caller's)."""
    (folder / LABELS).write_text(json.dumps(list(entries), indent=1) + "\n")


def split(photographs: Sequence[Photograph], seed: int = SPLIT_SEED, share: float = VALIDATION_SHARE) -> Split:
    """Whole groups go to validation, drawn by `seed`, as many as fit into each folder's share of images.

    Folders draw one after another in the order of their names, wherever they lie.
    """
    rng = np.random.default_rng(seed)
    train: list[Photograph] = []
    validation: list[Photograph] = []
    for folder in sorted({p.path.parent for p in photographs}, key=lambda path: (path.parent.name, path)):
        mine = [p for p in photographs if p.path.parent == folder]
        groups = sorted({p.group for p in mine})
        wanted = round(share * len(mine))
        chosen: set[str] = set()
        for index in rng.permutation(len(groups)):
            if sum(p.group in chosen | {groups[int(index)]} for p in mine) <= wanted:
                chosen.add(groups[int(index)])
        validation += [p for p in mine if p.group in chosen]
        train += [p for p in mine if p.group not in chosen]
    return Split(tuple(train), tuple(validation))


def grouped(photographs: Sequence[Photograph]) -> tuple[Photograph, ...]:
    """The same photographs with groups: overlapping views of one scene, and neighbours in the order they were taken.

    Two photographs of a folder belong together when enough of their corners (ORB) moved alike, or when their numbers
    differ by at most three. What `groups.json` knows already (by folder and file name) is not compared again: that takes
    about a millisecond a pair. Photographs that came with a group keep together anyway.
    """
    known = _known_groups()
    names = [_name(p) for p in photographs]
    old = [replace(p, group=known[name]) for p, name in zip(photographs, names, strict=True) if name in known]
    return (*old, *compared([p for p, name in zip(photographs, names, strict=True) if name not in known]))


def _known_groups() -> dict[str, str]:
    known: dict[str, str] = json.loads(GROUPS.read_text())
    return known


def _name(photograph: Photograph) -> str:
    return f"{photograph.path.parent.parent.name}/{photograph.path.name}"


def compared(photographs: Sequence[Photograph]) -> tuple[Photograph, ...]:
    """The photographs with groups, found by comparing each with each."""
    parent = list(range(len(photographs)))

    def root(k: int) -> int:
        while parent[k] != k:
            k = parent[k]
        return k

    corners = [(np.zeros((0, 2)), None) if _came_with_group(p) else _corners(p.image()) for p in photographs]
    for a, b in combinations(range(len(photographs)), 2):
        one, other = photographs[a], photographs[b]
        if root(a) == root(b) or one.path.parent != other.path.parent:
            continue
        if one.group != other.group and _came_with_group(one) and _came_with_group(other):
            continue
        if one.group == other.group or _neighbours(one.path, other.path) or _overlap(corners[a], corners[b]):
            parent[root(b)] = root(a)
    return tuple(replace(p, group=photographs[root(k)].group) for k, p in enumerate(photographs))


def _came_with_group(photograph: Photograph) -> bool:
    return not photograph.group.endswith(photograph.path.name)


def _neighbours(one: Path, other: Path) -> bool:
    a, b = (re.findall(r"\d+", path.stem) for path in (one, other))
    return bool(a and b) and abs(int(a[-1]) - int(b[-1])) <= NEIGHBOURS


def _corners(image: Image) -> tuple[Array, Array | None]:
    """Corners (N, 2) [px at 480 px] and their descriptors (N, 32)."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = 480 / max(grey.shape)
    points, described = cv2.ORB.create(300).detectAndCompute(
        cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), None
    )
    return np.array([p.pt for p in points], np.float32).reshape(-1, 2), described


def _overlap(one: tuple[Array, Array | None], other: tuple[Array, Array | None]) -> bool:
    """Whether enough corners agree on one shift, turn and scale between half and double."""
    if one[1] is None or other[1] is None:
        return False
    pairs = sorted(cv2.BFMatcher(cv2.NORM_HAMMING).match(one[1], other[1]), key=lambda pair: -pair.distance)
    near = list({pair.trainIdx: pair for pair in pairs if pair.distance < ALIKE_BITS}.values())
    if len(near) < SAME_SCENE_INLIERS:
        return False
    source, target = one[0][[p.queryIdx for p in near]], other[0][[p.trainIdx for p in near]]
    T, inliers = cv2.estimateAffinePartial2D(source, target, ransacReprojThreshold=4)
    if T is None:
        return False
    return bool(0.5 <= np.hypot(T[0, 0], T[1, 0]) <= 2.0) and int(inliers.sum()) >= SAME_SCENE_INLIERS
