"""The pipeline in Ray Serve: ``python -m benchmarks.serving.peers.ray_app BUNDLE PORT``.

One replica reserves the one core. Its ``async`` method has ``max_ongoing_requests`` above the default of 5. The
throughput-optimized flags are on (docs.ray.io/en/latest/serve/advanced-guides/performance.html). HAProxy replaces the
proxy in Python (kuberay/user-guides/serve-high-throughput.html): 21 ms of processor time for a retrieval instead of 27
ms, both on a busy machine. Access log, dashboard, metrics and usage report are off.
"""

import os
import signal
import sys
import threading
from pathlib import Path

from benchmarks.serving.peers.pipeline import PATH, Pipeline, parts_of  # first: it limits the pools

FLAGS = {
    "RAY_SERVE_THROUGHPUT_OPTIMIZED": "1",
    "RAY_SERVE_ENABLE_HA_PROXY": "1",
    "RAY_SERVE_HAPROXY_METRICS_ENABLED": "0",
    "RAY_SERVE_CONTROL_LOOP_INTERVAL_S": "1",
    "RAY_enable_metrics_collection": "0",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_AUTH_MODE": "disabled",
    "RAY_worker_niceness": "0",  # otherwise its workers yield to all other processes
}
os.environ.update(FLAGS)  # Ray reads them at import

import ray  # noqa: E402  # after its flags
from ray import serve  # noqa: E402
from starlette.requests import Request  # noqa: E402
from starlette.responses import Response  # noqa: E402


@serve.deployment(num_replicas=1, max_ongoing_requests=100, ray_actor_options={"num_cpus": 1})
class Localization:
    """Service that takes the parts of a request and returns JSON."""

    def __init__(self, bundle: str) -> None:
        self._pipeline = Pipeline(Path(bundle))

    async def __call__(self, request: Request) -> Response:
        """Localize one query."""
        async with request.form() as form:
            rgb, depth, asked = [await part.read() for part in parts_of(form)]
        return Response(self._pipeline.answer(rgb, depth, asked), media_type="application/json")


def main() -> None:
    """Serve until SIGTERM."""
    bundle, port = sys.argv[1:]
    ray.init(
        num_cpus=1,
        include_dashboard=False,
        log_to_driver=False,
        _node_ip_address="127.0.0.1",
        _temp_dir=str(Path.cwd() / "ray"),
    )
    serve.start(http_options={"host": "127.0.0.1", "port": int(port)}, logging_config={"enable_access_log": False})
    serve.run(Localization.bind(bundle), route_prefix=PATH)  # type: ignore[attr-defined]  # the decorator adds it
    told = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: told.set())
    told.wait()
    ray.shutdown()


if __name__ == "__main__":
    main()
