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
TABLE_II = (("Beginning of street 1", 0.09224), ("Beginning of street 9", 0.0326), ("End of street 5", 0.0598),
            ("Between", 0.0489), ("Street 6", 0.0543))  # fmt: skip
PAPER_MEDIAN, PAPER_MSE, PAPER_MED_M, PAPER_ACCURACY = 0.0489, 0.057568, 0.804, 0.9752
DRIVES = {"same_drive": "the survey's own drive", "other_drive": "another drive"}
TITLES = {
    "streetfix": "Streetfix, trained on these frames and pairs",
    "streetfix_as_paper": "the same, on as many images as the paper's CNN",
    "streetfix_stock": "Streetfix as shipped (never saw this city)",
    "cnn_knn": "CNN + K-NN",
    "cnn_softmax": "CNN, its own softmax",
    "icp_pointnetlk_googlenet": "ICP + PointNetLK + GoogLeNet",
    "googlenet_pointnetlk": "the same before ICP",
    "googlenet": "the same before PointNetLK",
    "scan_context": "Scan Context",
    "raw_range": "raw range image",
    "dual_encoder": "dual encoder, no view alignment (LIP-Loc's kind)",
    "fov_encoder": "encoder with field-of-view alignment, no registration (ModaLink's kind)",
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
        f"{title} (`{variant}`, chosen of {ran} on pairs kept aside)"
        if ran > 1
        else f"{title} (`{variant}`, no other has run)"
    )


def table_one(data: PaperData) -> list[str]:
    """Return Table I: frames and test images of each class.

    Args:
        data: shared data.
    """
    frames = np.bincount(np.asarray(data.frames.street), minlength=16)
    tests = {split: np.bincount(np.asarray(data.tests[split].street), minlength=16) for split in SPLITS}
    lines = [
        "## Table I: frames and test images", "",
        (f"The paper's approximate counts add up to {sum(FRAMES_PRINTED):,}, its text says {PAPER_FRAMES:,}: their proportions are kept, "
        "the total is the text's."), "",
        "| class | frames, paper | frames, here | test images, paper | same drive | other drive |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for k, name in enumerate(CLASS_NAMES):
        lines.append(
            f"| {name} | {FRAMES_PRINTED[k]} | {frames[k]} | {TEST_IMAGES[k]} | "
            f"{tests['same_drive'][k]} | {tests['other_drive'][k]} |"
        )
    own, other = (tests[split].sum() for split in SPLITS)
    lines.append(f"| together | {sum(FRAMES_PRINTED)} | {frames.sum()} | {sum(TEST_IMAGES)} | {own} | {other} |")
    return lines


def table_two(data: PaperData, results: Mapping[str, MethodResult]) -> list[str]:
    """Return Table II: the five cases by one image and by all images, and the errors of the printed column.

    Args:
        data: shared data.
        results: results by method.
    """
    shown = [name for name in ("cnn_knn", "streetfix") if name in results]
    lines = [
        "## Table II: five cases", "",
        ("The paper's column is called MSE, has no unit and one random image a case. Here: the error of one random image of the class "
        "(m), and over all of them mean (m), median (m) and mean square (m2), on another drive."), "",
        "| case | paper | " + " | ".join(f"{n}: one | mean | median | mean square" for n in shown) + " |",
        "|---|---|" + "---|" * (4 * len(shown)),
    ]  # fmt: skip
    test = data.tests["other_drive"]
    street = np.asarray(test.street)
    errors = {name: errors_of(results[name].answers["other_drive"], test) for name in shown}
    rng = np.random.default_rng(0)
    told: list[list[float]] = []  # one row per case
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
        told.append(of_case)
        lines.append(f"| {name} | {printed} | " + " | ".join(f"{value:.3f}" for value in of_case[1:]) + " |")
    for title, of in (("mean of the cases", np.mean), ("median of the cases", np.median)):
        over = of(np.array(told), axis=0) if told else []
        lines.append(
            f"| {title} | "
            + " | ".join(f"{value:.4g}" if k == 0 else f"{value:.3f}" for k, value in enumerate(over))
            + " |"
        )
    column = np.array([value for _, value in TABLE_II])
    least = PAPER_MED_M**2
    return [
        *lines, "",
        (f"The mean of the printed column is {column.mean():.6f}, as printed; its median is {np.median(column):.4f}, not the printed "
        f"{PAPER_MEDIAN}, which is the fourth case's own value."),
        (f"A mean square of {PAPER_MSE} and a mean distance of {PAPER_MED_M} m cannot both be metric: the mean of squares is never less "
        f"than the square of the mean, so {PAPER_MED_M} m forces at least {least:.3f} m2. The paper counts distance in frames, of which "
        "its simulator records 30 to 50 a metre."),
    ]  # fmt: skip


def table_three(results: Mapping[str, MethodResult], figures: Figures, pace: Pace | None) -> list[str]:
    """Return Table III: errors, street accuracy and training of every method.

    Args:
        results: results by method.
        figures: figures by method and split.
        pace: measured training pace; None if absent.
    """
    lines = [
        "## Table III: methods", "",
        ("Queries are RGB-D pairs. Training time is processor time of all cores; making the data is not in it, drawing batches is. "
        f"*At the paper's images*: for the 130,875 images that its 84 iterations show, {_paced(pace)}."), "",
        ("| method | mean error, other drive (m) | median (m) | street, other drive | mean error, same drive (m) "
        "| street, same drive | training (min) | at the paper's images (min) | training set |"),
        "|---|---|---|---|---|---|---|---|---|",
        "| ICP + PointNetLK + GoogLeNet, as the paper prints | - | - | - | 30.3 | - | 4200 | - | 7600 |",
        "| CNN + PCA + K-NN, as the paper prints | - | - | - | 0.804 | 0.9752 | 138 | 138 | 46741 |",
    ]  # fmt: skip
    for method in TITLES:
        if method not in figures:
            continue
        other, own, result = figures[method]["other_drive"], figures[method]["same_drive"], results[method]
        minutes = minutes_for_paper_images(method, result, pace)
        spent = "beforehand" if result.training_s is None else f"{result.training_s / 60:.1f}"
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
        return "scaled from each method's own run"
    rounds = len(next(iter(pace.seconds_an_image.values())))
    return (
        f"by steps of all methods in turn within one run ({rounds} rounds, medians; {pace.run.machine}, one thread each, commit "
        f"`{pace.run.commit[:10]}`); of the paper's baseline its first network alone"
    )
