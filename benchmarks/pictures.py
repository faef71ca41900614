"""``make pictures``: make the images of README and docs -> docs/pictures.

They show a simulated street, the map coloured by error, and the demo.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray

from benchmarks.report import ROOT
from model_training.datasets.dataset import Dataset
from model_training.evaluation.failures import position_errors
from model_training.evaluation.predict import joined
from model_training.evaluation.saved_run import SavedRun
from model_training.reporting.pictures import depth_bgr
from model_training.reporting.plan import ERRORS, class_of
from service.imaging.fusion import fuse, picture_of
from service.imaging.view_grid import ViewGrid
from service.maps.reader import MapBundle

matplotlib.use("Agg")
import matplotlib.pyplot as plt

OUT = ROOT / "docs" / "pictures"
_STREETFIX = (sys.executable, "-P", "-c", "from service.cli.main import main; main()")
#: Colours by class of error, as in ``page.css``.
_COLOURS = {"e0": "#1b7f5c", "e1": "#5b9bd5", "e2": "#c77700", "e3": "#c22f2f"}
_FRAME = 9
#: Prerequisites, and the command that makes each.
STEPS = {
    "data/small": "simulate --city paper --streets 1,5 --spacing 1.5 --queries 25 --depth precise --depth stereo --out data/small",
    "data/hard": "simulate --city paper --streets 1,5 --spacing 12 --queries 30 --depth precise --depth stereo "
    "--condition fog --blocked 0.45 --heading 60 --out data/hard",
    "maps/small": "build-map data/small --out maps/small",
    "runs/small": "evaluate maps/small data/small --report runs/small",
    "runs/hard": "evaluate maps/small data/hard --report runs/hard",
}
DEMO = "demo --once --streets 3 --queries 8 --port 0 --out demo"


def main() -> None:
    """Make missing prerequisites in the work folder, then draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--work", type=Path, default=ROOT / "out" / "pictures", help="folder of datasets, maps and runs"
    )
    work: Path = parser.parse_args().work
    work.mkdir(parents=True, exist_ok=True)
    OUT.mkdir(parents=True, exist_ok=True)
    for made, command in STEPS.items():
        if not (work / made).exists():
            _streetfix(command, work)
    draw_street(Dataset(work / "data/small"), OUT / "street.png")
    draw_map(
        MapBundle.open(work / "maps/small"),
        [SavedRun.open(work / "runs" / name) for name in ("small", "hard")],
        OUT / "map.png",
    )
    answers, _, _ = _streetfix(DEMO, work).partition(
        "Serve the map again"
    )  # the text after this mark names folders of this machine
    draw_terminal("make demo", answers, OUT / "demo.png")


def _streetfix(command: str, work: Path) -> str:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "104", "NO_COLOR": "1"}
    done = subprocess.run(
        [*_STREETFIX, *command.split()], cwd=work, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    return done.stdout


def draw_street(dataset: Dataset, path: Path, *, width: int = 330) -> None:
    """Draw colour, depth and the 2.5D image of one query side by side.

    Args:
        dataset: dataset of the query.
        path: file to write.
        width: width of each part, pixels.
    """
    frame = list(dataset.queries("drive1_precise"))[_FRAME]
    rgb, depth_m = frame.rgb(), frame.depth_m()
    fused = cv2.cvtColor(picture_of(fuse(rgb, depth_m).planes, ViewGrid().max_range_m), cv2.COLOR_RGB2BGR)
    size = (width, round(rgb.shape[0] * width / rgb.shape[1]))
    parts = [
        cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), size, interpolation=cv2.INTER_AREA),
        depth_bgr(depth_m, width=width),
        cv2.resize(fused, size, interpolation=cv2.INTER_AREA),
    ]
    gap = np.full((size[1], 6, 3), 255, np.uint8)
    _write(path, np.concatenate([parts[0], gap, parts[1], gap, parts[2]], axis=1))


def draw_map(bundle: MapBundle, runs: list[SavedRun], path: Path) -> None:
    """Draw walls from above, and every query coloured by its error; a cross means more than 5 m.

    Args:
        bundle: the map.
        runs: saved evaluations.
        path: file to write.

    Raises:
        ValueError: the map has no cloud.
    """
    p = joined([answers for run in runs for answers in run.predictions.values()])
    errors, xy = position_errors(p), p.T_true[:, :2, 3]
    if bundle.cloud is None:
        raise ValueError(f"{bundle.path} has no cloud to draw")
    surfels = bundle.cloud.unpacked(np.s_[:])
    walls = (surfels["xyz"][:, :2] + bundle.cloud.origin_m[:2])[np.abs(surfels["normal"][:, 2]) < 0.5]
    low, high = xy.min(axis=0) - 22, xy.max(axis=0) + 22
    # North points left: the street is long and the page is wide.
    figure = plt.figure(figsize=(10, 10 * (high - low)[0] / (high - low)[1]), dpi=110)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.scatter(-walls[:, 1], walls[:, 0], s=0.12, color="#888888", linewidths=0, rasterized=True)
    for _, kind, label in ERRORS:
        chosen = np.array([class_of(error) == kind for error in errors])
        axes.scatter(
            -xy[chosen, 1],
            xy[chosen, 0],
            s=34,
            color=_COLOURS[kind],
            marker="x" if kind == "e3" else "o",
            label=f"{label}: {chosen.sum()}",
        )
    axes.set(xlim=(-high[1], -low[1]), ylim=(low[0], high[0]), aspect="equal")
    axes.axis("off")
    axes.legend(loc="upper left", frameon=True, fontsize=9)
    figure.savefig(path)
    plt.close(figure)
    _write(path, _few_colours(np.asarray(cv2.imread(str(path)), np.uint8)))


def draw_terminal(command: str, printed: str, path: Path) -> None:
    """Draw the output of a command as a terminal shows it.

    Args:
        command: the command line.
        printed: its output.
        path: file to write.
    """
    lines = [f"$ {command}", *(line.rstrip().replace("\t", " ") for line in printed.strip("\n").splitlines())]
    columns = max(len(line) for line in lines)
    figure = plt.figure(figsize=(columns * 0.077 + 0.4, len(lines) * 0.1435 + 0.4), dpi=110, facecolor="#15191d")
    figure.text(
        0.2 / figure.get_figwidth(),
        1 - 0.2 / figure.get_figheight(),
        "\n".join(lines),
        family="DejaVu Sans Mono",
        fontsize=9.2,
        color="#e3e6e8",
        va="top",
        linespacing=1.12,
        parse_math=False,
    )
    figure.savefig(path, facecolor=figure.get_facecolor())
    plt.close(figure)


def _few_colours(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Reduce an image to four bits per channel: enough for a drawing, and its PNG is half as large."""
    return (picture & np.uint8(0xF0)) | (picture >> np.uint8(4))


def _write(path: Path, bgr: NDArray[np.uint8]) -> None:
    path.write_bytes(cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())


if __name__ == "__main__":
    main()
