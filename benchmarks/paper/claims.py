"""Check the paper's figures and claims: 97.52 %, 0.804 m, K-NN and PCA, under every reading of its method."""

from collections.abc import Mapping, Sequence

from benchmarks.paper.kept import SPLITS, MethodResult
from benchmarks.paper.tables import DRIVES, Figures, title
from model_training.evaluation.error_measures import wilson_interval
from research.baselines.paper.knn import KS, PAPER_K
from research.baselines.paper.variants import WHAT
from research.baselines.paper_data.table_one import TEST_IMAGES


def claims(results: Mapping[str, MethodResult], figures: Figures) -> list[str]:
    """Return Markdown on the paper's two headline figures, on both traversals, and a possible origin of the first.

    Args:
        results: results by method.
        figures: figures by method and split.
    """
    lines = [
        "## 97.52 % and 0.804 m",
        "",
        "| | paper | " + " | ".join(DRIVES[s] for s in SPLITS) + " |",
        "|---|---|---|---|",
    ]
    for method in ("cnn_knn", "streetfix"):
        if method in figures:
            each = [figures[method][split] for split in SPLITS]
            accuracy, mean = "97.52 %" if method == "cnn_knn" else "", "0.804 m" if method == "cnn_knn" else ""
            lines.append(
                f"| {title(method, results)}: street | {accuracy} | "
                + " | ".join(f"{100 * e['street_accuracy']:.2f} %" for e in each)
                + " |"
            )
            lines.append(
                f"| {title(method, results)}: mean distance | {mean} | "
                + " | ".join(f"{e['mean_distance_error_m']:.3f} m" for e in each)
                + " |"
            )
    printed = results.get("cnn_knn_as_printed")
    if printed is not None:
        answers = printed.extra["asked"]["lidar.same_drive"]
        accuracy, mean = answers["knn"][str(PAPER_K)]
        lines += [
            "",
            (
                "A possible origin of the 97.52 %: the queries were a random 30 % of the LiDAR frames of one drive, and the database the "
                "other 70 %. Their nearest frames are centimetres away. Here this split gives "
                f"{100 * accuracy:.2f} % and {mean:.3f} m with K-NN ({answers['n']} frames), and {100 * answers['softmax'][0]:.2f} % with "
                "softmax. It tests no RGB-D image and no other drive."
            ),
        ]
    return lines


SETS = {
    "lidar.same_drive": "LiDAR, same drive (30 %)",
    "lidar.other_drive": "LiDAR, other drive",
    "same_drive": "RGB-D, same drive",
    "other_drive": "RGB-D, other drive",
    "depth.other_drive": "depth alone, other drive",
}


def variants(results: Mapping[str, MethodResult]) -> list[str]:
    """Return a Markdown table: a row per variant of the paper's method, a column per kind of query.

    Args:
        results: results by method.
    """
    known = {name: results[f"cnn_knn_{name}"] for name in WHAT if f"cnn_knn_{name}" in results}
    if not known:
        return []
    lines = [
        "## Variants of the paper's method",
        "",
        (
            "Each cell has the street accuracy by K-NN (k = 5), that by softmax, and the mean distance by K-NN. A constant answer, the "
            f"most frequent class of the test images, has an accuracy of {max(TEST_IMAGES) / sum(TEST_IMAGES):.3f}."
        ),
        "",
        "| variant | " + " | ".join(SETS.values()) + " | training (min) | images shown | training ended by |",
        "|---|" + "---|" * (len(SETS) + 3),
    ]
    for name, result in known.items():
        cells = []
        for key in SETS:
            each = result.extra["asked"][key]
            accuracy, mean = each["knn"][str(PAPER_K)]
            cells.append(f"{accuracy:.3f} / {each['softmax'][0]:.3f}, {mean:.1f} m")
        lines.append(
            f"| `{name}` | "
            + " | ".join(cells)
            + f" | {(result.training_s or 0) / 60:.1f} | {result.images:,} | {result.ended} |"
        )
    return [*lines, "", *(f"- `{name}`: {WHAT[name]}." for name in known), "", *verdicts(known)]


def verdicts(known: Mapping[str, MethodResult]) -> list[str]:
    """Return Markdown on two claims: K-NN beats the network's own classifier, and PCA helps.

    One share beats another if their 95 % intervals do not overlap.

    Args:
        known: results by variant.
    """
    lines = []
    for key, what in SETS.items():
        answers = {name: result.extra["asked"][key] for name, result in known.items()}
        better = [
            n for n, each in answers.items() if beats(each["knn"][str(PAPER_K)][0], each["softmax"][0], each["n"])
        ]
        worse = [n for n, each in answers.items() if beats(each["softmax"][0], each["knn"][str(PAPER_K)][0], each["n"])]
        lines.append(
            f"- {what}, {len(answers)} variants: K-NN beats softmax in {_named(better)}. Softmax beats K-NN in {_named(worse)}."
        )
    if {"converged", "without_pca"} <= set(known):
        accuracies = [
            f"{what} {known['converged'].extra['asked'][key]['knn'][str(PAPER_K)][0]:.3f} with, "
            f"{known['without_pca'].extra['asked'][key]['knn'][str(PAPER_K)][0]:.3f} without"
            for key, what in SETS.items()
        ]
        lines.append("- Accuracy of K-NN with and without PCA: " + "; ".join(accuracies) + ".")
    return lines


def beats(one: float, other: float, n: int) -> bool:
    """Return whether a share of ``n`` is significantly larger than another: their 95 % intervals do not overlap.

    Args:
        one: the first share.
        other: the second share.
        n: number of queries of each.
    """
    return wilson_interval(round(one * n), n)[0] > wilson_interval(round(other * n), n)[1]


def _named(names: Sequence[str]) -> str:
    return f"{len(names)} ({', '.join(f'`{name}`' for name in names)})" if names else "none"


def by_k(results: Mapping[str, MethodResult]) -> list[str]:
    """Return a Markdown table of softmax and K-NN for every k.

    Args:
        results: results by method.
    """
    known = {name: results[f"cnn_knn_{name}"] for name in WHAT if f"cnn_knn_{name}" in results}
    if not known:
        return []
    lines = ["## K-NN and softmax, k from 1 to 21", "", "The figures are street accuracies. The paper uses k = 5.", ""]
    lines += [
        "| variant, queries | softmax | " + " | ".join(f"k={k}" for k in KS) + " |",
        "|---|" + "---|" * (len(KS) + 1),
    ]
    for name, result in known.items():
        for key in ("lidar.same_drive", "lidar.other_drive", "other_drive"):
            each = result.extra["asked"][key]
            cells = [f"{each['softmax'][0]:.3f}", *(f"{each['knn'][str(k)][0]:.3f}" for k in KS)]
            lines.append(f"| `{name}`, {SETS[key]} | " + " | ".join(cells) + " |")
    return lines
