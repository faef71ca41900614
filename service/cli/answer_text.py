"""Print an answer of the service as readable text."""

import math
from typing import Any

from rich.console import Console
from rich.table import Table


def print_answer(answer: dict[str, Any], console: Console | None = None) -> None:
    """Print status, street, pose, camera height, neighbours and timings. Without a pose, also print likely reasons and the hypotheses.

    Args:
        answer: as in the REST contract. If other focal lengths were tried, it has ``focal_length_factor``; None if none fits.
        console: destination; None prints to standard output.
    """
    out = console or Console(highlight=False)
    facts = Table.grid(padding=(0, 2))
    for name, value in _facts(answer):
        facts.add_row(name, value)
    out.print(facts)
    out.print()
    factor = answer.get("focal_length_factor")
    if answer["pose"] is not None and factor is not None:
        out.print(f"warning: {_focal(factor)}", markup=False, style="yellow")
        out.print()
    if answer["pose"] is None:
        for line in _why(answer):
            out.print(line, markup=False)
        out.print()
    if answer["pose"] is None and answer["hypotheses"]:
        out.print(_hypotheses(answer["hypotheses"]))
    out.print(_neighbours(answer["neighbours"]))
    times = "  ".join(f"{stage} {value:.1f}" for stage, value in answer["timings_ms"].items())
    out.print(f"milliseconds: {times}", style="dim")


def _facts(answer: dict[str, Any]) -> list[tuple[str, str]]:
    pose, street, place = answer["pose"], answer["street"], answer["map"]
    confidence = answer["confidence"]
    status = ("status", answer["status"] + ("" if confidence is None else f" (confidence {confidence:.3f})"))
    version = ("map", f"{place['name']}, version {place['version']}")
    told = answer.get("camera_height")  # an older service sends none
    height = [] if told is None else [("camera", _height(told))]
    if pose is None:
        return [
            status, ("pose", "none: the answer is not LOCALIZED"), ("spread", _doubt(answer["spread"])), *height, version,
        ]  # fmt: skip
    facts = [
        status,
        ("street", "none" if street is None else f"{street['name']} ({street['vote']:.0%} of the votes)"),
        ("position", f"{_metres(pose['position'])}, map frame{_spread(pose['covariance'], slice(0, 3), 1.0, 'm')}"),
        (
            "heading",
            f"{pose['heading_deg']:.1f} degrees, counter-clockwise from map x"
            + _spread(pose["covariance"], slice(5, 6), 180 / math.pi, "degrees"),
        ),
    ]
    if answer.get("vehicle_pose"):
        vehicle = answer["vehicle_pose"]
        facts.append(("vehicle", f"{_metres(vehicle['position'])}, heading {vehicle['heading_deg']:.1f} degrees"))
    return [*facts, *height, version]


def _height(told: dict[str, Any]) -> str:
    """Text for the height of the camera and its origin."""
    why = "; the depth image shows no ground, so give --camera-height" if told["origin"] == "assumed" else ""
    return f"{told['height_m']:.2f} m above the ground ({told['origin']}{why})"


def _focal(factor: float) -> str:
    return (
        f"the focal length is probably off by a factor of two: fx and fy times {factor:g} fit the map better; check the "
        "intrinsics, and whether they are of pictures of this size"
    )


def _why(answer: dict[str, Any]) -> list[str]:
    """Lines that say what to check, the likeliest cause first."""
    found, factor = [], answer.get("focal_length_factor")
    if factor is not None:
        found.append(_focal(factor))
    for reason in answer.get("reasons", []):  # an older service sends no reasons
        told = ", ".join(f"{name} {size:+.1f}" for name, size in reason["evidence"].items())
        where = f" (standard deviations from what calibration saw: {told})" if told else ""
        found.append(f"{reason['check']}{where}: {reason['remedy']}")
    if found:
        return [
            "why it may not be LOCALIZED, the likeliest cause first",
            *(f"  {k}. {each}" for k, each in enumerate(found, 1)),
        ]
    if "reasons" not in answer:
        return ["why: this service does not say"]
    return [
        "why: all evidence lies in the range that calibration saw; the place may be outside the map, or look like another place of it"
    ]


def _doubt(spread: dict[str, Any]) -> str:
    """Text for the uncertainty of the position over all hypotheses."""
    largest_m = math.sqrt(max(spread["covariance"][4 * k] for k in range(3)))
    return f"+- {largest_m:.1f} m (one sigma) over the hypotheses and the rest of the map"


def _spread(covariance: list[float] | None, rows: slice, scale: float, unit: str) -> str:
    """Text for the largest standard deviation of the given rows; empty if the covariance is unknown."""
    if covariance is None:
        return ""
    largest = max(covariance[7 * k] for k in range(6)[rows])
    return f", +- {scale * math.sqrt(largest):.2f} {unit} (one sigma)"


def _hypotheses(hypotheses: list[dict[str, Any]]) -> Table:
    table = Table(
        "share",
        "inliers",
        "similarity",
        "position",
        "heading",
        title="where it may be (not confirmed)",
        title_justify="left",
    )
    for each in hypotheses:
        table.add_row(
            f"{each['share']:.2f}", f"{each['inliers']:.2f}", f"{each['similarity']:.3f}", _metres(each["pose"]["position"]),
            f"{each['pose']['heading_deg']:.0f}",
        )  # fmt: skip
    return table


def _neighbours(neighbours: list[dict[str, Any]]) -> Table:
    table = Table("place", "similarity", "street", "position", "heading", title="nearest places", title_justify="left")
    for each in neighbours:
        table.add_row(
            str(each["place"]),
            f"{each['similarity']:.3f}",
            each["street"] or "none",
            _metres(each["position"]),
            f"{each['heading_deg']:.0f}",
        )
    return table


def _metres(position: dict[str, float]) -> str:
    return f"x {position['x']:.2f}  y {position['y']:.2f}  z {position['z']:.2f} m"
