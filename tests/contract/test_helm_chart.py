"""The chart: linted and rendered where Helm is installed; what it names must be there in any case."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from service.client.cells import HEADER
from service.grpc.generated.streetfix.v1 import localization_pb2
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
VERSION = "3f9c2a7be01d4586"
STORED = [
    *("--set", "image.repository=registry.example/streetfix", *KEYS),
    *(
        "--set",
        f"maps.urls={{s3://bucket/maps/town@{VERSION},gs://bucket/city}}",
        "--set",
        "network.store[0]=10.1.0.0/16",
    ),
]
SERVICE = localization_pb2.DESCRIPTOR.services_by_name["LocalizationService"]
ROUTING = ["--set", "routing.enabled=true,routing.host=maps.example"]


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
        ([*BASE, *KEYS, "--set", "spread.zones=Never"], 'spread: "Never" is not known; write ScheduleAnyway or'),
        ([*BASE, *KEYS, "--set", "spread.machines=true"], "spread: "),
        ([*STORED, "--set", "network.store=null"], "network.store"),
        (
            [*STORED, "--set", "maps.cache.hostPath=/c,maps.cache.storageClass=nvme"],
            "storageClass and hostPath exclude",
        ),
        ([*BASE, *KEYS, *ROUTING], "routing.gateway.name"),
        ([*BASE, *KEYS, "--set", "routing.enabled=true,routing.gateway.name=eg"], "routing.host"),
        ([*BASE, *KEYS, *ROUTING, "--set", "routing.controller=traefik"], 'routing.controller: "traefik" is not known'),
        (
            [*BASE, *KEYS, *ROUTING, "--set", "routing.gateway.name=eg,tls.secret=tls"],
            "leave tls.secret and routing.tls",
        ),
        (
            [*BASE, *ROUTING, "--set", "tls.secret=tls,tls.clientCa=ca,routing.controller=nginx"],
            "leave tls.clientCa empty",
        ),
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


def pod_of(*options: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The pod and its container."""
    pod: dict[str, Any] = documents(*options)["Deployment"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    return pod, container


@needs_helm
def test_a_map_in_a_store_is_pinned_by_its_url_and_rolled_out_pod_by_pod() -> None:
    found = documents(*STORED, "--set", "maps.store=credentials")
    (container,) = found["Deployment"]["spec"]["template"]["spec"]["containers"]
    variables = {each["name"]: each.get("value") for each in container["env"]}
    assert variables["STREETFIX_MAPS"] == f"s3://bucket/maps/town@{VERSION}:gs://bucket/city"
    settings = Settings(maps=variables["STREETFIX_MAPS"])  # as the environment gives it
    assert [str(each) for each in settings.maps] == [f"s3://bucket/maps/town@{VERSION}", "gs://bucket/city"]
    assert variables["STREETFIX_TILE_CACHE"] == "/cache"
    assert variables["STREETFIX_TILE_CACHE_BYTES"] == "20000000000"
    assert container["envFrom"] == [{"secretRef": {"name": "credentials"}}]
    # Another version is another pod template. A pod goes only when a new one is ready.
    assert found["Deployment"]["spec"]["strategy"]["rollingUpdate"] == {"maxUnavailable": 0, "maxSurge": 1}
    egress = found["NetworkPolicy"]["spec"]["egress"]
    assert {"to": [{"ipBlock": {"cidr": "10.1.0.0/16"}}]} in egress


@needs_helm
def test_a_volume_and_a_store_stand_beside_each_other() -> None:
    pod, container = pod_of(*STORED, "--set", "maps.claim=maps")
    (maps,) = (each["value"] for each in container["env"] if each["name"] == "STREETFIX_MAPS")
    assert maps == f"/maps:s3://bucket/maps/town@{VERSION}:gs://bucket/city"
    assert {"maps", "cache"} <= {each["name"] for each in pod["volumes"]}


@needs_helm
@pytest.mark.parametrize(
    ("options", "volume"),
    [
        ("", {"emptyDir": {"sizeLimit": "30Gi"}}),
        ("maps.cache.hostPath=/var/lib/tiles", {"hostPath": {"path": "/var/lib/tiles", "type": "Directory"}}),
        (
            "maps.cache.storageClass=nvme,maps.cache.size=1Ti",
            {
                "ephemeral": {
                    "volumeClaimTemplate": {
                        "spec": {
                            "accessModes": ["ReadWriteOnce"],
                            "storageClassName": "nvme",
                            "resources": {"requests": {"storage": "1Ti"}},
                        }
                    }
                }
            },
        ),
    ],
)
def test_where_the_cache_lies(options: str, volume: dict[str, Any]) -> None:
    pod, container = pod_of(*STORED, *(["--set", options] if options else []))
    assert {"name": "cache", "mountPath": "/cache"} in container["volumeMounts"]
    (cache,) = (each for each in pod["volumes"] if each["name"] == "cache")
    assert cache == {"name": "cache"} | volume


@needs_helm
@pytest.mark.parametrize(
    ("options", "zones", "machines"),
    [
        ([], "ScheduleAnyway", "ScheduleAnyway"),
        (["--set", "spread.zones=DoNotSchedule"], "DoNotSchedule", "ScheduleAnyway"),
        (["--set", "spread.machines=DoNotSchedule"], "ScheduleAnyway", "DoNotSchedule"),
    ],
)
def test_pods_spread_over_zones_and_machines(options: list[str], zones: str, machines: str) -> None:
    pod, _ = pod_of(*BASE, *KEYS, *options)
    found = {each["topologyKey"]: each for each in pod["topologySpreadConstraints"]}
    rules = {key: each["whenUnsatisfiable"] for key, each in found.items()}
    assert rules == {"topology.kubernetes.io/zone": zones, "kubernetes.io/hostname": machines}
    for each in found.values():
        is_strict = each["whenUnsatisfiable"] == "DoNotSchedule"
        assert each["maxSkew"] == 1
        assert set(each["labelSelector"]["matchLabels"]) == {"app.kubernetes.io/name", "app.kubernetes.io/instance"}
        assert each.get("matchLabelKeys") == (["pod-template-hash"] if is_strict else None)
        assert each.get("nodeTaintsPolicy") == ("Honor" if is_strict else None)


@needs_helm
def test_without_routing_nothing_is_routed() -> None:
    assert not {"Ingress", "HTTPRoute", "BackendTrafficPolicy"} & set(documents(*BASE, *KEYS))


@needs_helm
def test_envoy_gateway_hashes_the_header_of_the_client() -> None:
    found = documents(
        *(*BASE, *KEYS, *ROUTING, "--set", "routing.gateway.name=eg,routing.gateway.namespace=edge"),
        *("--set", "service.http=8080,service.grpc=5005"),
    )
    route, policy, service = (found[kind] for kind in ("HTTPRoute", "BackendTrafficPolicy", "Service"))
    assert route["spec"]["parentRefs"] == [{"name": "eg", "namespace": "edge"}]
    assert route["spec"]["hostnames"] == ["maps.example"]
    rule, of_grpc = route["spec"]["rules"]
    assert rule["backendRefs"] == [{"name": service["metadata"]["name"], "port": 8080}]
    assert 8080 in [each["port"] for each in service["spec"]["ports"]]
    assert float(rule["timeouts"]["request"].removesuffix("s")) > Settings.model_fields["request_timeout_s"].default
    ports = {each["name"]: each for each in service["spec"]["ports"]}
    assert of_grpc["backendRefs"] == [{"name": service["metadata"]["name"], "port": 5005}]
    assert (ports["grpc"]["port"], ports["grpc"]["appProtocol"]) == (5005, "kubernetes.io/h2c")
    (match,) = of_grpc["matches"]
    assert match == {"path": {"type": "PathPrefix", "value": f"/{SERVICE.full_name}/"}}
    assert of_grpc["timeouts"] == {"request": "0s"}  # no timeout: a stream may last for hours
    (target,) = policy["spec"]["targetRefs"]
    assert target == {
        "group": "gateway.networking.k8s.io",
        "kind": "HTTPRoute",
        "name": route["metadata"]["name"],
    }
    assert policy["spec"]["loadBalancer"] == {
        "type": "ConsistentHash",
        "consistentHash": {"type": "Header", "header": {"name": HEADER}},
    }
    assert "Ingress" not in found


@needs_helm
@pytest.mark.parametrize("tls", [False, True])
@pytest.mark.parametrize(
    ("controller", "hashes", "speaks_tls"),
    [
        (
            "nginx",
            {"nginx.org/lb-method": "hash $http_x_streetfix_cell consistent", "nginx.org/client-max-body-size": "64m"},
            {"nginx.org/ssl-services": "x-streetfix"},
        ),
        (
            "ingress-nginx",
            {
                "nginx.ingress.kubernetes.io/upstream-hash-by": "$http_x_streetfix_cell",
                "nginx.ingress.kubernetes.io/proxy-body-size": "64m",
            },
            {"nginx.ingress.kubernetes.io/backend-protocol": "HTTPS"},
        ),
    ],
)
def test_an_ingress_hashes_the_header_of_the_client(
    controller: str, hashes: dict[str, str], speaks_tls: dict[str, str], tls: bool
) -> None:
    options = (
        f"routing.controller={controller},routing.tls=host,routing.ingressClass=edge,routing.annotations.team=maps"
    )
    found = documents(*BASE, *KEYS, *ROUTING, "--set", options, *(["--set", "tls.secret=tls"] if tls else []))
    ingress, service = found["Ingress"], found["Service"]
    assert HEADER.lower().replace("-", "_") == "x_streetfix_cell"
    assert ingress["metadata"]["annotations"] == hashes | (speaks_tls if tls else {}) | {"team": "maps"}
    assert ingress["spec"]["ingressClassName"] == "edge"
    assert ingress["spec"]["tls"] == [{"hosts": ["maps.example"], "secretName": "host"}]
    (rule,) = ingress["spec"]["rules"]
    assert rule["host"] == "maps.example"
    (path,) = rule["http"]["paths"]
    assert path["backend"]["service"] == {"name": service["metadata"]["name"], "port": {"name": "http"}}
    assert not {"HTTPRoute", "BackendTrafficPolicy"} & set(found)


@needs_helm
def test_the_notes_say_how_to_ask() -> None:
    command = ["helm", "install", "x", str(CHART), "--dry-run=client", *BASE, *KEYS]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    notes = done.stdout.partition("NOTES:")[2]
    assert "rollout status deployment/x-streetfix" in notes
    assert "X-Api-Key: KEY" in notes
