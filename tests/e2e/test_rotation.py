"""Keys, certificates and authorities that are replaced while the real command answers, and the health port beside mutual TLS."""

import re
import signal
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import grpc
import httpx
import pytest
import trustme

from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.runtime.keys import hash_of

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]


@dataclass
class Running:
    """The command, where it listens, and what it logs."""

    process: subprocess.Popen[str]
    rest: str
    grpc: str
    health: str
    log: Path

    def hang_up(self) -> None:
        """As an operator does who replaced files."""
        self.process.send_signal(signal.SIGHUP)


Start = Callable[..., Running]


@pytest.fixture
def start(bundle_path: Path, tmp_path: Path) -> Iterator[Start]:
    running: list[Running] = []

    def begin(**settings: object) -> Running:
        told = {"watch_s": "0", "health_port": "0"} | settings
        log = tmp_path / "log"
        with log.open("w") as file:
            process = subprocess.Popen(
                [*COMMAND, "serve", str(bundle_path), "--threads", "1", "--port", "0", "--grpc-port", "0"],
                env={"PATH": "", **{f"STREETFIX_{name.upper()}": str(value) for name, value in told.items()}},
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
            )
        assert process.stdout is not None
        found: dict[str, str] = {}
        for line in process.stdout:
            if match := re.search(r"(serving gRPC|health|serving) at (\S+)", line):
                found[match[1]] = match[2]
            if "serving" in found:
                break
        assert "serving" in found, log.read_text()
        running.append(Running(process, found["serving"], found["serving gRPC"], found["health"], log))
        return running[-1]

    yield begin
    for each in running:
        each.process.send_signal(signal.SIGTERM)
        assert each.process.communicate(timeout=60)[0] == "stopped\n"
        assert each.process.returncode == 0


def becomes(true: Callable[[], bool]) -> bool:
    """Within ten seconds."""
    until = time.monotonic() + 10
    while not true():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


class Pems:
    """Files of a service's certificate and of its clients' authority, and what clients show."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.paths = {name: folder / name for name in ("server.crt", "server.key", "client-ca")}
        self.issue()

    def issue(self) -> None:
        """A new authority for both sides, in place of the old one."""
        self.authority = trustme.CA()
        server, client = self.authority.issue_cert("127.0.0.1", "localhost"), self.authority.issue_cert("robot")
        self.root = self.authority.cert_pem.bytes()
        self.client = (client.private_key_pem.bytes(), client.cert_chain_pems[0].bytes())
        for name, content in (
            ("server.crt", server.cert_chain_pems[0].bytes()),
            ("server.key", server.private_key_pem.bytes()),
            ("client-ca", self.root),
        ):
            part = self.folder / f".{name}"
            part.write_bytes(content)
            part.rename(self.paths[name])

    def settings(self, *, mutual: bool) -> dict[str, Path]:
        """Of a service."""
        found = {"tls_certificate": self.paths["server.crt"], "tls_key": self.paths["server.key"]}
        return found | ({"tls_client_ca": self.paths["client-ca"]} if mutual else {})

    def rest_works(self, url: str) -> bool:
        """Whether a new connection with the newest authority and client certificate is answered."""
        context = ssl.create_default_context(cadata=self.root.decode())
        chain = self.folder / "client.pem"
        chain.write_bytes(b"".join(self.client))
        context.load_cert_chain(chain)
        try:
            return httpx.get(f"{url}/v1/maps", verify=context).status_code == 200
        except httpx.TransportError:
            return False

    def grpc_works(self, address: str) -> bool:
        """The same by gRPC."""
        with grpc.secure_channel(address, grpc.ssl_channel_credentials(self.root, *self.client)) as channel:
            try:
                return LocalizationServiceStub(channel).ListMaps(pb.ListMapsRequest(), timeout=5).maps[0].name == "tiny"
            except grpc.RpcError:
                return False


@pytest.mark.parametrize("mutual", [False, True])
def test_both_faces_take_new_certificates_without_a_restart(start: Start, tmp_path: Path, mutual: bool) -> None:
    pems = Pems(tmp_path)
    service = start(**pems.settings(mutual=mutual))
    assert pems.rest_works(service.rest)
    assert pems.grpc_works(service.grpc)
    old_root, old_client = pems.root, pems.client
    pems.issue()
    assert not pems.rest_works(service.rest)
    service.hang_up()
    assert becomes(lambda: pems.rest_works(service.rest))
    assert becomes(lambda: pems.grpc_works(service.grpc))
    if mutual:  # the old authority is out, even for who knows the new one's server
        pems.client = old_client
        assert not pems.rest_works(service.rest)
        assert not pems.grpc_works(service.grpc)
    pems.root, pems.client = old_root, old_client
    assert not pems.rest_works(service.rest)


def test_a_bad_certificate_leaves_the_old_one_in_force_and_is_logged(start: Start, tmp_path: Path) -> None:
    pems = Pems(tmp_path)
    service = start(**pems.settings(mutual=True))
    pems.paths["server.crt"].write_text("nothing of the kind\n")
    service.hang_up()
    assert becomes(lambda: "reload_failed name=tls" in service.log.read_text())
    assert pems.rest_works(service.rest)
    assert pems.grpc_works(service.grpc)
    assert "Traceback" not in service.log.read_text()


def test_without_a_signal_changed_files_are_noticed(start: Start, tmp_path: Path) -> None:
    pems = Pems(tmp_path)
    service = start(**pems.settings(mutual=False), watch_s=0.05)
    pems.issue()
    assert becomes(lambda: pems.rest_works(service.rest))


def test_keys_come_and_go_without_a_restart_in_every_worker(start: Start, tmp_path: Path) -> None:
    path = tmp_path / "keys"
    path.write_text(f"one {hash_of('first')}\n")
    service = start(api_keys=path, workers=2)

    def statuses(key: str) -> set[int]:
        """Of new connections, enough for every worker to get some."""
        plain = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # to read authorities would take longer than a request
        return {
            httpx.get(f"{service.rest}/v1/maps", headers={"X-Api-Key": key}, verify=plain).status_code
            for _ in range(16)
        }

    def by_grpc(key: str) -> bool:
        with grpc.insecure_channel(service.grpc, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
            try:
                LocalizationServiceStub(channel).ListMaps(pb.ListMapsRequest(), metadata=(("x-api-key", key),))
            except grpc.RpcError:
                return False
            return True

    assert (statuses("first"), statuses("second")) == ({200}, {401})
    path.write_text(f"two {hash_of('second')}\n")
    service.hang_up()
    assert becomes(lambda: (statuses("first"), statuses("second")) == ({401}, {200}))
    assert becomes(lambda: by_grpc("second") and not by_grpc("first"))
    path.write_text("two\n")
    service.hang_up()
    assert becomes(lambda: service.log.read_text().count("reload_failed name=api_keys") == 2)
    assert statuses("second") == {200}


def test_the_health_port_is_plain_and_open_where_the_others_ask_for_certificates_and_keys(
    start: Start, tmp_path: Path
) -> None:
    pems, keys = Pems(tmp_path), tmp_path / "keys"
    keys.write_text(f"one {hash_of('first')}\n")
    service = start(**pems.settings(mutual=True), api_keys=keys)
    port = service.health.rsplit(":", 1)[1].removesuffix("/readyz")
    base = f"http://127.0.0.1:{port}"
    for path, status in (
        ("/livez", 200),
        ("/readyz", 200),
        ("/metrics", 404),
        ("/v1/maps", 404),
        ("/openapi.json", 404),
        ("/console/", 404),
        ("/v1/localize", 404),
    ):
        assert httpx.get(base + path, headers={"Host": "10.1.2.3:8001"}).status_code == status, path
    environment = {"PATH": "", "STREETFIX_HEALTH_PORT": port}
    asked = [*COMMAND, "health"]
    done = subprocess.run(asked, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (0, "ready\n")


@pytest.mark.parametrize("workers", [1, 2])
def test_the_health_port_tells_metrics_where_the_settings_say_so(start: Start, workers: int) -> None:
    service = start(health_metrics="true", workers=workers)
    base = service.health.removesuffix("/readyz")
    assert "streetfix_capacity" in httpx.get(f"{base}/metrics").text
    assert httpx.get(f"{base}/readyz").status_code == 200
