"""Send the questions of the demo to a service, and show the answers with the ground truth."""

import math
import os
import shlex
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console
from rich.table import Table

from model_training.cli.demo_map import DemoQuery
from service.cli.send import localize
from service.errors import RefusedError
from service.geometry.rigid import heading_of_camera, wrap_angle
from service.maps.calibration import RIGHT_M


@dataclass(frozen=True, slots=True)
class Outcome:
    """A question and its answer. An answer that is not LOCALIZED has no street and no pose, so it is neither right nor wrong.

    Attributes:
        question: the image pair and its ground truth.
        answer: as in the REST contract; None if the service refused the query.
        problem: why the service refused the query; else empty.
        elapsed_s: time of the request over HTTP, seconds.
    """

    question: DemoQuery
    answer: dict[str, Any] | None
    problem: str
    elapsed_s: float

    @property
    def right(self) -> bool | None:
        """Whether the street is the true one (of single frames: the first place); None if unknown or without a pose."""
        if self.question.place is None and self.question.street is None:
            return None
        if self.answer is None:
            return False
        if self.question.place is not None:
            return bool(self.answer["neighbours"][0]["place"] == self.question.place)
        if self.answer["pose"] is None:
            return None
        street = self.answer["street"]
        return street is not None and self.question.street is not None and street["id"] == self.question.street[0]

    @property
    def error_m(self) -> float | None:
        """Horizontal distance from the true position, metres; None without a pose, or if another single frame was found."""
        return None if self.answer is None else self._off_m(self.answer["pose"])

    @property
    def forced_error_m(self) -> float | None:
        """Like ``error_m``, but of the best hypothesis, whatever the status; None if nothing was registered."""
        if self.answer is None:
            return None
        guesses = self.answer["hypotheses"]
        return self._off_m(guesses[0]["pose"] if guesses else self.answer["pose"])

    @property
    def is_accepted(self) -> bool:
        """Whether the status says that the pose can be used."""
        return self.answer is not None and self.answer["status"] == "LOCALIZED"

    def _off_m(self, pose: dict[str, Any] | None) -> float | None:
        T = self.question.T_map_camera
        if T is None or pose is None or self._is_elsewhere:
            return None
        return math.hypot(pose["position"]["x"] - T[0, 3], pose["position"]["y"] - T[1, 3])

    @property
    def heading_error_deg(self) -> float | None:
        """Angle between the answered and the true heading, degrees; None if ``error_m`` is None."""
        T = self.question.T_map_camera
        if T is None or self.answer is None or self.answer["pose"] is None or self._is_elsewhere:
            return None
        return abs(math.degrees(wrap_angle(math.radians(self.answer["pose"]["heading_deg"]) - heading_of_camera(T))))

    @property
    def _is_elsewhere(self) -> bool:
        """Whether another single frame was found. Distances between single frames have no meaning."""
        return self.question.place is not None and not self.right


def ask(question: DemoQuery, url: str) -> Outcome:
    """Send an image pair, as ``streetfix localize`` does.

    Args:
        question: the image pair.
        url: address of the service.

    Raises:
        UnreachableError: the service does not answer.
    """
    began = time.perf_counter()
    answer, problem = None, ""
    try:
        answer = localize(url, rgb=question.rgb, depth=question.depth, camera=question.camera)
    except RefusedError as error:
        problem = error.message
    return Outcome(question, answer, problem, time.perf_counter() - began)


def print_answers(outcomes: list[Outcome], console: Console, *, places: tuple[str, ...] = ()) -> None:
    """Print a table with one row per answer, and a summary.

    Args:
        outcomes: one or more.
        console: destination.
        places: names of the map's places if each is a single frame; then the table compares places, not streets.
    """
    console.print(_places_table(outcomes, places) if places else _streets_table(outcomes))
    console.print(_summary(outcomes, "first places" if places else "streets"))


def print_next(
    outcomes: list[Outcome], bundle: Path, samples: Path, url: str, console: Console, *, goes_on: bool
) -> None:
    """Print the user's next commands.

    Args:
        outcomes: one or more; the command sends the first query whose answer was right.
        bundle: the map.
        samples: folder of the sample pairs, which the browser console shows.
        url: address of the service.
        console: destination.
        goes_on: whether the service keeps running.
    """
    sample = next((outcome.question for outcome in outcomes if outcome.right), outcomes[0].question)
    files = ["--rgb", str(sample.rgb), "--depth", str(sample.depth), "--camera", str(sample.camera)]
    if not goes_on:
        console.print("Serve the map again and send a query:", style="bold")
        console.print(f"  {_shell('serve', str(bundle), '--samples', str(samples))}", soft_wrap=True)
        console.print(f"  {_shell('localize', *files)}", soft_wrap=True)
        return
    console.print("Send a query from another terminal:", style="bold")
    console.print(f"  {_shell('localize', '--url', url, *files)}\n", soft_wrap=True)
    console.print(f"Or use the console in a browser: {url}/console/\n", soft_wrap=True)
    console.print(f"serving at {url} (API: {url}/docs). Stop with Ctrl-C.", soft_wrap=True)


def _streets_table(outcomes: list[Outcome]) -> Table:
    table = Table(title="Street, (x, y) in metres, heading", title_justify="left", show_lines=True)
    for heading in ("query", "answer", "truth", "street"):
        table.add_column(heading)
    table.add_column("error", justify="right")
    for outcome in outcomes:
        T = outcome.question.T_map_camera
        street = outcome.question.street
        truth = ""
        if T is not None:
            truth = _where(street[1] if street else None, T[0, 3], T[1, 3], math.degrees(heading_of_camera(T)))
        table.add_row(outcome.question.name, _answered(outcome), truth, _verdict(outcome.right), _errors(outcome))
    return table


def _places_table(outcomes: list[Outcome], places: tuple[str, ...]) -> Table:
    table = Table(title="Places", title_justify="left")
    for heading in ("frame", "first place", "similarity", "own place first", "status"):
        table.add_column(heading)
    table.add_column("error", justify="right")
    for outcome in outcomes:
        first = outcome.answer["neighbours"][0] if outcome.answer else None
        name = _flat(outcome.problem) if first is None else places[first["place"]]
        similarity = "" if first is None else f"{first['similarity']:.3f}"
        own = "not in the map" if outcome.question.place is None else _verdict(outcome.right)
        table.add_row(outcome.question.name, name, similarity, own, _status(outcome), _errors(outcome))
    return table


def _answered(outcome: Outcome) -> str:
    answer = outcome.answer
    if answer is None:
        return _flat(outcome.problem)
    pose, street = answer["pose"], answer["street"]
    text = "no pose"
    if pose is not None:
        text = _where(street and street["name"], pose["position"]["x"], pose["position"]["y"], pose["heading_deg"])
    return f"{text}\n{_status(outcome)}"


def _status(outcome: Outcome) -> str:
    answer = outcome.answer
    if answer is None:
        return "refused"
    return str(answer["status"]) + ("" if answer["confidence"] is None else f" {answer['confidence']:.3f}")


def _where(street: str | None, x: float, y: float, heading_deg: float) -> str:
    return f"{street or 'no street'}\n({x:.1f}, {y:.1f}) {heading_deg:.0f}°"


def _verdict(right: bool | None) -> str:
    return "" if right is None else "[green]right[/]" if right else "[bold red]wrong[/]"


def _errors(outcome: Outcome) -> str:
    if outcome.error_m is not None:
        return f"{outcome.error_m:.2f} m\n{outcome.heading_error_deg:.0f}°"
    return "" if outcome.forced_error_m is None else f"not accepted\n(forced {outcome.forced_error_m:.2f} m)"


def _flat(problem: str) -> str:
    return " ".join(problem.split())


def _summary(outcomes: list[Outcome], what: str) -> str:
    verdicts = [outcome.right for outcome in outcomes if outcome.right is not None]
    parts = [f"{sum(verdicts)} of {len(verdicts)} {what} right"]
    accepted = sum(outcome.is_accepted for outcome in outcomes)
    parts.append(f"{accepted} of {len(outcomes)} answers accepted (LOCALIZED); the others have no pose")
    errors = sorted(error for outcome in outcomes if (error := outcome.error_m) is not None)
    forced = sorted(error for outcome in outcomes if (error := outcome.forced_error_m) is not None)
    for name, each in (("accepted answers", errors), ("forced, whatever the status", forced)):
        if each:
            wrong = sum(error > RIGHT_M for error in each)
            parts.append(
                f"{name}: position off by {median(each):.2f} m (median), {each[-1]:.2f} m (largest); {wrong} of {len(each)} over 1 m"
            )
    parts.append(f"{1e3 * median(outcome.elapsed_s for outcome in outcomes):.0f} ms per query over HTTP (median)")
    return "\n".join(parts)


def _shell(*arguments: str) -> str:
    """Return a command line that works in the current folder, with and without an active virtual environment."""
    script = Path(sys.executable).with_name("streetfix")
    found = shutil.which("streetfix")
    is_on_path = (found is not None and Path(found) == script) or not script.exists()
    name = "streetfix" if is_on_path else os.path.relpath(script)
    return shlex.join([name, *arguments])
