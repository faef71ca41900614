"""Clients and commands against TLS of an authority of one's own, over real sockets and both faces."""

import asyncio
import json
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import pytest
import trustme
import uvicorn

from model_training.loadtest.payloads import Payload
from model_training.loadtest.targets import Grpc, Rest
from service.bridge.known import Known
from service.bridge.opening import _asking
from service.bridge.settings import BridgeSettings
from service.cli.main import main
from service.client import (
    AsyncClient,
    Client,
    GrpcClient,
    HandshakeError,
    KeysError,
    RequestError,
    RetryPolicy,
    UnreachableError,
)
from service.client.tls import ClientTls
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.server import GrpcServer
from service.http.app import create_app
from service.runtime.engine import Engine
from service.runtime.settings import Settings

Pem = dict[str, Path]
Faces = dict[str, dict[str, str]]
ONCE = RetryPolicy(attempts=1)
CLIENT_VARIABLES = (
    "STREETFIX_CLIENT_CA",
    "STREETFIX_CLIENT_CERT",
    "STREETFIX_CLIENT_KEY",
    "SSL_CERT_FILE",
    "SSL_CERT_DIR",
)


@pytest.fixture(scope="module")
def pem(tmp_path_factory: pytest.TempPathFactory) -> Pem:
    """An authority with certificates of the service, of a service elsewhere, and of a robot; another authority with a robot's."""
    folder = tmp_path_factory.mktemp("pem")
    own, other = trustme.CA(), trustme.CA()
    own.cert_pem.write_to_path(str(folder / "ca.crt"))
    other.cert_pem.write_to_path(str(folder / "other.crt"))
    for name, issued in (
        ("service", own.issue_cert("127.0.0.1", "localhost")),
        ("elsewhere", own.issue_cert("example.org")),
        ("robot", own.issue_cert("robot")),
        ("stranger", other.issue_cert("robot")),
    ):
        issued.cert_chain_pems[0].write_to_path(str(folder / f"{name}.crt"))
        issued.private_key_pem.write_to_path(str(folder / f"{name}.key"))
    return {path.name: path for path in folder.iterdir()}


@contextmanager
def serving(engine: Engine, pem: Pem, name: str | None, *, mutual: bool = False) -> Iterator[dict[str, str]]:
    """Both faces with a certificate, or without TLS."""
    tls: dict[str, Any] = {}
    credentials = None
    if name is not None:
        tls = {"ssl_certfile": str(pem[f"{name}.crt"]), "ssl_keyfile": str(pem[f"{name}.key"])}
        pair = (pem[f"{name}.key"].read_bytes(), pem[f"{name}.crt"].read_bytes())
        credentials = grpc.ssl_server_credentials([pair], pem["ca.crt"].read_bytes() if mutual else None, mutual)
    if mutual:
        tls |= {"ssl_ca_certs": str(pem["ca.crt"]), "ssl_cert_reqs": ssl.CERT_REQUIRED}
    server = uvicorn.Server(uvicorn.Config(create_app(engine), port=0, log_config=None, lifespan="off", **tls))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
    port = server.servers[0].sockets[0].getsockname()[1]
    messages = GrpcServer(engine, host="127.0.0.1", port=0, credentials=credentials)
    messages.start()
    scheme = "http" if name is None else "https"
    yield {"rest": f"{scheme}://127.0.0.1:{port}", "grpc": f"127.0.0.1:{messages.port}"}
    messages.stop(grace_s=1)
    server.should_exit = True
    thread.join()


@pytest.fixture(scope="module")
def faces(bundle_path: Path, pem: Pem) -> Iterator[Faces]:
    """Four services on one engine: with TLS, with client certificates as well, under another name, and without TLS."""
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, queue=16))
    with ExitStack() as stack:
        yield {
            "tls": stack.enter_context(serving(engine, pem, "service")),
            "mutual": stack.enter_context(serving(engine, pem, "service", mutual=True)),
            "elsewhere": stack.enter_context(serving(engine, pem, "elsewhere")),
            "plain": stack.enter_context(serving(engine, pem, None)),
        }
    engine.close()


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in CLIENT_VARIABLES:
        monkeypatch.delenv(name, raising=False)


def by_client(at: dict[str, str], **how: Any) -> str:
    with Client(at["rest"], retry=ONCE, **how) as client:
        return client.maps()[0].name


def by_async_client(at: dict[str, str], **how: Any) -> str:
    async def ask() -> str:
        async with AsyncClient(at["rest"], retry=ONCE, **how) as client:
            return (await client.maps())[0].name

    return asyncio.run(ask())


def by_grpc_client(at: dict[str, str], **how: Any) -> str:
    with GrpcClient(at["grpc"], retry=ONCE, timeout_s=20.0, **how) as client:
        return client.maps()[0].name


every_client = pytest.mark.parametrize("ask", [by_client, by_async_client, by_grpc_client])
Ask = Callable[..., str]


@every_client
def test_an_own_authority_is_trusted(faces: Faces, pem: Pem, ask: Ask) -> None:
    assert ask(faces["tls"], ca=pem["ca.crt"]) == "tiny"
    assert ask(faces["tls"], ca=str(pem["ca.crt"])) == "tiny"


@every_client
@pytest.mark.parametrize("variable", ["STREETFIX_CLIENT_CA", "SSL_CERT_FILE"])
def test_the_environment_names_an_authority(
    faces: Faces, pem: Pem, ask: Ask, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, str(pem["ca.crt"]))
    asked = {"tls": True} if ask is by_grpc_client and variable == "SSL_CERT_FILE" else {}
    assert ask(faces["tls"], **asked) == "tiny"
    with pytest.raises(HandshakeError):
        ask(faces["tls"], ca=pem["other.crt"])  # an argument goes above it


@every_client
def test_another_authority_is_refused_and_the_remedy_told(faces: Faces, pem: Pem, ask: Ask) -> None:
    with pytest.raises(HandshakeError, match=r"no trusted authority has signed .* --ca, ca= or STREETFIX_CLIENT_CA"):
        ask(faces["tls"], ca=pem["other.crt"])


@every_client
def test_the_public_authorities_do_not_know_it(faces: Faces, ask: Ask) -> None:
    with pytest.raises(HandshakeError, match="no trusted authority has signed the certificate"):
        ask(faces["tls"], **({"tls": True} if ask is by_grpc_client else {}))


@every_client
def test_a_certificate_of_another_name_is_refused(faces: Faces, pem: Pem, ask: Ask) -> None:
    with pytest.raises(HandshakeError, match="the certificate is for another name"):
        ask(faces["elsewhere"], ca=pem["ca.crt"])


@every_client
@pytest.mark.parametrize("by_variables", [False, True])
def test_a_client_certificate_opens_a_service_that_asks_for_one(
    faces: Faces, pem: Pem, ask: Ask, by_variables: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    how = {"ca": pem["ca.crt"], "cert": pem["robot.crt"], "key": pem["robot.key"]}
    if by_variables:
        for name, path in how.items():
            monkeypatch.setenv(f"STREETFIX_CLIENT_{name.upper()}", str(path))
        how = {}
    assert ask(faces["mutual"], **how) == "tiny"


@every_client
def test_without_a_client_certificate_it_stays_closed_and_the_remedy_is_told(faces: Faces, pem: Pem, ask: Ask) -> None:
    with pytest.raises(UnreachableError, match=r"requires a client certificate.* --cert and --key"):
        ask(faces["mutual"], ca=pem["ca.crt"])


@every_client
def test_a_certificate_of_another_authority_does_not_open_it(faces: Faces, pem: Pem, ask: Ask) -> None:
    with pytest.raises(UnreachableError, match="accept the client certificate"):
        ask(faces["mutual"], ca=pem["ca.crt"], cert=pem["stranger.crt"], key=pem["stranger.key"])


def test_tls_on_one_side_alone_is_told(faces: Faces, pem: Pem) -> None:
    tls, plain = faces["tls"], faces["plain"]
    for ask in (by_client, by_async_client):
        with pytest.raises(UnreachableError, match="if the service uses TLS, use https://"):
            ask({"rest": tls["rest"].replace("https", "http")})
        with pytest.raises(HandshakeError, match="the server does not use TLS on this port"):
            ask({"rest": plain["rest"].replace("http", "https")}, ca=pem["ca.crt"])
        with pytest.raises(RequestError, match="has no TLS, but ca, cert or key is given"):
            ask(plain, ca=pem["ca.crt"])
        assert ask(plain) == "tiny"
    with pytest.raises(UnreachableError, match="if the service uses TLS, use https://"):
        by_grpc_client(tls)
    with pytest.raises(HandshakeError, match="the server does not use TLS on this port"):
        by_grpc_client(plain, ca=pem["ca.crt"])
    with pytest.raises(RequestError, match="tls=False"):
        by_grpc_client(plain, ca=pem["ca.crt"], tls=False)
    assert by_grpc_client(plain) == "tiny"


def test_variables_leave_an_address_without_tls_alone(faces: Faces, pem: Pem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_CLIENT_CA", str(pem["ca.crt"]))
    assert by_client(faces["plain"]) == "tiny"
    assert by_grpc_client(faces["plain"], tls=False) == "tiny"


@every_client
def test_a_file_that_cannot_be_used_is_named(faces: Faces, pem: Pem, ask: Ask, tmp_path: Path) -> None:
    (tmp_path / "text").write_text("nothing of the kind")
    (tmp_path / "locked.key").write_text(encrypted(pem["robot.key"]))
    good = {"ca": pem["ca.crt"], "cert": pem["robot.crt"], "key": pem["robot.key"]}
    for changed, told in (
        ({"ca": tmp_path / "nowhere"}, "nowhere: cannot be read"),
        ({"ca": tmp_path / "text"}, "text: the file has no certificate"),
        ({"ca": tmp_path}, "cannot be read"),
        ({"cert": tmp_path / "nowhere"}, "nowhere: cannot be read"),
        ({"key": tmp_path / "nowhere"}, "nowhere: cannot be read"),
        ({"cert": tmp_path / "text"}, "text: not a PEM certificate that matches the private key"),
        ({"key": pem["stranger.key"]}, "robot.crt: not a PEM certificate that matches the private key .*stranger.key"),
        ({"key": tmp_path / "locked.key"}, "locked.key: the private key is encrypted; decrypt it"),
    ):
        with pytest.raises(KeysError, match=told):
            ask(faces["mutual"], **good | changed)
    for half, missing in (({"cert": pem["robot.crt"]}, "key"), ({"key": pem["robot.key"]}, "cert")):
        with pytest.raises(RequestError, match=f"^{missing}: a client certificate and its private key belong together"):
            ask(faces["mutual"], ca=pem["ca.crt"], **half)


def encrypted(path: Path) -> str:
    from cryptography.hazmat.primitives.serialization import (
        BestAvailableEncryption,
        Encoding,
        PrivateFormat,
        load_pem_private_key,
    )

    key = load_pem_private_key(path.read_bytes(), None)
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret")).decode()


@pytest.fixture
def files(parts_of: Callable[..., dict[str, bytes]], tmp_path: Path) -> list[str]:
    for name, content in parts_of().items():
        (tmp_path / name).write_bytes(content)
    return [
        f"--rgb={tmp_path / 'rgb'}",
        f"--depth={tmp_path / 'depth'}",
        f"--camera={tmp_path / 'request'}",
    ]


def flags(pem: Pem, name: str = "robot") -> list[str]:
    return ["--ca", str(pem["ca.crt"]), "--cert", str(pem[f"{name}.crt"]), "--key", str(pem[f"{name}.key"])]


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(list(arguments))
    return int(end.value.code or 0)


def test_the_command_localize(faces: Faces, pem: Pem, files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["localize", "--url", faces["mutual"]["rest"], *files]
    assert run(*asked, "--json", *flags(pem)) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "LOCALIZED"
    assert run(*asked) == 1
    assert "--ca, ca= or STREETFIX_CLIENT_CA" in capsys.readouterr().err
    assert run(*asked, "--ca", str(pem["ca.crt"])) == 1
    assert "pass --cert and --key" in capsys.readouterr().err


def test_the_command_health(
    faces: Faces, pem: Pem, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STREETFIX_PORT", faces["mutual"]["rest"].rpartition(":")[2])
    for name, file in (("CERTIFICATE", "service.crt"), ("KEY", "service.key"), ("CLIENT_CA", "ca.crt")):
        monkeypatch.setenv(f"STREETFIX_TLS_{name}", str(pem[file]))
    assert run("health", *flags(pem)) == 0
    assert capsys.readouterr().out == "ready\n"
    assert run("health", *flags(pem, "stranger")) == 1
    assert "not ready" in capsys.readouterr().err
    monkeypatch.setenv("STREETFIX_PORT", faces["tls"]["rest"].rpartition(":")[2])
    monkeypatch.delenv("STREETFIX_TLS_CLIENT_CA")
    assert run("health") == 0  # on its own machine any certificate will do, unless an authority is named
    assert run("health", "--ca", str(pem["other.crt"])) == 1


def test_the_bridge_asks_over_tls(faces: Faces, pem: Pem, pictures: Any, bundle_path: Path) -> None:
    right = BridgeSettings(url=faces["mutual"]["rest"], ca=pem["ca.crt"], cert=pem["robot.crt"], key=pem["robot.key"])
    rgb, depth_m, camera = pictures
    with _asking(right) as localize:
        assert localize(rgb, depth_m, camera, Known()).status == "LOCALIZED"
    with _asking(replace(right, ca=pem["other.crt"])) as localize, pytest.raises(HandshakeError):
        localize(rgb, depth_m, camera, Known())
    with pytest.raises(RequestError, match="--ca: it is only for a service"), _asking(replace(right, map=bundle_path)):
        pass


@pytest.mark.parametrize("face", ["rest", "grpc"])
def test_the_load_test_speaks_tls(faces: Faces, pem: Pem, parts_of: Callable[..., dict[str, bytes]], face: str) -> None:
    parts = parts_of()
    body = b"".join(
        b'--x\r\nContent-Disposition: form-data; name="%s"\r\n\r\n%s\r\n' % (name.encode(), data)
        for name, data in parts.items()
    )
    camera = pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)
    message = pb.LocalizeRequest(
        rgb=parts["rgb"], depth=parts["depth"], camera=camera, depth_format=pb.DepthFormat(scale_m=1)
    )
    payload = Payload(body + b"--x--\r\n", "multipart/form-data; boundary=x", message, None)

    async def ask(ca: str) -> str:
        tls = ClientTls.of(pem[ca], pem["robot.crt"], pem["robot.key"])
        at = faces["mutual"][face]
        async with Rest(at, key=None, tls=tls) if face == "rest" else Grpc(at, key=None, tls=tls) as target:
            return (await target.ask(payload, 20.0)).code

    assert asyncio.run(ask("ca.crt")) == "ok"
    assert asyncio.run(ask("other.crt")) == "connection"


@pytest.mark.parametrize("face", ["rest", "grpc"])
def test_the_command_loadtest_tells_a_failed_handshake_at_once(faces: Faces, pem: Pem, face: str) -> None:
    from model_training.cli.loadtest import _tls_of

    at = faces["tls"]["rest"], faces["tls"]["grpc"] if face == "grpc" else None
    how: dict[str, Any] = {"cert": None, "key": None, "api_key": None, "tls": None}
    assert _tls_of(*at, ca=pem["ca.crt"], **how) == ClientTls.of(pem["ca.crt"])
    with pytest.raises(HandshakeError):
        _tls_of(*at, ca=pem["other.crt"], **how)
    plain = faces["plain"]["rest"], faces["plain"]["grpc"] if face == "grpc" else None
    assert _tls_of(*plain, ca=None, **how) is None
