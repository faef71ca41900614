"""Epochs of a robot over several connections: each connection of a stream begins to count at 0."""

from service.client.stream_answer import StreamAnswer


class Epochs:
    """Counter of the disruptions of one robot. It does not fall when the stream is opened again."""

    def __init__(self) -> None:
        self._before, self._last, self._has_pose = 0, 0, False

    def interrupt(self) -> None:
        """Begin again after a lost connection. As in the service, this is a disruption if the track had a pose."""
        self._before = self._last = self._last + int(self._has_pose)
        self._has_pose = False

    def counted(self, answer: StreamAnswer) -> StreamAnswer:
        """Return an answer with the disruptions of all connections so far.

        Args:
            answer: as the service sent it.
        """
        epoch = self._last if answer.belief is None else self._before + answer.belief.epoch
        # A higher epoch without a pose means that the track began again, so a lost connection now disrupts nothing.
        self._has_pose = answer.pose is not None or (self._has_pose and epoch == self._last)
        self._last = epoch
        if answer.belief is None:
            return answer
        return answer.model_copy(update={"belief": answer.belief.model_copy(update={"epoch": self._last})})
