"""Small line charts as SVG text: a reproduction report needs no more, and a text file can be read in a diff."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

WIDTH, HEIGHT = 640, 320
LEFT, RIGHT, TOP, BOTTOM = 64, 150, 28, 44
COLOURS = ("#c0392b", "#1f7a8c", "#7a5195", "#6a994e")
DASHES = ("", "6 3", "2 3", "8 3 2 3")
"""Colour is never the only signal."""


def line_chart(title: str, x_label: str, y_label: str, series: Mapping[str, Sequence[float]]) -> str:
    """One line a series, x counted from 1, y from 0."""
    top = 1.1 * max((max(values) for values in series.values() if values), default=1.0) or 1.0
    count = max((len(values) for values in series.values()), default=1)
    parts = [_frame(title, x_label, y_label), *_ticks(count, top)]
    for row, (name, values) in enumerate(series.items()):
        points = " ".join(f"{_x(i + 1, count):.1f},{_y(v, top):.1f}" for i, v in enumerate(values))
        stroke = f'stroke="{COLOURS[row % 4]}" stroke-width="2" stroke-dasharray="{DASHES[row % 4]}"'
        y = TOP + 14 + 18 * row
        parts.append(f'<polyline fill="none" {stroke} points="{points}"/>')
        parts.append(f'<line x1="{WIDTH - RIGHT + 10}" x2="{WIDTH - RIGHT + 34}" y1="{y}" y2="{y}" {stroke}/>')
        parts.append(f'<text x="{WIDTH - RIGHT + 40}" y="{y + 4}">{escape(name)}</text>')
    body = "\n".join(parts)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}"'
    return f'{head} font-family="sans-serif" font-size="12">\n{body}\n</svg>\n'


def _x(index: float, count: int) -> float:
    return LEFT + (index - 1) / max(1, count - 1) * (WIDTH - LEFT - RIGHT)


def _y(value: float, top: float) -> float:
    return HEIGHT - BOTTOM - value / top * (HEIGHT - TOP - BOTTOM)


def _frame(title: str, x_label: str, y_label: str) -> str:
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    return "\n".join(
        (
            f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
            f'<text x="{LEFT}" y="18" font-size="14" font-weight="bold">{escape(title)}</text>',
            f'<path d="M{LEFT} {TOP}V{bottom}H{right}" fill="none" stroke="black"/>',
            f'<text x="{(LEFT + right) / 2}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x_label)}</text>',
            f'<text transform="translate(14 {(TOP + bottom) / 2}) rotate(-90)" text-anchor="middle">',
            f"{escape(y_label)}</text>",
        )
    )


def _ticks(count: int, top: float) -> list[str]:
    xs = sorted({1, *(round(1 + k * (count - 1) / 5) for k in range(6))})
    below = [f'<text x="{_x(x, count):.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{x}</text>' for x in xs]
    ys = [top * k / 4 for k in range(5)]
    beside = [f'<text x="{LEFT - 6}" y="{_y(y, top) + 4:.1f}" text-anchor="end">{y:.3g}</text>' for y in ys]
    return below + beside
