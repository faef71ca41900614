"""Print an answer of the service as readable text."""

import math
from collections import Counter
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

#: Width of a table with one row per pair in a file or a pipe, characters.
_WIDTH = 160
#: A batch with a smaller share of LOCALIZED answers says why.
_FEW = 0.25


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


def print_outcomes(names: list[str], outcomes: list[dict[str, Any]], console: Console | None = None) -> None:
    """Print one row per answer of a batch, the problems of refused pairs, and a summary.

    If less than a quarter of the pairs are LOCALIZED, also print what to check, the most frequent reason first.

    Args:
        names: of the image pairs, in order. There may be more names than outcomes.
        outcomes: each has ``answer`` or ``problem``, as in the REST contract.
        console: destination; None prints to standard output.
    """
    out = console or Console(highlight=False)
    table = Table(box=None, padding=(0, 2, 0, 0))
    for heading in ("pair", "image", "status", "confidence", "street", "position", "heading"):
        table.add_column(heading, overflow="fold")
    problems = []
    for number, (name, outcome) in enumerate(zip(names, outcomes, strict=False)):
        answer, problem = outcome["answer"], outcome["problem"]
        if answer is None:
            table.add_row(str(number), escape(name), "refused", "", "", "", "")
            where = f" [field {problem['field']}]" if problem.get("field") else ""
            problems.append(f"pair {number} ({name}): {problem.get('title', '')} {problem.get('detail', '')}{where}")
            continue
        pose, street, confidence = answer["pose"], answer["street"], answer["confidence"]
        table.add_row(
            str(number),
            escape(name),
            answer["status"],
            "" if confidence is None else f"{confidence:.3f}",
            escape(street["name"]) if pose is not None and street is not None else "",
            "" if pose is None else _metres(pose["position"]),
            "" if pose is None else f"{pose['heading_deg']:.1f}",
        )
    # A file or a pipe needs no line breaks at the width of a terminal.
    Console(file=out.file, width=None if out.is_terminal else max(out.width, _WIDTH)).print(table)
    for line in problems:
        out.print(line, markup=False, soft_wrap=True)
    localized = sum(each["answer"] is not None and each["answer"]["status"] == "LOCALIZED" for each in outcomes)
    out.print(f"{localized} of {len(outcomes)} pairs LOCALIZED, {len(problems)} refused")
    lost = [
        each["answer"] for each in outcomes if each["answer"] is not None and each["answer"]["status"] != "LOCALIZED"
    ]
    if lost and localized < _FEW * len(outcomes):
        for line in _why_most(lost):
            out.print(line, markup=False, soft_wrap=True)


def _why_most(answers: list[dict[str, Any]]) -> list[str]:
    """Lines that say what to check for several answers that are not LOCALIZED, the most frequent reason first, then the likeliest."""
    from service.confidence.reasons import GROUPS

    told = [answer["reasons"] for answer in answers if "reasons" in answer]  # an older service sends none
    if not told:
        return ["The service gives no reasons."]
    order = {check: number for number, (check, _, _) in enumerate(GROUPS)}
    counts = Counter(check for reasons in told for check in {reason["check"] for reason in reasons})
    remedies: dict[str, Counter[str]] = {check: Counter() for check in counts}
    for reason in (reason for reasons in told for reason in reasons):
        remedies[reason["check"]][reason["remedy"]] += 1
    lines = [f"why {len(answers)} answers may not be LOCALIZED, the most frequent reason first"]
    for number, check in enumerate(sorted(counts, key=lambda each: (-counts[each], order.get(each, -1))), 1):
        lines.append(f"  {number}. {check} ({counts[check]} of {len(answers)}): {remedies[check].most_common(1)[0][0]}")
    unexplained = sum(not reasons for reasons in told)
    if unexplained:
        lines.append(
            f"  {unexplained} of {len(answers)} answers: all confidence features are in the range of the calibration data. "
            "The place may be outside the map or a perceptual alias."
        )
    return lines


def _facts(answer: dict[str, Any]) -> list[tuple[str, str]]:
    pose, street, place = answer["pose"], answer["street"], answer["map"]
    confidence = answer["confidence"]
    threshold = answer.get("threshold")  # an older service sends none
    least = "" if threshold is None else f"; LOCALIZED from {threshold['confidence']:.2f}"
    status = ("status", answer["status"] + ("" if confidence is None else f" (confidence {confidence:.3f}{least})"))
    outside = ", ".join(f"{name} {size:+.1f}" for name, size in answer.get("extrapolated", {}).items())
    calibrated = [("calibration", f"extrapolated (standard deviations from the mean: {outside})")] if outside else []
    rig = answer.get("rig_correction")  # an older service sends none
    calibrated += [] if rig is None else [("rig", f"confidence corrected for {rig}")]
    version = ("map", f"{place['name']}, version {place['version']}")
    given = answer.get("camera_height")  # an older service sends none
    height = [] if given is None else [("camera", _height(given))]
    if pose is None:
        return [
            status,
            ("pose", "none: the answer is not LOCALIZED"),
            ("spread", _doubt(answer["spread"])),
            *calibrated,
            *height,
            version,
        ]
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
    return [*facts, *calibrated, *height, version]


def _height(given: dict[str, Any]) -> str:
    """Text for the height of the camera and its origin."""
    why = "; the depth image shows no ground, so give --camera-height" if given["origin"] == "assumed" else ""
    return f"{given['height_m']:.2f} m above the ground ({given['origin']}{why})"


def _focal(factor: float) -> str:
    return (
        f"the focal length is probably off by a factor of two: fx and fy times {factor:g} fit the map better; check "
        "the intrinsics, and whether they belong to images of this size"
    )


def _why(answer: dict[str, Any]) -> list[str]:
    """Lines that say what to check, the likeliest cause first."""
    found, factor = [], answer.get("focal_length_factor")
    if factor is not None:
        found.append(_focal(factor))
    for reason in answer.get("reasons", []):  # an older service sends no reasons
        listed = ", ".join(f"{name} {size:+.1f}" for name, size in reason["evidence"].items())
        where = f" (standard deviations from the mean of the calibration data: {listed})" if listed else ""
        found.append(f"{reason['check']}{where}: {reason['remedy']}")
    if found:
        return [
            "why it may not be LOCALIZED, the likeliest cause first",
            *(f"  {k}. {each}" for k, each in enumerate(found, 1)),
        ]
    if "reasons" not in answer:
        return ["The service gives no reasons."]
    in_range = "All confidence features are in the range of the calibration data."
    return [f"{in_range} The place may be outside the map or a perceptual alias."]


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
            f"{each['share']:.2f}",
            f"{each['inliers']:.2f}",
            f"{each['similarity']:.3f}",
            _metres(each["pose"]["position"]),
            f"{each['pose']['heading_deg']:.0f}",
        )
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
