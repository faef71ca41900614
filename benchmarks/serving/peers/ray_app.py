"""The pipeline in Ray Serve: ``python -m benchmarks.serving.peers.ray_app BUNDLE PORT``.

One replica that reserves the one core, an ``async`` method with ``max_ongoing_requests`` above its default of 5, and the
throughput-optimized flags (docs.ray.io/en/latest/serve/advanced-guides/performance.html), with HAProxy in the place of the proxy in
Python (kuberay/user-guides/serve-high-throughput.html): 21 ms of processor time for a retrieval instead of 27, both on a busy
machine. No access log, dashboard, metrics or usage report.
"""

import os
import signal
import sys
import threading
from pathlib import Path

from benchmarks.serving.peers.pipeline import PATH, Pipeline  # first: it limits the pools

FLAGS = {
    "RAY_SERVE_THROUGHPUT_OPTIMIZED": "1", "RAY_SERVE_ENABLE_HA_PROXY": "1", "RAY_SERVE_HAPROXY_METRICS_ENABLED": "0",
    "RAY_SERVE_CONTROL_LOOP_INTERVAL_S": "1", "RAY_enable_metrics_collection": "0", "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_AUTH_MODE": "disabled",
    "RAY_worker_niceness": "0",  # else its workers yield to whatever else runs on the machine
}  # fmt: skip
os.environ.update(FLAGS)  # read when Ray is imported

import ray  # noqa: E402  # after its flags
from ray import serve  # noqa: E402
from starlette.requests import Request  # noqa: E402
from starlette.responses import Response  # noqa: E402


@serve.deployment(num_replicas=1, max_ongoing_requests=100, ray_actor_options={"num_cpus": 1})
class Localization:
    """Parts in, JSON out."""

    def __init__(self, bundle: str) -> None:
        self._pipeline = Pipeline(Path(bundle))

    async def __call__(self, request: Request) -> Response:
        """Localize."""
        async with request.form() as form:
            parts = [await form[name].read() for name in ("rgb", "depth", "request")]
        return Response(self._pipeline.answer(*parts), media_type="application/json")


def main() -> None:
    """Serve until told to stop."""
    bundle, port = sys.argv[1:]
    ray.init(
        num_cpus=1, include_dashboard=False, log_to_driver=False, _node_ip_address="127.0.0.1", _temp_dir=str(Path.cwd() / "ray")
    )  # fmt: skip
    serve.start(http_options={"host": "127.0.0.1", "port": int(port)}, logging_config={"enable_access_log": False})
    serve.run(Localization.bind(bundle), route_prefix=PATH)
    told = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: told.set())
    told.wait()
    ray.shutdown()


if __name__ == "__main__":
    main()
