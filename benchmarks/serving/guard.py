"""The surroundings of a production service: a certificate, API keys and a collector of traces."""

import ssl
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import trustme
from aiohttp import web
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import (
    ExportTraceServiceRequest,
    ExportTraceServiceResponse,
)

from service.runtime.keys import hash_of, new_key


@dataclass(frozen=True, slots=True)
class Guard:
    """A certificate for this machine's loopback names, and two keys.

    Attributes:
        settings: settings of the service, for ``Server``.
        authority: certificate of the authority for clients, PEM.
        key: API key of a normal caller.
        operator_key: API key of a caller who may change the serving version.
    """

    settings: dict[str, object]
    authority: bytes
    key: str
    operator_key: str

    @property
    def trusted(self) -> ssl.SSLContext:
        """TLS context for HTTP clients."""
        return ssl.create_default_context(cadata=self.authority.decode())


@contextmanager
def guard() -> Iterator[Guard]:
    """Provide certificate and keys in a folder that lasts as long as the context."""
    with tempfile.TemporaryDirectory(prefix="streetfix-guard-") as name:
        folder = Path(name)
        authority = trustme.CA()
        certificate = authority.issue_cert("127.0.0.1", "localhost")
        certificate.private_key_pem.write_to_path(folder / "key.pem")
        for pem in certificate.cert_chain_pems:
            pem.write_to_path(folder / "certificate.pem", append=True)
        key, operator_key = new_key(), new_key()
        keys = folder / "keys.txt"
        keys.write_text(f"robot {hash_of(key)}\noperator {hash_of(operator_key)} operator\n")
        settings: dict[str, object] = {
            "api_keys": keys,
            "tls_certificate": folder / "certificate.pem",
            "tls_key": folder / "key.pem",
        }
        yield Guard(settings, authority.cert_pem.bytes(), key, operator_key)


class Collector:
    """Receives spans by OTLP over HTTP, counts them and drops them, in the running event loop."""

    def __init__(self) -> None:
        self.spans = 0
        app = web.Application(client_max_size=64 * 2**20)
        app.router.add_post("/v1/traces", self._take)
        self._runner = web.AppRunner(app, access_log=None)
        self.endpoint = ""

    async def __aenter__(self) -> Self:
        """Listen on a free port."""
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", 0).start()
        host, port = self._runner.addresses[0][:2]
        self.endpoint = f"http://{host}:{port}/v1/traces"
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop listening."""
        await self._runner.cleanup()

    async def _take(self, request: web.Request) -> web.Response:
        sent = ExportTraceServiceRequest.FromString(await request.read())
        self.spans += sum(len(scope.spans) for resource in sent.resource_spans for scope in resource.scope_spans)
        return web.Response(
            body=ExportTraceServiceResponse().SerializeToString(), content_type="application/x-protobuf"
        )
