"""Processor time and memory of a process and its descendants, from /proc."""

import os
from dataclasses import dataclass
from pathlib import Path

from service.errors import RequestError

_TICKS = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100


@dataclass(frozen=True, slots=True)
class Usage:
    """Resources of a tree of processes.

    Attributes:
        cpu_s: processor time, seconds.
        resident_mib: resident memory, MiB.
        anonymous_mib: resident memory without pages of files, MiB.
    """

    cpu_s: float
    resident_mib: float
    anonymous_mib: float


def usage(pid: int) -> Usage:
    """Return the resources of a process and its descendants until now.

    Args:
        pid: the process.

    Raises:
        RequestError: there is no such process, or this system has no /proc.
    """
    table = _table()
    tree = _tree(table, pid)
    pages = sum(table[each][2] for each in tree)
    page_mib = os.sysconf("SC_PAGE_SIZE") / 2**20
    return Usage(sum(table[each][1] for each in tree), pages * page_mib, sum(_anonymous_mib(each) for each in tree))


def descendants(pid: int) -> set[int]:
    """Return a process and all its descendants.

    Args:
        pid: the process.

    Raises:
        RequestError: there is no such process, or this system has no /proc.
    """
    return _tree(_table(), pid)


def _table() -> dict[int, tuple[int, float, int]]:
    """Return parent, processor seconds and resident pages of every process."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # ended meanwhile
            continue
        found[int(folder.name)] = (int(fields[1]), (int(fields[11]) + int(fields[12])) / _TICKS, int(fields[21]))
    return found


def _anonymous_mib(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:  # ended meanwhile
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith("RssAnon:")) / 1024


def _tree(table: dict[int, tuple[int, float, int]], pid: int) -> set[int]:
    if pid not in table:
        raise RequestError(
            f"--pid {pid}: process not found on this machine; give the process id of the service", field="pid"
        )
    tree, grew = {pid}, True
    while grew:
        children = {child for child, (parent, _, _) in table.items() if parent in tree} - tree
        tree |= children
        grew = bool(children)
    return tree
