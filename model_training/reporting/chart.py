"""Frame of every chart: matplotlib draws it as SVG, and the page holds it as an image without scripts and links."""

import base64
import io
from collections.abc import Callable, Mapping
from html import escape
from typing import Any

from cycler import cycler
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

#: Colours of series, and of text and grid. Each is readable on the background of a chart, which is always light.
SERIES = ("#20262c", "#0b6fa4", "#b45309", "#3f7d3a", "#8e3b8a", "#a3262a", "#6b6a1f")
_SOFT, _RULE, _PAPER = "#5d6873", "#d9d6cf", "#fdfcf9"
_SIZE_IN = (5.0, 3.2)
_STYLE: Mapping[str, Any] = {
    "svg.fonttype": "none",  # text stays text
    "text.parse_math": False,  # a name may hold any sign
    "svg.hashsalt": "streetfix",  # the same figure gives the same ids
    "font.size": 9,
    "axes.prop_cycle": cycler(color=SERIES),
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.edgecolor": _RULE,
    "axes.labelcolor": _SOFT,
    "axes.facecolor": _PAPER,
    "figure.facecolor": _PAPER,
    "savefig.facecolor": _PAPER,
    "grid.color": _RULE,
    "xtick.color": _SOFT,
    "ytick.color": _SOFT,
    "legend.frameon": False,
}


def chart(title: str, alt_text: str, draw: Callable[[Axes], None], *, legend: bool = False) -> str:
    """Draw a chart and return it as an HTML image. The same data give the same bytes.

    Args:
        title: title of the chart.
        alt_text: content in words, for screen readers.
        draw: function that draws on the axes.
        legend: whether to add a legend of the labelled series below the axes.
    """
    svg = base64.b64encode(picture(title, draw, legend=legend)).decode()
    return f'<img class="plot" src="data:image/svg+xml;base64,{svg}" alt="{escape(f"{title}: {alt_text}")}">'


def picture(title: str, draw: Callable[[Axes], None], *, legend: bool = False, form: str = "svg") -> bytes:
    """Draw a chart and return the content of an image file.

    Args:
        title: title of the chart.
        draw: function that draws on the axes.
        legend: whether to add a legend of the labelled series below the axes.
        form: format of the file, ``svg`` or ``png``.
    """
    with style.context(["default", dict(_STYLE)]):
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        draw(figure.add_subplot())
        if legend:
            figure.legend(loc="outside lower left", ncols=3)
        written = io.BytesIO()
        metadata = {"Date": None, "Creator": None, "Title": title} if form == "svg" else None
        figure.savefig(written, format=form, metadata=metadata)
    return written.getvalue()


def shares_up(axes: Axes, label: str) -> None:
    """Let the vertical axis show shares from 0 to 1 in per cent.

    Args:
        axes: axes of the chart.
        label: text of the axis.
    """
    axes.set(ylim=(0.0, 1.0), ylabel=label)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=""))
