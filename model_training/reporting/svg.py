"""Plots as SVG with the page's colours, so that light, dark and print each have their own."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

#: Size of the drawing and its margins (left, right, above, below), in its own units.
_WIDTH, _HEIGHT = 480, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 10, 46
#: Number of series colours of the page.
COLOURS = 7


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis.

    Attributes:
        label: text of the axis.
        low: lower end.
        high: upper end.
        ticks: positions of the numbers and their texts.
        log: whether the axis is logarithmic.
    """

    label: str
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    log: bool = False

    def share(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions of values between the ends of the axis, 0 to 1 inside, in the shape of ``values`` such as (n,).

        Args:
            values: values (n,).
        """
        if self.log:
            values = np.log(np.maximum(values, self.low))
            return np.asarray((values - np.log(self.low)) / (np.log(self.high) - np.log(self.low)))
        return np.asarray((values - self.low) / (self.high - self.low))


@dataclass(frozen=True, slots=True)
class Series:
    """A series of points.

    Attributes:
        name: text of the legend.
        points: points (n, 2).
        line: whether to draw a line; otherwise dots.
        intervals: lower and upper ends of vertical intervals of dots (n, 2); None for none.
    """

    name: str
    points: NDArray[np.float64]
    line: bool = True
    intervals: NDArray[np.float64] | None = None


def percent_axis(label: str) -> Axis:
    """Return an axis of shares.

    Args:
        label: text of the axis.
    """
    return Axis(label, 0.0, 1.0, tuple((k / 5, f"{20 * k}") for k in range(6)))


def plot(title: str, told: str, x: Axis, y: Axis, series: Sequence[Series], *, diagonal: bool = False) -> str:
    """Draw a plot with a frame, a grid and a legend; return SVG.

    Args:
        title: title of the plot.
        told: content in words, for screen readers.
        x: horizontal axis.
        y: vertical axis.
        series: series in the order of drawing, at most ``COLOURS``.
        diagonal: whether to draw the line from corner to corner.
    """
    parts = [_grid(x, y)]
    if diagonal:
        (left, below), (right, above) = _place(x, y, np.array([[x.low, y.low], [x.high, y.high]]))
        parts.append(f'<line class="ideal" x1="{left:.1f}" y1="{below:.1f}" x2="{right:.1f}" y2="{above:.1f}"/>')
    for number, each in enumerate(series):
        at = _place(x, y, each.points)
        if each.line:
            path = " ".join(f"{px:.1f},{py:.1f}" for px, py in at)
            parts.append(f'<polyline class="line s{number % COLOURS}" points="{path}"/>')
            continue
        if each.intervals is not None:
            low = _place(x, y, np.column_stack([each.points[:, 0], each.intervals[:, 0]]))
            high = _place(x, y, np.column_stack([each.points[:, 0], each.intervals[:, 1]]))
            parts += [
                f'<line class="line s{number % COLOURS}" x1="{px:.1f}" y1="{below:.1f}" x2="{px:.1f}" y2="{above:.1f}"/>'
                for (px, below), above in zip(low, high[:, 1], strict=True)
            ]
        parts += [f'<circle class="dot s{number % COLOURS}" cx="{px:.1f}" cy="{py:.1f}" r="3.5"/>' for px, py in at]
    return drawing(title, told, "".join(parts), view=(0, 0, _WIDTH, _HEIGHT), kind="plot") + _legend(series)


def histogram(title: str, told: str, x: Axis, edges: NDArray[np.float64], counts: NDArray[np.int64]) -> str:
    """Draw a histogram; return SVG.

    Args:
        title: title of the plot.
        told: content in words, for screen readers.
        x: horizontal axis.
        edges: edges of the bins (n + 1,).
        counts: counts of the bins (n,).
    """
    most = max(1, int(counts.max(initial=0)))
    step = max(1, int(10 ** np.floor(np.log10(most))) // 2)
    y = Axis(
        "queries",
        0.0,
        most * 1.05,
        tuple((float(k), str(k)) for k in range(0, most + 1, step * max(1, most // (5 * step)))),
    )
    parts = [_grid(x, y)]
    for low, high, number in zip(edges[:-1], edges[1:], counts, strict=True):
        if number:
            (left, below), (right, above) = _place(x, y, np.array([[low, 0.0], [high, float(number)]]))
            parts.append(
                f'<rect class="bar" x="{left + 0.5:.1f}" y="{above:.1f}" width="{max(1.0, right - left - 1):.1f}" '
                f'height="{below - above:.1f}"><title>{number} queries, {low:.3g} to {high:.3g} m</title></rect>'
            )
    return drawing(title, told, "".join(parts), view=(0, 0, _WIDTH, _HEIGHT), kind="plot")


def drawing(title: str, told: str, content: str, *, view: tuple[float, float, float, float], kind: str) -> str:
    """Return an SVG element with a title and a description.

    Args:
        title: title of the drawing.
        told: content in words, for screen readers.
        content: SVG inside the element.
        view: x, y, width and height of the visible area.
        kind: style class.
    """
    box = " ".join(f"{v:.2f}".rstrip("0").rstrip(".") for v in view)
    return f'<svg class="{kind}" viewBox="{box}" role="img" aria-label="{escape(f"{title}: {told}")}">{content}</svg>'


def _grid(x: Axis, y: Axis) -> str:
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    parts = []
    for value, text in x.ticks:
        px = _place(x, y, np.array([[value, y.low]]))[0, 0]
        parts.append(f'<line class="grid" x1="{px:.1f}" y1="{_TOP}" x2="{px:.1f}" y2="{bottom}"/>')
        parts.append(f'<text x="{px:.1f}" y="{bottom + 16}" text-anchor="middle">{escape(text)}</text>')
    for value, text in y.ticks:
        py = _place(x, y, np.array([[x.low, value]]))[0, 1]
        parts.append(f'<line class="grid" x1="{_LEFT}" y1="{py:.1f}" x2="{right}" y2="{py:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{py + 4:.1f}" text-anchor="end">{escape(text)}</text>')
    middle = (_TOP + bottom) / 2
    parts.append(f'<text x="{(_LEFT + right) / 2}" y="{_HEIGHT - 8}" text-anchor="middle">{escape(x.label)}</text>')
    parts.append(
        f'<text x="13" y="{middle}" text-anchor="middle" transform="rotate(-90 13 {middle})">{escape(y.label)}</text>'
    )
    return "".join(parts)


def _place(x: Axis, y: Axis, points: NDArray[np.float64]) -> NDArray[np.float64]:
    right = _LEFT + np.clip(x.share(points[:, 0]), 0, 1) * (_WIDTH - _LEFT - _RIGHT)
    down = _HEIGHT - _BOTTOM - np.clip(y.share(points[:, 1]), 0, 1) * (_HEIGHT - _TOP - _BOTTOM)
    return np.column_stack([right, down])


def _legend(series: Sequence[Series]) -> str:
    if len(series) < 2:
        return ""
    entries = "".join(
        f'<li><i class="key s{k % COLOURS}"></i>{escape(each.name)}</li>' for k, each in enumerate(series)
    )
    return f'<ul class="legend">{entries}</ul>'
