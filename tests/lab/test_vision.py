"""Labelled images are read, split and judged as their labels say; the commands print what a program can read."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from core.errors import ConfigError
from core.perception.detection import Detection
from lab.bench import detector as bench
from lab.experiments import detector as experiment
from lab.vision import dataset, evaluate, see, train

RED_BGR, GREEN_BGR = (0, 0, 255), (0, 200, 0)


def squares(image):
    """A detector that finds squares painted in pure colours."""
    found = []
    for colour, bgr in (("red", RED_BGR), ("green", GREEN_BGR)):
        mask = cv2.inRange(image, np.array(bgr) * 0.8, np.array(bgr) * 1.2 + 40)
        count, _, stats, centres = cv2.connectedComponentsWithStats(mask)
        for (u, v), stat in list(zip(centres, stats, strict=True))[1:count]:
            half = stat[cv2.CC_STAT_WIDTH] / 2
            found.append(Detection(u_px=float(u), v_px=float(v), radius_px=float(half), colour=colour, confidence=1.0))
    return found


def album(folder: Path, count: int, *, wrong: int = 0, **extra) -> Path:
    """`count` pictures of one red and one green square; in the first `wrong` of them nothing is labelled."""
    (folder / "images").mkdir(parents=True)
    entries = []
    for index in range(count):
        image = np.full((60, 80, 3), 30, np.uint8)
        image[10:20, 10:20], image[30:44, 50:64] = RED_BGR, GREEN_BGR
        name = f"images/a{index * 10}.png"
        cv2.imwrite(str(folder / name), image)
        red, green = {"x": 10, "y": 10, "w": 10, "h": 10}, {"x": 50, "y": 30, "w": 14, "h": 14}
        boxes = [] if index < wrong else [red | {"label": "red"} | extra, green | {"label": "green"}]
        entries.append({"file": name, "width": 80, "height": 60, "boxes": boxes})
    dataset.write(folder, entries)
    return folder


def run(command, *words):
    app = typer.Typer()
    app.command()(command)
    outcome = CliRunner().invoke(app, [str(word) for word in words])
    return outcome.exit_code, outcome.stdout


def test_precision_and_recall_are_printed_as_json(tmp_path):
    folder = album(tmp_path / "a", 4, wrong=1)
    code, text = run(evaluate.evaluate_command, "detector", "--images", folder, "--with", f"{__name__}:squares", "--json")
    assert code == 0
    told = json.loads(text)
    assert told["images"] == 4
    assert told["red"] == {"precision": 0.75, "recall": 1.0, "f1": pytest.approx(0.8571)}
    assert told["red_green"] == {"precision": 0.75, "recall": 1.0, "f1": pytest.approx(0.8571)}
    assert told["ms_per_frame"] > 0


def test_hidden_rendered_fruit_are_difficult(tmp_path):
    (photograph,) = dataset.read(album(tmp_path / "a", 1, visible_ratio=0.39))
    assert [box.difficult for box in photograph.boxes] == [True, False]


def test_labels_may_lie_elsewhere(tmp_path):
    folder = album(tmp_path / "a", 2)
    labels = (folder / "labels.json").rename(tmp_path / "other.json")
    assert len(dataset.read(folder, labels)) == 2
    with pytest.raises(ConfigError):
        dataset.read(folder)


@pytest.mark.parametrize("text", ["{}", "[{}]", "nonsense"])
def test_labels_of_another_form_are_refused(tmp_path, text):
    (tmp_path / "labels.json").write_text(text)
    with pytest.raises(ConfigError):
        dataset.read(tmp_path)


def test_groups_are_never_divided_and_a_seed_gives_one_split(tmp_path):
    photographs = [dataset.Photograph(path=tmp_path / f"{k}.png", boxes=(), group=f"scene-{k // 5}") for k in range(100)]
    one, again, other = (dataset.split(photographs, seed) for seed in (3, 3, 4))
    assert one == again
    assert one != other
    assert {p.group for p in one.train} & {p.group for p in one.validation} == set()
    assert sorted((*one.train, *one.validation), key=lambda p: int(p.path.stem)) == photographs
    assert len(one.validation) == 30


def test_the_split_is_the_same_wherever_the_folders_lie(tmp_path):
    def kept(*folders):
        photographs = [
            dataset.Photograph(path=folder / "images" / f"{k}.png", boxes=(), group=f"{folder.name}/{k}")
            for folder in folders
            for k in range(40)
        ]
        return {p.group for p in dataset.split(photographs, 3).validation}

    assert kept(tmp_path / "b" / "apples", tmp_path / "a" / "pears") == kept(tmp_path / "apples", tmp_path / "pears")


def test_overlapping_photographs_are_one_group_and_others_are_not(tmp_path):
    rng = np.random.default_rng(11)
    scenes = [cv2.resize(rng.integers(0, 255, (30, 40, 3), np.uint8), (640, 480)) for _ in range(2)]
    views = [scenes[0][:400, :520], scenes[0][60:460, 90:610], scenes[1][:400, :520]]
    photographs = []
    for number, view in zip((10, 50, 90), views, strict=True):
        path = tmp_path / f"v{number}.png"
        cv2.imwrite(str(path), view)
        photographs.append(dataset.Photograph(path=path, boxes=(), group=f"x/{path.name}"))
    a, b, c = dataset.grouped(photographs)
    assert a.group == b.group != c.group


def test_neighbours_in_number_are_one_group(tmp_path):
    photographs = []
    for number in (10, 12, 90):
        path = tmp_path / f"v{number}.png"
        cv2.imwrite(str(path), np.full((40, 40, 3), number, np.uint8))
        photographs.append(dataset.Photograph(path=path, boxes=(), group=f"x/{path.name}"))
    a, b, c = dataset.grouped(photographs)
    assert a.group == b.group != c.group


def test_seeing_writes_a_picture_of_every_stage(tmp_path):
    picture = album(tmp_path / "a", 1) / "images" / "a0.png"
    code, text = run(see.see_command, picture, "--stages", tmp_path / "stages", "--json")
    assert code == 0
    assert isinstance(json.loads(text), list)
    names = [path.stem.split("-", 1)[1] for path in sorted((tmp_path / "stages").iterdir())]
    assert names[0] == "balanced"
    assert names[-1] == "detections"
    assert {"smooth", "red", "green", "area_red", "circles_red", "highlight", "combined_red"} <= set(names)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (evaluate.evaluate_command, ["taste", "--images", "."]),
        (evaluate.evaluate_command, ["detector", "--which", "perfect", "--images", "."]),
        (see.see_command, ["no-such-picture.png"]),
        (train.train_command, ["perfect", "--data", "."]),
    ],
)
def test_what_cannot_be_done_is_status_2(command, words):
    assert run(command, *words)[0] == 2


def test_a_missing_detector_and_missing_photographs_miss_their_bars_with_a_reason(monkeypatch):
    picture = np.zeros((48, 64, 3), np.uint8)
    frame = experiment.Rendered(picture=picture, boxes=(), group="g")
    monkeypatch.setattr(experiment, "fresh_frames", lambda count, seed: [frame] * count)
    monkeypatch.setattr(experiment, "detector", lambda name: (_ for _ in ()).throw(ConfigError(f"no {name}")))
    monkeypatch.delenv("TOMATOES", raising=False)
    result = experiment.detector_experiment(2, 1, squares, lambda line: None)
    missed = {bar.metric for bar in result.bars if not bar.ok}
    assert {"filter_red_precision", "filter_ms", "features_ms", "photograph_red_f1"} <= missed
    assert any("no filter" in note for note in result.notes)
    assert any("TOMATOES" in note for note in result.notes)
    json.dumps(result.document(), allow_nan=False)


def test_the_bench_measures_the_filter_beside_bare_opencv():
    row = bench._row("filter", bench.picture(np.random.default_rng(1)), lambda: None, 1)
    assert row["unit"] == "ms"
    assert row["ours"] > 0
    assert row["target"] == "ours <= 10"
