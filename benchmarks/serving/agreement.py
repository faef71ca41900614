"""Find answers that contradict each other about the serving version of a map, in whatever order they came."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Switch:
    """One change of the serving version. Switches do not overlap: each begins after the previous one is done.

    Attributes:
        version: version that serves afterwards.
        begun: start of the change, seconds of the monotonic clock.
        done: time at which the change was known to hold, seconds of the monotonic clock.
    """

    version: str
    begun: float
    done: float


@dataclass(frozen=True, slots=True)
class Named:
    """An answer.

    Attributes:
        version: version that it names.
        asked: time of the request, seconds of the monotonic clock.
        answered: time of the answer, seconds of the monotonic clock.
    """

    version: str
    asked: float
    answered: float


def disagreements(first: str, switches: Sequence[Switch], answers: Sequence[Named]) -> list[str]:
    """Find answers that no order of events explains.

    An answer may name any version that served at a moment between its request and itself. Once an answer names the
    version of a switch, the switch holds for all workers. No later request may get an answer from the version before.

    Args:
        first: the version that served before all switches.
        switches: switches in their order.
        answers: answers of all clients, in any order.

    Returns:
        A line for each such answer.
    """
    versions = [first, *(each.version for each in switches)]
    begun, done = [each.begun for each in switches], [each.done for each in switches]

    def states(answer: Named, known: Sequence[float]) -> range:
        """Return the numbers of the switches that may have been the last one when the version was looked up.

        Args:
            answer: the answer.
            known: times at which each switch was known to hold.
        """
        return range(bisect_right(known, answer.asked), bisect_left(begun, answer.answered) + 1)

    known = list(done)
    for answer in answers:
        fitting = [state for state in states(answer, done) if versions[state] == answer.version]
        if len(fitting) == 1 and fitting[0] > 0:
            known[fitting[0] - 1] = min(known[fitting[0] - 1], answer.answered)
    for number in range(len(known) - 2, -1, -1):  # a switch happened before the next one
        known[number] = min(known[number], known[number + 1])
    return [
        f"sent at {each.asked:.6f}, answered at {each.answered:.6f} from {each.version!r} instead of "
        f"{' or '.join(sorted({versions[state] for state in states(each, known)}))}"
        for each in answers
        if each.version not in {versions[state] for state in states(each, known)}
    ]
