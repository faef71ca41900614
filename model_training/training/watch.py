"""Notice that a process of a training was lost.

The agents of torchrun do not tell each other that a machine was lost (https://github.com/pytorch/pytorch/issues/111646), and a process
that waits for it in gloo or NCCL waits for minutes. A process that waits for files of another one would wait for ever.
"""

import threading
from collections.abc import Callable
from enum import IntEnum

import torch
from torch.distributed import ProcessGroupGloo, ReduceOp

#: A process that does not answer for so long is lost, seconds. Reading from a busy network drive keeps a process silent for some time.
LOST_AFTER_S = 120.0
#: Time between two questions, seconds.
ASK_EVERY_S = 1.0
#: Time in which a process may end by itself after another one has failed, seconds: perhaps it reports the same error.
GRACE_S = 10.0


class _State(IntEnum):
    """State of a process. The greatest one counts for all."""

    RUNS = 0
    DONE = 1
    FAILED = 2


class Watch:
    """A thread that asks all processes every second whether they still run.

    Each question is one sum over gloo. It fails at once if a process has ended, and after the time limit of the group if a process or
    its machine is silent.

    Args:
        group: gloo group of all processes, used by nothing else. Its time limit is the longest silence of a process.
        lost: called in the thread with the reason if another process fails or is lost, and this one does not leave within ``grace_s``.
        every_s: time between two questions, seconds.
        grace_s: time in which this process may leave by itself, seconds.
    """

    def __init__(
        self,
        group: ProcessGroupGloo,
        lost: Callable[[str], None],
        *,
        every_s: float = ASK_EVERY_S,
        grace_s: float = GRACE_S,
    ) -> None:
        self._group, self._lost, self._every_s, self._grace_s = group, lost, every_s, grace_s
        self._state, self._leaves = _State.RUNS, threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watch", daemon=True)
        self._thread.start()

    def leave(self, *, failed: bool) -> None:
        """Tell the other processes that this one ends, and stop watching.

        Args:
            failed: this process ends because of an error. The others then end too.
        """
        self._state = _State.FAILED if failed else _State.DONE
        self._leaves.set()
        self._thread.join()

    def _watch(self) -> None:
        reason = None
        while reason is None:
            self._leaves.wait(self._every_s)
            own = self._state
            try:
                worst = self._worst(own)
            except RuntimeError as error:  # gloo: a connection was closed, or the time limit was exceeded
                reason = f"another training process was lost ({error})"
            else:
                if own != _State.RUNS or worst == _State.DONE:
                    return
                if worst == _State.FAILED:
                    reason = "another training process has failed"
        if not self._leaves.wait(self._grace_s):
            self._lost(reason)

    def _worst(self, own: _State) -> _State:
        """Return the greatest state of all processes.

        Args:
            own: state of this process.

        Raises:
            RuntimeError: a process has ended, or does not answer.
        """
        states = torch.tensor([int(own)])
        self._group.allreduce([states], ReduceOp.MAX).wait()  # type: ignore[attr-defined]  # missing in torch's stub
        return _State(int(states))
