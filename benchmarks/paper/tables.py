"""``reports/paper.md``: the paper's tables with its figures beside ours."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.paper.data import PaperData
from benchmarks.paper.kept import SPLITS, MethodResult
from benchmarks.paper.ours import MOST_STEPS, SHAPE
from benchmarks.paper.pace import Pace
from benchmarks.paper.rows import errors_of, minutes_for_paper_images
from benchmarks.report import head_commit, machine
from model_training.baselines.paper.cnn import layer_table
from model_training.baselines.paper.knn import KS, PAPER_K
from model_training.baselines.paper.train import PATIENCE, CnnPlan
from model_training.baselines.paper.variants import WHAT
from model_training.baselines.paper_data.table_one import CLASS_NAMES, FRAMES_PRINTED, PAPER_FRAMES, TEST_IMAGES

#: Table II as printed: class, and what it calls MSE.
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


def write_page(
    path: Path,
    data: PaperData,
    results: Mapping[str, MethodResult],
    figures: Figures,
    pictures: Mapping[str, str],
    budget_minutes: float,
    pace: Pace | None = None,
) -> Path:
    """Write the page and say where it is."""
    parts = [
        _head(data, results),
        _table_one(data),
        _pictures(pictures),
        _network(),
        _table_two(data, results),
        _table_three(results, figures, pace),
        _claims(results, figures),
        _variants(results),
        _ks(results),
        _how(budget_minutes),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(line for part in parts for line in [*part, ""]))
    return path


def _title(method: str, results: Mapping[str, MethodResult]) -> str:
    """A method's title; of the paper's, which variant it is, of how many that have run."""
    title, variant = TITLES[method], results[method].method.removeprefix(f"{method}_")
    if variant == results[method].method:
        return title
    ran = sum(f"{method}_{name}" in results for name in WHAT)
    return (
        f"{title} (`{variant}`, the best of {ran} variants that have run)"
        if ran > 1
        else f"{title} (`{variant}`, no other has run)"
    )


def _head(data: PaperData, results: Mapping[str, MethodResult]) -> list[str]:
    commits = sorted({result.commit[:10] for result in results.values()})
    return [
        "# The paper, reproduced",
        "",
        "Made by `make paper`; none of it is typed by hand. Methods ran at commit "
        + (", ".join(f"`{c}`" for c in commits) or "-")
        + f", the page was written at `{head_commit()[:10]}`,",
        (
            f"on {machine()}; {machines(results)}the paper: Intel Core i5-8250U, 8 GB, MATLAB. CARLA is replaced by our simulator, so "
            "figures compare methods on one city and not our city with theirs."
        ),
        (
            f"Data: {data.size.frames:,} LiDAR frames, {data.size.pairs:,} RGB-D pairs to learn from, "
            f"{len(data.tests['other_drive'])} test images a split."
        ),
    ]


def machines(results: Mapping[str, MethodResult]) -> str:
    """Where methods ran, where it was elsewhere; one of them a clause."""
    by_machine: dict[str, list[str]] = {}
    for result in results.values():
        by_machine.setdefault(result.machine, []).append(result.method)
    clauses = [
        f"{', '.join(f'`{m}`' for m in dict.fromkeys(methods))} on {name or 'a machine that was not kept'}; "
        for name, methods in sorted(by_machine.items())
        if name != machine()
    ]
    return "".join(clauses)


def _table_one(data: PaperData) -> list[str]:
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


def _pictures(pictures: Mapping[str, str]) -> list[str]:
    lines = ["## Figures 4 to 8, 10 and 11", ""]
    for title, picture in pictures.items():
        lines += [f"**{title}**", "", f"![{title}]({picture})", ""]
    return lines[:-1]


def _network() -> list[str]:
    lines = [
        "## Figure 9: the network", "",
        "The figure's text names no layer. Counted are the types that the paper counts by: convolution, pooling, full connection.", "",
        "| layer | does | output |", "|---|---|---|",
    ]  # fmt: skip
    return lines + [f"| {number} | {does} | {out} |" for number, does, out in layer_table()]


def _table_two(data: PaperData, results: Mapping[str, MethodResult]) -> list[str]:
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
    told: list[list[float]] = []  # a row a case
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


def _table_three(results: Mapping[str, MethodResult], figures: Figures, pace: Pace | None) -> list[str]:
    lines = [
        "## Table III: methods", "",
        ("Queries are RGB-D pairs. Training time is processor time of all cores; making the data is not in it (nor is it in the paper's). "
        f"*At the paper's images*: for the 130,875 images that its 84 iterations show, {_paced(pace)}."), "",
        ("| method | mean error, other drive (m) | median (m) | street, other drive | mean error, same drive (m) "
        "| street, same drive | training (min) | at the paper's images (min) | training set |"),
        "|---|---|---|---|---|---|---|---|---|",
        "| ICP + PointNetLK + GoogLeNet, as the paper prints | 30.3 | - | - | - | - | 4200 | - | 7600 |",
        "| CNN + PCA + K-NN, as the paper prints | 0.804 | - | 0.9752 (its drive) | - | - | 138 | 138 | 46741 |",
    ]  # fmt: skip
    for method in TITLES:
        if method not in figures:
            continue
        other, own, result = figures[method]["other_drive"], figures[method]["same_drive"], results[method]
        minutes = minutes_for_paper_images(method, result, pace)
        spent = "beforehand" if result.training_s is None else f"{result.training_s / 60:.1f}"
        lines.append(
            f"| {_title(method, results)} | {other['mean_distance_error_m']:.3f} | {other['median_distance_error_m']:.3f} "
            f"| {other['street_accuracy']:.4f} "
            f"| {own['mean_distance_error_m']:.3f} | {own['street_accuracy']:.4f} | {spent} "
            f"| {'-' if minutes is None else f'{minutes:.1f}'} | {result.training_set} |"
        )
    return lines


def _paced(pace: Pace | None) -> str:
    if pace is None:
        return "scaled from each method's own run"
    rounds = len(next(iter(pace.seconds_an_image.values())))
    return (
        f"by steps of all methods in turn within one run ({rounds} rounds, medians; {pace.machine}, one thread each, commit "
        f"`{pace.commit[:10]}`); of the paper's baseline its first network alone"
    )


def _claims(results: Mapping[str, MethodResult], figures: Figures) -> list[str]:
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
                f"| {_title(method, results)}: street | {accuracy} | "
                + " | ".join(f"{100 * e['street_accuracy']:.2f} %" for e in each)
                + " |"
            )
            lines.append(
                f"| {_title(method, results)}: mean distance | {mean} | "
                + " | ".join(f"{e['mean_distance_error_m']:.3f} m" for e in each)
                + " |"
            )
    printed = results.get("cnn_knn_as_printed")
    if printed is not None:
        asked = printed.extra["asked"]["lidar.same_drive"]
        accuracy, mean = asked["knn"][str(PAPER_K)]
        lines += [
            "", ("What the 97.52 % can have been: LiDAR frames of the same drive, a random 30 % of them, asked of the other 70 %, whose "
            f"nearest stand centimetres away. That gives {100 * accuracy:.2f} % and {mean:.3f} m here (K-NN, {asked['n']} frames), by the "
            f"softmax {100 * asked['softmax'][0]:.2f} %. It holds no RGB-D image and no other drive."),
        ]  # fmt: skip
    return lines


SETS = {
    "lidar.same_drive": "LiDAR, same drive (30 %)", "lidar.other_drive": "LiDAR, other drive", "same_drive": "RGB-D, same drive",
    "other_drive": "RGB-D, other drive", "depth.other_drive": "depth alone, other drive",
}  # fmt: skip


def _variants(results: Mapping[str, MethodResult]) -> list[str]:
    known = {name: results[f"cnn_knn_{name}"] for name in WHAT if f"cnn_knn_{name}" in results}
    if not known:
        return []
    lines = [
        "## The paper's method, every way it can be meant", "",
        (f"Street accuracy by K-NN (k = 5) / by softmax, and K-NN's mean distance. "
        f"Answering the commonest class of the test images alone gives {max(TEST_IMAGES) / sum(TEST_IMAGES):.3f}."), "",
        "| variant | " + " | ".join(SETS.values()) + " | training (min) | images shown | ended |",
        "|---|" + "---|" * (len(SETS) + 3),
    ]  # fmt: skip
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
    """What becomes of the paper's two claims: K-NN beats the network's own classifier, and PCA earns its place."""
    lines = []
    for key, what in SETS.items():
        asked = {name: result.extra["asked"][key] for name, result in known.items()}
        better = [name for name, each in asked.items() if each["knn"][str(PAPER_K)][0] > each["softmax"][0]]
        lines.append(
            f"- K-NN beats softmax, {what}: in {len(better)} of {len(asked)} variants"
            + (f" ({', '.join(f'`{n}`' for n in better)})." if 0 < len(better) < len(asked) else ".")
        )
    if {"converged", "without_pca"} <= set(known):
        told = [
            f"{what} {known['converged'].extra['asked'][key]['knn'][str(PAPER_K)][0]:.3f} with, "
            f"{known['without_pca'].extra['asked'][key]['knn'][str(PAPER_K)][0]:.3f} without"
            for key, what in SETS.items()
        ]
        lines.append("- PCA, by K-NN: " + "; ".join(told) + ".")
    return lines


def _ks(results: Mapping[str, MethodResult]) -> list[str]:
    known = {name: results[f"cnn_knn_{name}"] for name in WHAT if f"cnn_knn_{name}" in results}
    if not known:
        return []
    lines = ["## K-NN against softmax, k from 1 to 21", "", "Street accuracy; the paper takes k = 5.", ""]
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


def _how(budget_minutes: float) -> list[str]:
    plan = CnnPlan("aligned")
    return [
        "## How it was read", "",
        ("- 84 iterations in 4 epochs of 21 over 70 % of 46,741 frames make batches of 1,558 (summed over parts of 128). SGDM, rate 3e-4, "
        "momentum 0.9."),
        (f"- The others have up to {budget_minutes:g} minutes of processor time each, or end when what they watch (stretches of "
        "street, or pairs, of the "
        "training drives that they are not shown) stops gaining."),
        (f"- The paper's network, where it is trained on: SGDM at {plan.rate:g} in batches of {plan.batch}, a fifth of the rate whenever "
        f"{PATIENCE} quarters of an epoch bring no gain, ended by the third such rest; the best state answers."),
        (f"- Ours: views of {SHAPE.rows} x {SHAPE.columns} cells and layers of {', '.join(map(str, SHAPE.widths))} channels, half the "
        "shipped encoder's columns and narrower, since it must know one city alone; it ends after "
        f"{MOST_STEPS:,} steps of 256 images at the latest."),
        ("- Pairs: half ride on the survey's own drive, half on another with other vehicles, both directions, up to 2 m aside. Same-drive "
        "queries stand on the survey's track among its vehicles; other-drive ones come from a drive that nothing was learnt from."),
        "- `cnn_knn` and `cnn_softmax` are the variants that do best on training pairs kept aside; no test was looked at to choose.",
        ("- K-NN's position is that of the nearest frame of the class that wins; the softmax is taken to answer the middle of its class. "
        "A query without an answer counts with the middle of all places."),
    ]  # fmt: skip
