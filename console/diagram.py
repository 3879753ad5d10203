"""A task's story as a message sequence, time downwards, as in paper 000's figure 13: for a terminal, as SVG, as Mermaid."""

from __future__ import annotations

import textwrap
from html import escape
from pathlib import Path

from console.story import Step, Story
from core.errors import ConfigError

COLUMN = 32
LEFT = 22
"""Characters before the first lifeline: the time, and room for what is noted at it."""
COLUMN_PX, LEFT_PX, ROW_PX, TOP_PX = 300, 190, 26, 64
HEAD_PX = 7


def write(story: Story, path: Path) -> None:
    """The diagram as the file's name asks: `.svg`, `.mmd` (Mermaid) or `.txt`; raises ConfigError for another."""
    makers = {".svg": svg, ".mmd": mermaid, ".txt": text}
    if (make := makers.get(path.suffix)) is None:
        raise ConfigError(f"cannot draw a {path.suffix or 'file without ending'}", hint=f"one of: {', '.join(makers)}")
    try:
        path.write_text(make(story))
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error


# ------------------------------------------------------------------ a terminal


def text(story: Story) -> str:
    """Lifelines are bars, messages arrows; what is too long for its arrow is cut."""
    names = story.parties()
    at = {name: LEFT + COLUMN * i for i, name in enumerate(names)}
    lines = [_put(" " * (LEFT + COLUMN * len(names)), [(x - len(name) // 2, name) for name, x in at.items()])]
    before_s = None
    for step in story.steps:
        drawn = _arrow(step, at) if step.target else _note(step, at)
        if step.t_s != before_s:
            drawn[0] = _put(drawn[0], [(0, f"{step.t_s:9.1f} s")])
        lines += drawn
        before_s = step.t_s
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _put(line: str, parts: list[tuple[int, str]]) -> str:
    for x, part in parts:
        line = line[:x] + part + line[x + len(part) :]
    return line


def _bars(at: dict[str, int]) -> str:
    return _put(" " * (max(at.values()) + COLUMN), [(x, "|") for x in at.values()])


def _arrow(step: Step, at: dict[str, int]) -> list[str]:
    source, target = at[step.source], at[step.target]
    left, right = min(source, target), max(source, target)
    label = f" {_cut(step.what, right - left - 8)} "
    shaft = label.center(right - left - 3, "-")
    drawn = f"{shaft}->" if target == right else f"<-{shaft}"
    return [_put(_bars(at), [(left + 1, drawn)])]


def _note(step: Step, at: dict[str, int]) -> list[str]:
    rows = textwrap.wrap(step.what, COLUMN - 5) or [""]
    x = at[step.source] + 2
    return [_put(_bars(at), [(x, ("* " if i == 0 else "  ") + row)]) for i, row in enumerate(rows)]


def _cut(words: str, length: int) -> str:
    return words if len(words) <= length else words[: length - 1] + "…"


# ------------------------------------------------------------------ files


def mermaid(story: Story) -> str:
    """A `sequenceDiagram`; names become P0, P1 ... as Mermaid takes no dash in them."""
    ids = {name: f"P{i}" for i, name in enumerate(story.parties())}
    lines = ["sequenceDiagram", *(f"  participant {id_} as {name}" for name, id_ in ids.items())]
    for step in story.steps:
        words = f"{step.t_s:.1f} s: {_plain(step.what)}"
        if step.target:
            lines.append(f"  {ids[step.source]}->>{ids[step.target]}: {words}")
        else:
            lines.append(f"  Note over {ids[step.source]}: {words}")
    return "\n".join(lines) + "\n"


def _plain(words: str) -> str:
    """Without what Mermaid reads as syntax."""
    return words.replace(";", ",").replace("#", "no. ").replace("\n", " ")


def svg(story: Story) -> str:
    """A drawing of its own, with nothing loaded from elsewhere."""
    names = story.parties()
    at = {name: LEFT_PX + COLUMN_PX * i for i, name in enumerate(names)}
    rows, y = list[str](), TOP_PX
    before_s = None
    for step in story.steps:
        if step.t_s != before_s:
            rows.append(f'<text x="12" y="{y + 4}" class="time">{step.t_s:.1f} s</text>')
        drawn, high_px = _svg_arrow(step, at, y) if step.target else _svg_note(step, at, y)
        rows.append(drawn)
        y += high_px
        before_s = step.t_s
    wide, high = LEFT_PX + COLUMN_PX * len(names), y + 20
    lines = [f'<line x1="{x}" y1="40" x2="{x}" y2="{high - 12}" class="life"/>' for x in at.values()]
    heads = [f'<text x="{x}" y="28" class="name">{escape(name)}</text>' for name, x in at.items()]
    return _SVG.format(wide=wide, high=high, body="\n".join([*lines, *heads, *rows]))


def _svg_arrow(step: Step, at: dict[str, int], y: int) -> tuple[str, int]:
    source, target = at[step.source], at[step.target]
    back = HEAD_PX if target < source else -HEAD_PX
    head = f"{target},{y} {target + back},{y - 4} {target + back},{y + 4}"
    middle = (source + target) // 2
    room = (abs(target - source) - 20) // 6
    return (
        f'<line x1="{source}" y1="{y}" x2="{target}" y2="{y}" class="sent"/><polygon points="{head}"/>'
        f'<text x="{middle}" y="{y - 5}" class="said">{escape(_cut(step.what, room))}</text>'
    ), ROW_PX


def _svg_note(step: Step, at: dict[str, int], y: int) -> tuple[str, int]:
    x = at[step.source]
    rows = textwrap.wrap(step.what, (COLUMN_PX - 24) // 6) or [""]
    spans = "".join(f'<tspan x="{x + 12}" dy="{15 if i else 0}">{escape(row)}</tspan>' for i, row in enumerate(rows))
    drawn = f'<circle cx="{x}" cy="{y - 1}" r="3"/><text y="{y + 3}" class="note">{spans}</text>'
    return drawn, ROW_PX + 15 * (len(rows) - 1)


_SVG = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" width="{wide}" height="{high}">
<style>
text {{ font: 12px sans-serif; fill: #222 }}
.name {{ font-weight: bold; font-size: 14px; text-anchor: middle }}
.said {{ text-anchor: middle }}
.note {{ fill: #555 }}
.time {{ fill: #777 }}
.life {{ stroke: #bbb }}
.sent {{ stroke: #222 }}
</style>
<rect width="100%" height="100%" fill="#fff"/>
{body}
</svg>
"""
