"""Single queries on a page: both images, ground truth and answer on the map, and the outcome."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.evaluation.failures import WHY, Stage
from model_training.evaluation.predict import Predictions
from model_training.reporting.pictures import colour_uri, depth_uri
from model_training.reporting.plan import Plan


@dataclass(frozen=True, slots=True)
class Shown:
    """A query to show.

    Attributes:
        query_set: name of its set.
        number: number in its set.
        row: row among all queries.
        said: description, HTML.
    """

    query_set: str
    number: int
    row: int
    said: str


def locate(rows: Sequence[int], runs: dict[str, Predictions], *, first_image: int = 0) -> list[tuple[str, int, int]]:
    """Return set, number of the image in the set, and row for rows of the joined sets.

    Args:
        rows: rows of the joined sets.
        runs: answers by set.
        first_image: number of the image whose pose the first query of a set asks for.
    """
    found = []
    for row in rows:
        first = 0
        for name, p in runs.items():
            if row < first + len(p.T_true):
                found.append((name, row - first + first_image, row))
                break
            first += len(p.T_true)
    return found


def said_of(p: Predictions, row: int, stage: Stage, error_m: float) -> str:
    """Describe the outcome of a query as HTML.

    Args:
        p: answers of all sets, joined.
        row: row of the query.
        stage: stage at which it was lost, or success.
        error_m: position error, metres.
    """
    status = str(p.status[row]) or "no answer"
    confidence = "" if np.isnan(p.confidence[row]) else f", confidence {p.confidence[row]:.2f}"
    off = f"{error_m:.2f} m off" if np.isfinite(error_m) else "no position"
    nearest = np.linalg.norm(p.ranked_xy[row] - p.T_true[row, :2, 3], axis=1)
    rank = np.flatnonzero(np.nan_to_num(nearest, nan=np.inf) <= 5.0)
    place = f"right place at rank {rank[0] + 1}" if len(rank) else "right place not among the ten nearest"
    return (
        f'<p><span class="tag">{escape(stage)}</span> {off}; {escape(status)}{confidence}; {place}.<br>'
        f'<span class="soft">{escape(WHY[stage])}</span></p>'
    )


def gallery(
    shown: Sequence[Shown],
    p: Predictions,
    dataset: Dataset | None,
    plan: Plan | None,
    *,
    other: Predictions | None = None,
    has_plan: bool = False,
) -> str:
    """Show queries one below the other as HTML; images need the dataset, and maps need the plan.

    Args:
        shown: queries in their order.
        p: answers of all sets, joined.
        dataset: dataset of the images; None if absent.
        plan: the map from above; None if absent.
        other: another evaluation's answers to the same queries, drawn as well; None for none.
        has_plan: whether the page already contains the map's image.
    """
    frames: dict[str, list[QueryFrame]] = {}
    articles = []
    for each in shown:
        name = escape(f"{each.query_set}, query {each.number}")
        pictures = "" if dataset is None else _pictures(each, dataset, frames, name)
        drawn = ""
        if plan is not None:
            answers = [p.T_answer[each.row, :2, 3]] + ([] if other is None else [other.T_answer[each.row, :2, 3]])
            looked_at = np.concatenate([p.ranked_xy[each.row], p.candidates[each.row, :, :2]])
            drawn = plan.around(p.T_true[each.row, :2, 3], np.stack(answers), looked_at, with_picture=not has_plan)
            has_plan = True
        articles.append(
            f'<article class="query"><h3>{name}</h3>{each.said}<div class="pictures">{pictures}{drawn}</div></article>'
        )
    return "".join(articles)


def _pictures(each: Shown, dataset: Dataset, frames: dict[str, list[QueryFrame]], name: str) -> str:
    if each.query_set not in frames:
        frames[each.query_set] = list(dataset.queries(each.query_set))
    frame = frames[each.query_set][each.number]
    return (
        f'<img src="{colour_uri(frame.rgb())}" alt="Colour image of {name}"><img src="{depth_uri(frame.depth_m())}" '
        f'alt="Depth image of {name}: near is yellow, far is dark, grey is not measured">'
    )
