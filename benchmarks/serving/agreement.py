"""Do all workers answer from the same version of a map? Finds answers that contradict each other, whatever the order in which they came."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Switch:
    """The version that serves was changed once. Switches follow each other: one begins after the one before it was done.

    Attributes:
        version: that serves afterwards.
        begun: when whoever caused it began to, in seconds of the monotonic clock.
        done: when it was known to hold.
    """

    version: str
    begun: float
    done: float


@dataclass(frozen=True, slots=True)
class Named:
    """An answer.

    Attributes:
        version: that it names.
        asked: when its request was sent, in seconds of the monotonic clock.
        answered: when the answer was there.
    """

    version: str
    asked: float
    answered: float


def disagreements(first: str, switches: Sequence[Switch], answers: Sequence[Named]) -> list[str]:
    """Answers that no order of events explains.

    An answer may name any version that served at a moment between its request and itself. Once an answer has named the version of a
    switch, the switch has happened for everybody: no request that is sent later may be answered from the version before.

    Args:
        first: the version that served before all switches.
        switches: in their order.
        answers: of all clients, in any order.

    Returns:
        A line for each such answer.
    """
    versions = [first, *(each.version for each in switches)]
    begun, done = [each.begun for each in switches], [each.done for each in switches]

    def states(answer: Named, known: Sequence[float]) -> range:
        """Numbers of the switches that may have been the last one when the version was looked up."""
        return range(bisect_right(known, answer.asked), bisect_left(begun, answer.answered) + 1)

    known = list(done)
    for answer in answers:
        fitting = [state for state in states(answer, done) if versions[state] == answer.version]
        if len(fitting) == 1 and fitting[0] > 0:
            known[fitting[0] - 1] = min(known[fitting[0] - 1], answer.answered)
    for number in range(len(known) - 2, -1, -1):  # a switch was before the next one
        known[number] = min(known[number], known[number + 1])
    return [
        f"asked at {each.asked:.6f}, answered at {each.answered:.6f} from {each.version!r} instead of "
        f"{' or '.join(sorted({versions[state] for state in states(each, known)}))}"
        for each in answers
        if each.version not in {versions[state] for state in states(each, known)}
    ]
