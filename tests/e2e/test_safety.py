"""Keys and certificates, checked by both faces of the real command over real sockets."""

import json
import re
import signal
import ssl
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
Start = Callable[..., tuple[str, str]]
Parts = Callable[..., dict[str, bytes]]


@pytest.fixture
def start(bundle_path: Path) -> Iterator[Start]:
    """Starts services on ports of the system's choice: their addresses for REST and gRPC."""
    running: list[subprocess.Popen[str]] = []

    def begin(**settings: object) -> tuple[str, str]:
        environment = {f"STREETFIX_{name.upper()}": str(value) for name, value in settings.items()}
        process = subprocess.Popen(
            [*COMMAND, "serve", str(bundle_path), "--threads", "1", "--port", "0", "--grpc-port", "0"],
            env={"PATH": "", **environment},
            stdout=subprocess.PIPE,
            text=True,
        )
        running.append(process)
        assert process.stdout is not None
        found: dict[str, str] = {}
        for line in process.stdout:
            if match := re.search(r"serving (gRPC )?at (\S+)", line):
                found["grpc" if match[1] else "rest"] = match[2]
            if "rest" in found:
                return found["rest"], found["grpc"]
        raise AssertionError(f"the service ended with {process.wait()} and never served")

    yield begin
    for process in running:
        process.send_signal(signal.SIGTERM)
        assert process.communicate(timeout=60)[0] == "stopped\n"
        assert process.returncode == 0


def made_key(tmp_path: Path) -> tuple[str, Path]:
    """By the command, as its help shows it."""
    done = subprocess.run([*COMMAND, "keys", "robot-7"], capture_output=True, text=True, check=True)
    (tmp_path / "keys.txt").write_text(done.stdout)
    return done.stderr.split()[-1], tmp_path / "keys.txt"


def test_with_keys_both_faces_ask_for_one_and_health_stays_open(start: Start, tmp_path: Path, parts_of: Parts) -> None:
    key, path = made_key(tmp_path)
    assert key not in path.read_text()
    rest, grpc_address = start(api_keys=path, host="0.0.0.0")  # noqa: S104  # beyond loopback, since there are keys
    rest, grpc_address = rest.replace("0.0.0.0", "127.0.0.1"), grpc_address.replace("0.0.0.0", "127.0.0.1")  # noqa: S104
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"X-Api-Key": key[:-1]}):
        refused = httpx.post(f"{rest}/v1/localize", headers=headers, content=b"x" * 100)
        assert (refused.status_code, refused.json()["code"]) == (401, "unauthorized")
        assert refused.headers["www-authenticate"] == "Bearer"
        assert refused.json()["request_id"] == refused.headers["x-request-id"]
    for headers in ({"Authorization": f"Bearer {key}"}, {"X-Api-Key": key}):
        assert httpx.get(f"{rest}/v1/maps", headers=headers).json()["maps"][0]["name"] == "tiny"
    for path_ in ("/livez", "/readyz"):
        assert httpx.get(rest + path_).status_code == 200
    for name, content in parts_of().items():
        (tmp_path / name).write_bytes(content)
    files = [word for name in ("rgb", "depth") for word in (f"--{name}", str(tmp_path / name))]
    asked = [*COMMAND, "localize", "--url", rest, *files, "--camera", str(tmp_path / "request")]
    for environment, told in (({}, "unauthorized"), ({"STREETFIX_API_KEY": key}, "LOCALIZED")):
        done = subprocess.run(asked, env={"PATH": "", **environment}, capture_output=True, text=True, check=False)
        assert told in done.stdout or "requires an API key" in done.stderr
        assert (done.returncode == 0) == (told == "LOCALIZED")
    with grpc.insecure_channel(grpc_address) as channel:
        stub = LocalizationServiceStub(channel)
        for metadata in ((), (("authorization", "Bearer wrong"),)):
            with pytest.raises(grpc.RpcError) as caught:
                stub.ListMaps(pb.ListMapsRequest(), metadata=metadata)
            assert caught.value.code() == grpc.StatusCode.UNAUTHENTICATED
            with pytest.raises(grpc.RpcError) as caught:
                next(stub.LocalizeStream(iter([]), metadata=metadata))
            assert caught.value.code() == grpc.StatusCode.UNAUTHENTICATED
        for metadata in ((("authorization", f"Bearer {key}"),), (("x-api-key", key),)):
            assert stub.ListMaps(pb.ListMapsRequest(), metadata=metadata).maps[0].name == "tiny"
        checked = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest())
        assert checked.status == health_pb2.HealthCheckResponse.SERVING


def refused(bundle: Path, **settings: object) -> str:
    environment = {f"STREETFIX_{name.upper()}": str(value) for name, value in settings.items()}
    done = subprocess.run(
        [*COMMAND, "serve", str(bundle), "--port", "0"],
        env={"PATH": "", **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    return done.stderr


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "example.org"])  # noqa: S104
def test_a_public_address_without_keys_is_refused(bundle_path: Path, host: str) -> None:
    told = refused(bundle_path, host=host)
    assert host in told
    assert "STREETFIX_API_KEYS" in told
    assert "STREETFIX_INSECURE_PUBLIC=true" in told


def test_the_operator_may_insist(start: Start) -> None:
    rest, _ = start(host="0.0.0.0", insecure_public=True)  # noqa: S104
    assert httpx.get(rest.replace("0.0.0.0", "127.0.0.1") + "/v1/maps").status_code == 200  # noqa: S104


def test_bad_files_are_named_before_anything_listens(bundle_path: Path, tmp_path: Path) -> None:
    (tmp_path / "bad").write_text("nothing of the kind\n")
    assert "line 1" in refused(bundle_path, api_keys=tmp_path / "bad")
    assert "nowhere" in refused(bundle_path, api_keys=tmp_path / "nowhere")
    assert "tls_certificate and tls_key go together" in refused(bundle_path, tls_certificate=tmp_path / "bad")
    assert "not a certificate with its key" in refused(
        bundle_path, tls_certificate=tmp_path / "bad", tls_key=tmp_path / "bad"
    )


@pytest.fixture(scope="module")
def pem(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """An authority, a certificate of it for 127.0.0.1, and a client's."""
    import trustme

    folder = tmp_path_factory.mktemp("pem")
    authority = trustme.CA()
    authority.cert_pem.write_to_path(str(folder / "ca"))
    for name, certificate in (
        ("server", authority.issue_cert("127.0.0.1", "localhost")),
        ("client", authority.issue_cert("robot")),
    ):
        certificate.cert_chain_pems[0].write_to_path(str(folder / f"{name}.crt"))
        certificate.private_key_pem.write_to_path(str(folder / f"{name}.key"))
    return {name: folder / name for name in ("ca", "server.crt", "server.key", "client.crt", "client.key")}


@pytest.mark.parametrize("mutual", [False, True])
def test_tls_is_spoken_by_both_faces(start: Start, pem: dict[str, Path], mutual: bool) -> None:
    settings = {"tls_certificate": pem["server.crt"], "tls_key": pem["server.key"]}
    rest, grpc_address = start(**settings, **({"tls_client_ca": pem["ca"]} if mutual else {}))
    assert rest.startswith("https://")
    anonymous = ssl.create_default_context(cafile=str(pem["ca"]))
    known = ssl.create_default_context(cafile=str(pem["ca"]))
    known.load_cert_chain(pem["client.crt"], pem["client.key"])
    assert httpx.get(f"{rest}/livez", verify=known).status_code == 200
    if mutual:
        with pytest.raises(httpx.TransportError):
            httpx.get(f"{rest}/livez", verify=anonymous)
    with pytest.raises(httpx.TransportError):
        httpx.get(rest.replace("https", "http") + "/livez")
    root, client = pem["ca"].read_bytes(), (pem["client.key"].read_bytes(), pem["client.crt"].read_bytes())
    without, with_ = grpc.ssl_channel_credentials(root), grpc.ssl_channel_credentials(root, *client)
    for credentials, gets_in in ((without, not mutual), (with_, True)):
        with grpc.secure_channel(grpc_address, credentials) as channel:
            stub = LocalizationServiceStub(channel)
            if gets_in:
                assert stub.ListMaps(pb.ListMapsRequest(), timeout=20).maps[0].name == "tiny"
            else:
                with pytest.raises(grpc.RpcError):
                    stub.ListMaps(pb.ListMapsRequest(), timeout=5)


def test_check_says_what_would_be_served_and_leaves(bundle_path: Path, tmp_path: Path) -> None:
    _, keys = made_key(tmp_path)
    done = subprocess.run(
        [*COMMAND, "serve", str(bundle_path), "--check", "--threads", "3"],
        env={"PATH": "", "STREETFIX_API_KEYS": str(keys)},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert '"threads": 3' in done.stdout
    assert re.search(r"map tiny \w+: opens and answers\nkeys: 1\n$", done.stdout)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "manifest.json").write_text("{")
    refused_ = subprocess.run(
        [*COMMAND, "serve", str(tmp_path / "broken"), "--check"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert refused_.returncode == 1
    assert "manifest.json" in refused_.stderr


def test_the_log_has_a_line_for_each_request_and_nothing_of_its_content(
    bundle_path: Path, parts_of: Callable[..., dict[str, bytes]]
) -> None:
    settings = {"STREETFIX_LOG_STYLE": "json", "STREETFIX_LOG_LEVEL": "info"}
    process = subprocess.Popen(
        [*COMMAND, "serve", str(bundle_path), "--threads", "1", "--port", "0"],
        env={"PATH": "", **settings},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    url = next(found[1] for line in process.stdout if (found := re.search(r"serving at (\S+)", line)))
    files = {name: (name, data) for name, data in parts_of().items()}
    trace = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"
    httpx.post(f"{url}/v1/localize?secret=1", files=files, headers={"X-Request-Id": "r-1", "traceparent": trace})
    httpx.get(f"{url}/nowhere/secret")
    process.send_signal(signal.SIGTERM)
    told = [json.loads(line) for line in process.communicate(timeout=60)[1].splitlines()]
    requests = [each for each in told if each["event"] == "request"]
    assert [(each["method"], each["code"]) for each in requests] == [("localize", "200"), ("none", "404")]
    assert (requests[0]["request_id"], requests[0]["trace_id"]) == ("r-1", trace.split("-")[1])
    assert "secret" not in json.dumps(told)
