"""A scatter of points in logarithmic axes with their front, as SVG text: no plotting library goes with the product."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

from pipeline.trade import front
from pipeline.trade.work import Row

WIDTH, HEIGHT = 760, 470
LEFT, RIGHT, TOP, BOTTOM = 70, 20, 20, 50
COLOURS = {"base": "#c23b32", "preset": "#b4541a", "knob": "#4c78a8", "design": "#54a24b"}
STEPS, FINE_STEPS = (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7)


def pareto_svg(rows: Sequence[Row], figure: str, name: str) -> str:
    """Error over CPU seconds of all rows that have both, the front drawn through its points."""
    shown = [row for row in rows if front.is_measured(row) and (row["errors"].get(figure) or 0) > 0]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" '
        f'font-size="12"><rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>'
    )
    if not shown:
        return f'{head}<text x="{LEFT}" y="{TOP + 20}">no point with an error above 0</text></svg>\n'
    across = Axis([row["cpu_seconds"] for row in shown], LEFT, WIDTH - RIGHT)
    up = Axis([row["errors"][figure] for row in shown], HEIGHT - BOTTOM, TOP)
    parts = [head]
    for value in across.ticks():
        x = across.at(value)
        parts.append(f'<path d="M{x:.1f} {TOP}V{HEIGHT - BOTTOM}" stroke="#ddd"/>')
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{value:g}</text>')
    for value in up.ticks():
        y = up.at(value)
        parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" stroke="#ddd"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    parts.append(f'<text x="{(LEFT + WIDTH) / 2:.0f}" y="{HEIGHT - 12}" text-anchor="middle">CPU seconds</text>')
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text transform="translate(18 {middle:.0f}) rotate(-90)" text-anchor="middle">error, {name}</text>')
    best = sorted((row["cpu_seconds"], row["errors"][figure]) for row in shown if row["front"][figure])
    line = " ".join(f"{across.at(x):.1f},{up.at(y):.1f}" for x, y in best)
    parts.append(f'<polyline points="{line}" fill="none" stroke="#333" stroke-width="1.2"/>')
    for row in shown:
        x, y = across.at(row["cpu_seconds"]), up.at(row["errors"][figure])
        named = row["kind"] in ("base", "preset")
        size = 6 if named else 4
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{size}" fill="{COLOURS[row["kind"]]}" fill-opacity="0.75">'
            f"<title>{escape(row['label'])}</title></circle>"
        )
        if named or row["front"][figure]:
            weight = "bold" if named else "normal"
            parts.append(f'<text x="{x + 7:.1f}" y="{y - 6:.1f}" font-weight="{weight}">{escape(row["label"])}</text>')
    for number, (kind, words) in enumerate(
        {"base": "base", "preset": "preset", "knob": "one knob changed", "design": "combination"}.items()
    ):
        y = TOP + 16 + 17 * number
        parts.append(f'<circle cx="{WIDTH - 150}" cy="{y - 4}" r="4" fill="{COLOURS[kind]}"/>')
        parts.append(f'<text x="{WIDTH - 140}" y="{y}">{words}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


class Axis:
    """A logarithmic axis over positive values, from one picture coordinate to another, with a margin of 8 %."""

    def __init__(self, values: Sequence[float], start: float, end: float) -> None:
        low, high = math.log10(min(values)), math.log10(max(values))
        margin = 0.08 * (high - low) or 0.1
        self.low, self.high, self.start, self.end = low - margin, high + margin, start, end

    def at(self, value: float) -> float:
        """Picture coordinate of a value."""
        share = (math.log10(value) - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Round values within the axis: 1, 2, 5 of every decade, more of them where there is but one."""
        steps = STEPS if self.high - self.low > 1 else FINE_STEPS
        decades = range(math.floor(self.low), math.ceil(self.high) + 1)
        values = [step * 10.0**decade for decade in decades for step in steps]
        return [value for value in values if self.low <= math.log10(value) <= self.high]
