"""The chart: linted and rendered where Helm is installed; what it names must be there in any case."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from service.runtime.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "deploy" / "helm"
TEMPLATES = sorted((CHART / "templates").glob("*.yaml"))
VALUES: dict[str, Any] = yaml.safe_load((CHART / "values.yaml").read_text())
needs_helm = pytest.mark.skipif(shutil.which("helm") is None, reason="Helm is not installed on this machine")


def leaves(values: dict[str, Any], path: str = "") -> set[str]:
    found = set()
    for name, value in values.items():
        here = f"{path}.{name}" if path else name
        found |= {here} | (leaves(value, here) if isinstance(value, dict) else set())
    return found


def test_every_value_that_a_template_names_is_there_and_every_value_is_used() -> None:
    texts = [*TEMPLATES, CHART / "templates" / "_helpers.tpl", CHART / "templates" / "NOTES.txt"]
    named = {name for path in texts for name in re.findall(r"\.Values\.([A-Za-z.]+)", path.read_text())}
    assert named <= leaves(VALUES)
    assert {
        name
        for name in leaves(VALUES)
        if not any(n == name or n.startswith(f"{name}.") or name.startswith(f"{n}.") for n in named)
    } == set()


def test_settings_are_those_of_the_service() -> None:
    text = "".join(path.read_text() for path in TEMPLATES) + (CHART / "values.yaml").read_text()
    named = set(re.findall(r"STREETFIX_[A-Z_]+", text))
    assert named - {f"STREETFIX_{name.upper()}" for name in Settings.model_fields} == set()


def test_pods_do_not_get_variables_of_kubernetes_own_services() -> None:
    """Of a Service called streetfix they would be taken for settings, and refused."""
    assert "enableServiceLinks: false" in (CHART / "templates" / "deployment.yaml").read_text()


def test_a_pod_leaves_in_the_time_that_the_service_takes() -> None:
    grace = re.search(r"terminationGracePeriodSeconds: (\d+)", (CHART / "templates" / "deployment.yaml").read_text())
    settings = VALUES["settings"]
    assert grace is not None
    assert int(grace[1]) > float(settings["STREETFIX_DRAIN_S"]) + float(settings["STREETFIX_GRACE_S"])


def test_braces_and_blocks_of_templates_are_closed() -> None:
    for path in TEMPLATES:
        text = path.read_text()
        assert text.count("{{") == text.count("}}"), path.name
        opened = len(re.findall(r"{{-?\s*(?:if|range|with|define)\b", text))
        assert opened == len(re.findall(r"{{-?\s*end\s*-?}}", text)), path.name


def test_prometheus_shows_a_key_where_the_service_wants_one() -> None:
    """The pods always ask for keys, of whoever wants their metrics too."""
    pod, monitor = ((CHART / "templates" / name).read_text() for name in ("deployment.yaml", "monitor.yaml"))
    assert "STREETFIX_API_KEYS" in pod
    assert "prometheus.io/scrape" not in pod
    assert "type: Bearer" in monitor
    assert "scheme: https" in monitor.partition(".Values.tls.secret")[2]


def test_probes_ask_the_port_that_asks_for_no_certificate() -> None:
    pod = (CHART / "templates" / "deployment.yaml").read_text()
    assert re.findall(r"httpGet: \{ path: ([^,]+), port: (\w+) \}", pod) == [
        ("/readyz", "health"),
        ("/readyz", "health"),
        ("/livez", "health"),
    ]
    assert "STREETFIX_HEALTH_PORT" in pod


@needs_helm
def test_helm_finds_nothing_to_complain_of() -> None:
    subprocess.run(["helm", "lint", "--strict", str(CHART)], check=True, capture_output=True)


BASE = ["--set", "image.repository=registry.example/streetfix,maps.claim=maps"]
KEYS = ["--set", "keys.secret=keys"]


def rendered(*options: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(["helm", "template", "x", str(CHART), *options], check=False, capture_output=True, text=True)


def documents(*options: str) -> dict[str, dict[str, Any]]:
    """By their kinds."""
    done = rendered(*options)
    assert done.returncode == 0, done.stderr
    return {document["kind"]: document for document in yaml.safe_load_all(done.stdout) if document}


@needs_helm
@pytest.mark.parametrize(
    "options",
    [
        [*BASE, *KEYS],
        [
            *BASE,
            *KEYS,
            "--set",
            "autoscaling.enabled=true,tls.secret=certificate,network.collector=10.0.0.0/8,monitor.enabled=true,monitor.secret=key",
        ],
    ],
)
def test_what_it_renders_is_what_kubernetes_reads(options: list[str]) -> None:
    kinds = set(documents(*options))
    assert {"Deployment", "Service", "PodDisruptionBudget", "NetworkPolicy", "ServiceAccount"} <= kinds
    assert ("HorizontalPodAutoscaler" in kinds) == ("PodMonitor" in kinds) == (len(options) > 4)


@needs_helm
@pytest.mark.parametrize(
    ("options", "told"),
    [
        ([], "image.repository"),
        (["--set", "image.repository=r"], "maps.claim"),
        (BASE, "keys.secret"),
        ([*BASE, "--set", "tls.clientCa=ca"], "tls.clientCa needs tls.secret"),
        ([*BASE, *KEYS, "--set", "monitor.enabled=true"], "monitor.secret"),
    ],
)
def test_what_is_missing_is_told_by_its_name(options: list[str], told: str) -> None:
    done = rendered(*options)
    assert done.returncode != 0
    assert told in done.stderr


@needs_helm
def test_with_client_certificates_everything_that_has_none_uses_the_health_port() -> None:
    found = documents(*BASE, "--set", "tls.secret=tls,tls.clientCa=ca,monitor.enabled=true")
    (container,) = found["Deployment"]["spec"]["template"]["spec"]["containers"]
    variables = {each["name"]: each["value"] for each in container["env"]}
    assert variables["STREETFIX_TLS_CLIENT_CA"] == "/run/secrets/client-ca/ca.crt"
    assert variables["STREETFIX_HEALTH_METRICS"] == "true"
    assert "STREETFIX_API_KEYS" not in variables
    mounts = {each["mountPath"]: each["name"] for each in container["volumeMounts"]}
    volumes = {each["name"]: each for each in found["Deployment"]["spec"]["template"]["spec"]["volumes"]}
    assert volumes[mounts["/run/secrets/client-ca"]]["secret"]["secretName"] == "ca"
    (endpoint,) = found["PodMonitor"]["spec"]["podMetricsEndpoints"]
    assert endpoint["port"] == "health"
    assert {"port": "health"} in found["NetworkPolicy"]["spec"]["ingress"][0]["ports"]


@needs_helm
def test_pods_are_placed_and_named_as_the_values_say() -> None:
    found = documents(
        *BASE,
        *KEYS,
        "--set",
        "image.pullSecrets[0].name=registry,nodeSelector.disk=fast,tolerations[0].key=gpu,serviceAccount.name=me",
        "--set",
        "podAnnotations.team=maps,affinity.nodeAffinity.x=y",
    )
    pod = found["Deployment"]["spec"]["template"]
    assert pod["spec"]["imagePullSecrets"] == [{"name": "registry"}]
    assert pod["spec"]["nodeSelector"] == {"disk": "fast"}
    assert pod["spec"]["tolerations"] == [{"key": "gpu"}]
    assert pod["spec"]["serviceAccountName"] == found["ServiceAccount"]["metadata"]["name"] == "me"
    assert pod["spec"]["affinity"] == {"nodeAffinity": {"x": "y"}}
    assert pod["metadata"]["annotations"]["team"] == "maps"
    assert re.fullmatch(r"[0-9a-f]{64}", pod["metadata"]["annotations"]["checksum/secrets"])


@needs_helm
@pytest.mark.parametrize(("tls", "protocols"), [(False, ["http", "kubernetes.io/h2c"]), (True, ["https", "https"])])
def test_the_service_names_the_protocol_that_is_spoken(tls: bool, protocols: list[str]) -> None:
    found = documents(*BASE, *KEYS, *(["--set", "tls.secret=tls"] if tls else []))
    assert [port["appProtocol"] for port in found["Service"]["spec"]["ports"]] == protocols


@needs_helm
def test_the_notes_say_how_to_ask() -> None:
    command = ["helm", "install", "x", str(CHART), "--dry-run=client", *BASE, *KEYS]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    notes = done.stdout.partition("NOTES:")[2]
    assert "rollout status deployment/x-streetfix" in notes
    assert "X-Api-Key: KEY" in notes
