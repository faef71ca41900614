"""Limit each native thread pool to one thread.

The service runs whole requests in parallel. Threads inside a request would compete with them for the same cores.
Measured (November 2026, two cores, four requests at a time): 155 requests/s with one thread, 94 with the defaults.
"""

import math
import os
from pathlib import Path

_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS")


def limit_pools_before_import() -> None:
    """Limit the native pools by environment variables.

    This works only before NumPy and FAISS are imported. It keeps variables that the operator has set.
    """
    for name in _POOLS:
        os.environ.setdefault(name, "1")


def limit_pools() -> None:
    """Limit the OpenCV and FAISS pools at run time.

    Call it in every worker thread, because OpenMP keeps its limit per thread.
    """
    import cv2

    from service.maps.index import search_with_one_thread

    cv2.setNumThreads(1)
    search_with_one_thread()


def usable_cores(cgroup: Path = Path("/sys/fs/cgroup")) -> int:
    """Count the cores that this process may use.

    A quota of processor time, as of a container, limits the count. The count is at least 1.

    Args:
        cgroup: folder of the control groups.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = cpu_quota(cgroup)
    return cores if quota is None else max(1, min(cores, math.ceil(quota)))


def threads_per_process(threads: int | None, *, workers: int, cores: int) -> int:
    """Return the number of requests that one worker process works on at once; at least 1.

    Args:
        threads: setting of the operator (``STREETFIX_THREADS``); None shares the cores among the processes.
        workers: number of processes.
        cores: usable cores.
    """
    return threads or max(1, cores // workers)


def cpu_quota(cgroup: Path) -> float | None:
    """Read the CPU quota of a control group, in cores; None if it has no limit.

    Args:
        cgroup: folder of the control groups, version 2 or else version 1.
    """
    for names in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        try:
            words = " ".join((cgroup / name).read_text() for name in names).split()
            if words[0] in ("max", "-1"):
                return None
            return float(words[0]) / float(words[1])
        except (OSError, ValueError, IndexError, ZeroDivisionError):  # the other version, or no control groups at all
            continue
    return None


def pools() -> dict[str, int]:
    """Return the current number of threads of each native pool in this process."""
    import cv2
    import faiss

    from service.onnx_session import THREADS

    return {"opencv": cv2.getNumThreads(), "openmp": faiss.omp_get_max_threads(), "onnxruntime": THREADS}
