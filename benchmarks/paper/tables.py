"""The paper's tables beside our figures, as Markdown."""

from collections.abc import Mapping

import numpy as np

from benchmarks.paper.data import PaperData
from benchmarks.paper.kept import SPLITS, MethodResult
from benchmarks.paper.pace import Pace
from benchmarks.paper.rows import errors_of, minutes_for_paper_images
from research.baselines.paper.variants import WHAT
from research.baselines.paper_data.table_one import CLASS_NAMES, FRAMES_PRINTED, PAPER_FRAMES, TEST_IMAGES

#: Table II as printed: the class, and the value that the paper calls MSE.
TABLE_II = (
    ("Beginning of street 1", 0.09224),
    ("Beginning of street 9", 0.0326),
    ("End of street 5", 0.0598),
    ("Between", 0.0489),
    ("Street 6", 0.0543),
)
PAPER_MEDIAN, PAPER_MSE, PAPER_MED_M, PAPER_ACCURACY = 0.0489, 0.057568, 0.804, 0.9752
DRIVES = {"same_drive": "the survey's own drive", "other_drive": "another drive"}
TITLES = {
    "streetfix": "Streetfix, trained on these frames and pairs",
    "streetfix_as_paper": "Streetfix, trained on as many images as the paper's CNN",
    "streetfix_stock": "Streetfix as shipped (not trained on this city)",
    "cnn_knn": "CNN + K-NN",
    "cnn_softmax": "CNN with softmax",
    "icp_pointnetlk_googlenet": "ICP + PointNetLK + GoogLeNet",
    "googlenet_pointnetlk": "PointNetLK + GoogLeNet, without ICP",
    "googlenet": "GoogLeNet alone",
    "scan_context": "Scan Context",
    "raw_range": "raw range image",
    "dual_encoder": "dual encoder without view alignment (as LIP-Loc)",
    "fov_encoder": "encoder with field-of-view alignment, without registration (as ModaLink)",
}
Figures = Mapping[str, Mapping[str, Mapping[str, float]]]


def title(method: str, results: Mapping[str, MethodResult]) -> str:
    """Return a method's title; for the paper's method also the variant, and the number of variants that ran.

    Args:
        method: name of the method.
        results: results by method.
    """
    title, variant = TITLES[method], results[method].method.removeprefix(f"{method}_")
    if variant == results[method].method:
        return title
    ran = sum(f"{method}_{name}" in results for name in WHAT)
    return (
        f"{title} (`{variant}`, best of {ran} variants on held-out pairs)"
        if ran > 1
        else f"{title} (`{variant}`, the only variant that has run)"
    )


def table_one(data: PaperData) -> list[str]:
    """Return Table I: frames and test images of each class.

    Args:
        data: shared data.
    """
    frames = np.bincount(np.asarray(data.frames.street), minlength=16)
    tests = {split: np.bincount(np.asarray(data.tests[split].street), minlength=16) for split in SPLITS}
    lines = [
        "## Table I: frames and test images",
        "",
        (
            f"The approximate counts of the paper add up to {sum(FRAMES_PRINTED):,}. Its text says {PAPER_FRAMES:,}. "
            "We use the proportions of the counts and the total of the text."
        ),
        "",
        "| class | frames, paper | frames, ours | test images, paper | same drive | other drive |",
        "|---|---|---|---|---|---|",
    ]
    for k, name in enumerate(CLASS_NAMES):
        lines.append(
            f"| {name} | {FRAMES_PRINTED[k]} | {frames[k]} | {TEST_IMAGES[k]} | "
            f"{tests['same_drive'][k]} | {tests['other_drive'][k]} |"
        )
    own, other = (tests[split].sum() for split in SPLITS)
    lines.append(f"| total | {sum(FRAMES_PRINTED)} | {frames.sum()} | {sum(TEST_IMAGES)} | {own} | {other} |")
    return lines


def table_two(data: PaperData, results: Mapping[str, MethodResult]) -> list[str]:
    """Return Table II: the five cases by one image and by all images, and the errors of the printed column.

    Args:
        data: shared data.
        results: results by method.
    """
    shown = [name for name in ("cnn_knn", "streetfix") if name in results]
    lines = [
        "## Table II: five cases",
        "",
        (
            "The paper calls its column MSE. The column has no unit and one random image per case. We give the error of one random "
            "image of the class (m). For all images of the class, we give mean (m), median (m) and mean square (m2). All queries are "
            "from another drive."
        ),
        "",
        "| case | paper | " + " | ".join(f"{n}: one image | mean | median | mean square" for n in shown) + " |",
        "|---|---|" + "---|" * (4 * len(shown)),
    ]
    test = data.tests["other_drive"]
    street = np.asarray(test.street)
    errors = {name: errors_of(results[name].answers["other_drive"], test) for name in shown}
    rng = np.random.default_rng(0)
    errors_by_case: list[list[float]] = []
    for name, printed in TABLE_II:
        rows = np.flatnonzero(street == CLASS_NAMES.index(name))
        if not len(rows):
            lines.append(f"| {name} | {printed} |" + " - |" * (4 * len(shown)))
            continue
        one = int(rng.choice(rows))
        of_case = [printed]
        for method in shown:
            e = errors[method][rows]
            of_case += [errors[method][one], e.mean(), float(np.median(e)), np.square(e).mean()]
        errors_by_case.append(of_case)
        lines.append(f"| {name} | {printed} | " + " | ".join(f"{value:.3f}" for value in of_case[1:]) + " |")
    for title, of in (("mean of the cases", np.mean), ("median of the cases", np.median)):
        over = of(np.array(errors_by_case), axis=0) if errors_by_case else []
        lines.append(
            f"| {title} | "
            + " | ".join(f"{value:.4g}" if k == 0 else f"{value:.3f}" for k, value in enumerate(over))
            + " |"
        )
    column = np.array([value for _, value in TABLE_II])
    least = PAPER_MED_M**2
    return [
        *lines,
        "",
        (
            f"The mean of the printed column is {column.mean():.6f}, as printed. Its median is {np.median(column):.4f}. The paper prints "
            f"{PAPER_MEDIAN}, the value of the fourth case."
        ),
        (
            f"A mean square of {PAPER_MSE} and a mean distance of {PAPER_MED_M} m cannot both be in metres. The mean of squares is at "
            f"least the square of the mean. So a mean of {PAPER_MED_M} m implies at least {least:.3f} m2. The paper counts distance in "
            "frames, and its simulator records 30 to 50 frames per metre."
        ),
    ]


def table_three(results: Mapping[str, MethodResult], figures: Figures, pace: Pace | None) -> list[str]:
    """Return Table III: errors, street accuracy and training of every method.

    Args:
        results: results by method.
        figures: figures by method and split.
        pace: measured training pace; None if absent.
    """
    lines = [
        "## Table III: methods",
        "",
        (
            "Queries are RGB-D pairs. Training time is processor time of all cores. It includes drawing batches, but not making the "
            f"data. *At the paper's images* is the time for 130,875 images, as in the 84 iterations of the paper: {_paced(pace)}."
        ),
        "",
        (
            "| method | mean error, other drive (m) | median (m) | street, other drive | mean error, same drive (m) "
            "| street, same drive | training (min) | at the paper's images (min) | training set |"
        ),
        "|---|---|---|---|---|---|---|---|---|",
        "| ICP + PointNetLK + GoogLeNet, as printed in the paper | - | - | - | 30.3 | - | 4200 | - | 7600 |",
        "| CNN + PCA + K-NN, as printed in the paper | - | - | - | 0.804 | 0.9752 | 138 | 138 | 46741 |",
    ]
    for method in TITLES:
        if method not in figures:
            continue
        other, own, result = figures[method]["other_drive"], figures[method]["same_drive"], results[method]
        minutes = minutes_for_paper_images(method, result, pace)
        spent = "earlier" if result.training_s is None else f"{result.training_s / 60:.1f}"
        learnt_from = "26 other cities" if result.training_s is None else str(result.training_set)
        lines.append(
            f"| {title(method, results)} | {other['mean_distance_error_m']:.3f} | {other['median_distance_error_m']:.3f} "
            f"| {other['street_accuracy']:.4f} "
            f"| {own['mean_distance_error_m']:.3f} | {own['street_accuracy']:.4f} | {spent} "
            f"| {'-' if minutes is None else f'{minutes:.1f}'} | {learnt_from} |"
        )
    return lines


def _paced(pace: Pace | None) -> str:
    if pace is None:
        return "scaled from the training of each method"
    rounds = len(next(iter(pace.seconds_an_image.values())))
    return (
        f"we timed steps of all methods in turn in one run ({rounds} rounds, medians; {pace.run.machine}, one thread each, commit "
        f"`{pace.run.commit[:10]}`). Of the baseline of the paper, only the first network counts"
    )
