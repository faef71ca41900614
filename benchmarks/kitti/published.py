"""Published figures, and the table in ``reports/README.md`` that shows them beside ours."""

from collections.abc import Mapping, Sequence

from benchmarks.kitti.sources import PUBLISHED

#: Table of RangeBEV: R@1 within 10 m in percent, a column for each sequence of ``PUBLISHED``.
PUBLISHED_R1 = {
    "(LC)2": (31, 23, 40, 40, 53, 38),
    "VXP": (24, 18, 33, 30, 44, 24),
    "I2P-Rec": (45, 28, 48, 44, 63, 46),
    "ModaLink": (90, 70, 90, 86, 97, 87),
    "CMVM": (93, 77, 91, 89, 98, 91),
    "RangeBEV": (99, 95, 99, 97, 100, 98),
}
#: Name of the note of ``reports/kitti.json`` that holds this table.
NOTE = f"published_r1_10m_percent_{'_'.join(PUBLISHED)}"
_OURS, _FIGURE = "kitti.published.", ".recall_at_1_10m"
_SOURCE = (
    "R@1 within 10 m in percent, published protocol. All columns but ours come from the table of RangeBEV (arXiv 2502.11742); we did not "
    "run these methods. RangeBEV was trained on other sequences of KITTI, with the same cameras and the same LiDAR. Our encoder was "
    "trained on simulated streets, and our queries have stereo-matched depth. A raw drive is not in that table."
)


def published_lines(rows: Mapping[str, float | None], published: Mapping[str, Sequence[float]]) -> list[str]:
    """Return a Markdown table of our figures and the published ones: a line for each recording.

    Args:
        rows: values of the report's rows by id; shares.
        published: R@1 in percent of each method, for the sequences of ``PUBLISHED``.
    """
    ours = {
        row.removeprefix(_OURS).removesuffix(_FIGURE): value
        for row, value in rows.items()
        if row.startswith(_OURS) and row.endswith(_FIGURE) and value is not None
    }
    # The published methods stand in the order of their mean, the best first.
    methods = sorted(published, key=lambda name: -sum(published[name]))
    lines = [_SOURCE, "", f"| recording | ours | {' | '.join(methods)} |", "|---" * (2 + len(methods)) + "|"]
    for name in (*PUBLISHED, *(each for each in ours if each not in PUBLISHED)):
        told = f"{100 * ours[name]:.0f}" if name in ours else "not measured"
        figures = [f"{published[each][PUBLISHED.index(name)]:g}" if name in PUBLISHED else "" for each in methods]
        lines.append(f"| {name} | {told} | {' | '.join(figures)} |")
    return lines
