"""An S3 server in a process of its own, over a real socket (moto), for tests and measurements."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

#: Bucket that the server has at its start.
BUCKET = "maps"
#: Any credentials pass.
CREDENTIALS = {"AWS_ACCESS_KEY_ID": "tester", "AWS_SECRET_ACCESS_KEY": "never-shown-7f3a", "AWS_REGION": "us-east-1"}
_PROGRAM = f"""
import logging, sys, urllib.request
from moto.server import ThreadedMotoServer
logging.getLogger("werkzeug").setLevel(logging.ERROR)
server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
server.start()
address = "http://127.0.0.1:%d" % server.get_host_and_port()[1]
direct = urllib.request.build_opener(urllib.request.ProxyHandler({{}}))
direct.open(urllib.request.Request(address + "/{BUCKET}", method="PUT")).read()
print(address, flush=True)
sys.stdin.read()  # until the parent ends
server.stop()
"""


@contextmanager
def s3_server() -> Iterator[dict[str, str]]:
    """Run the server inside the context; yield the environment variables with which obstore finds it.

    Raises:
        RuntimeError: the server does not start.
    """
    plain = {key: value for key, value in os.environ.items() if not key.startswith("AWS_")}
    process = subprocess.Popen(
        [sys.executable, "-c", _PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=plain | CREDENTIALS,
    )
    with process:
        try:
            address = process.stdout.readline().strip() if process.stdout else ""
            if not address:
                raise RuntimeError("the S3 server did not start; install the extra dev")
            yield {**CREDENTIALS, "AWS_ENDPOINT_URL": address, "AWS_ALLOW_HTTP": "true", "NO_PROXY": "127.0.0.1"}
        finally:
            process.kill()
