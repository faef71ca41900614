"""Write ``reports/paper.md``: the whole comparison on one page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper.claims import by_k, claims, variants
from benchmarks.paper.data import PaperData
from benchmarks.paper.kept import MethodResult
from benchmarks.paper.ours import MOST_STEPS, SHAPE
from benchmarks.paper.pace import Pace
from benchmarks.paper.tables import Figures, table_one, table_three, table_two
from benchmarks.report import head_commit
from research.baselines.paper.cnn import layer_table
from research.baselines.paper.train import PATIENCE, CnnPlan
from research.baselines.regression.train_pose import PoseSettings

#: Rows of the report.
Rows = Sequence[Mapping[str, Any]]


def write_page(
    path: Path,
    data: PaperData,
    results: Mapping[str, MethodResult],
    figures: Figures,
    pictures: Mapping[str, str],
    rows: Rows,
    budget_minutes: float,
    pace: Pace | None = None,
) -> Path:
    """Write the page and return its path.

    Args:
        path: file to write.
        data: shared data.
        results: results by method.
        figures: figures by method and split.
        pictures: paths of the images by title.
        rows: rows of the report.
        budget_minutes: training budget of each learned method, processor minutes.
        pace: measured training pace; None if absent.
    """
    parts = [
        _head(data),
        _bars(rows),
        table_one(data),
        _pictures(pictures),
        _network(),
        table_two(data, results),
        table_three(results, figures, pace),
        claims(results, figures),
        variants(results),
        by_k(results),
        _how(budget_minutes),
        _runs(results, pace),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(line for part in parts for line in [*part, ""]))
    return path


def _head(data: PaperData) -> list[str]:
    made = "; ".join(f"{what} {minutes:.0f}" for what, minutes in data.made_minutes().items())
    return [
        "# The paper, reproduced",
        "",
        f"`make paper` wrote this page at commit `{head_commit()[:10]}`. *Runs* lists the runs that measured the figures, with their",
        "machines. The authors used an Intel Core i5-8250U with 8 GB and MATLAB. Our simulator replaces CARLA. So the figures compare",
        "methods on one city. They do not compare our city with that of the paper.",
        "",
        f"Data: {data.size.frames:,} LiDAR frames, {data.size.pairs:,} RGB-D training pairs, {len(data.tests['other_drive'])} test",
        "images per split. No training time includes the time to make the data. Wall time to make them, in minutes, on two cores",
        f"beside other work: {made}.",
    ]


def _bars(rows: Rows) -> list[str]:
    """Return the bars of our method from the report."""
    lines = [
        "## Requirements for our method",
        "",
        "On another drive, our method must be better than every other method. On the survey's own drive, it must lie within the",
        "confidence interval of the best method. For the same number of images, it must train in fewer minutes.",
        "",
        "| row | ours | bar | holds |",
        "|---|---|---|---|",
    ]
    for row in rows:
        if "bar" in row:
            value = "-" if row["value"] is None else f"{row['value']:.4g}"
            sign = "<=" if row["better"] == "lower" else ">="
            lines.append(
                f"| `{row['id']}` | {value} {row['unit']} | {sign} {row['bar']:.4g} | {'yes' if row['holds'] else '**no**'} |"
            )
    return lines


def _pictures(pictures: Mapping[str, str]) -> list[str]:
    lines = ["## Figures 4 to 8, 10 and 11, and the tables as plots", ""]
    for title, picture in pictures.items():
        lines += [f"**{title}**", "", f"![{title}]({picture})", ""]
    return lines[:-1]


def _network() -> list[str]:
    lines = [
        "## Figure 9: the network",
        "",
        "The caption of the figure names no layer. As in the paper, we count convolution, pooling and fully connected layers.",
        "",
        "| layer | operation | output |",
        "|---|---|---|",
    ]
    return lines + [f"| {number} | {does} | {out} |" for number, does, out in layer_table()]


def _how(budget_minutes: float) -> list[str]:
    plan = CnnPlan("aligned")
    text = Path(__file__).with_name("how_read.md").read_text()
    filled = text.format(
        budget=budget_minutes,
        rate=plan.rate,
        batch=plan.batch,
        patience=PATIENCE,
        rows=SHAPE.rows,
        columns=SHAPE.columns,
        widths=", ".join(map(str, SHAPE.widths)),
        side=PoseSettings().side,
        steps=MOST_STEPS,
    )
    return filled.rstrip().split("\n")


def _runs(results: Mapping[str, MethodResult], pace: Pace | None) -> list[str]:
    """Return the runs of the methods, and the result of the training pace."""
    lines = ["## Runs", "", "| method | commit | machine | training ended by |", "|---|---|---|---|"]
    for name, result in results.items():
        if name not in ("cnn_knn", "cnn_softmax"):  # these stand for one of their variants
            lines.append(
                f"| `{name}` | `{result.run.commit[:10]}` | {result.run.machine or 'not recorded'} | {result.ended} |"
            )
    if pace is None:
        return lines
    ratios = pace.to_the_quickest()
    lines += [
        "",
        (
            f"We timed training steps of all learned methods in turn: commit `{pace.run.commit[:10]}`, {pace.run.machine}, load "
            f"{pace.load[0]:.1f} before and {pace.load[1]:.1f} after. Ratio of our time to that of the fastest other method, by round: "
            f"{', '.join(f'{ratio:.2f}' for ratio in ratios)}."
        ),
        "",
        "| method | milliseconds per image, by round |",
        "|---|---|",
    ]
    for name, times in pace.seconds_an_image.items():
        lines.append(f"| `{name}` | {', '.join(f'{1000 * each:.2f}' for each in times)} |")
    return lines
