"""One thread for each native pool: whole requests run side by side, and inner pools only get in their way.

Measured (November 2026, two cores, four requests at a time): 155 requests/s so, 94 with the libraries' defaults.
"""

import math
import os
from pathlib import Path

_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS")


def limit_pools_before_import() -> None:
    """Say so in the environment; works only before NumPy and FAISS are imported. What the operator set, stays."""
    for name in _POOLS:
        os.environ.setdefault(name, "1")


def limit_pools() -> None:
    """Limit the pools that can be told at run time; call it in every worker, as OpenMP counts for each thread."""
    import cv2

    from service.maps.index import search_with_one_thread

    cv2.setNumThreads(1)
    search_with_one_thread()


def usable_cores(cgroup: Path = Path("/sys/fs/cgroup")) -> int:
    """Cores that this process may run on, no more than its container's quota of processor time allows."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = cpu_quota(cgroup)
    return cores if quota is None else max(1, min(cores, math.ceil(quota)))


def cpu_quota(cgroup: Path) -> float | None:
    """Processors' worth of time that a control group may use (version 2, else 1); None where it is not limited."""
    for names in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        try:
            words = " ".join((cgroup / name).read_text() for name in names).split()
            if words[0] in ("max", "-1"):
                return None
            return float(words[0]) / float(words[1])
        except (OSError, ValueError, IndexError, ZeroDivisionError):  # another version, or no control groups here
            continue
    return None


def pools() -> dict[str, int]:
    """Threads of each native pool, as they are set now in this process."""
    import cv2
    import faiss

    from service.localization.encoder import THREADS

    return {"opencv": cv2.getNumThreads(), "openmp": faiss.omp_get_max_threads(), "onnxruntime": THREADS}
