"""What lies in deploy/ fits the service: its settings, its ports, its metrics."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from service.contract.convert import parsed, query_from
from service.contract.schema import LocalizeRequest
from service.runtime.engine import Engine
from service.runtime.environment import require_known
from service.runtime.settings import Settings

DEPLOY = Path(__file__).parents[2] / "deploy"


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return yaml.safe_load((DEPLOY / "compose.yaml").read_text())


def test_the_settings_of_the_compose_file_exist(compose: dict[str, Any]) -> None:
    names = {name.removeprefix("STREETFIX_").lower() for name in compose["services"]["streetfix"]["environment"]}
    assert names
    assert names <= set(Settings.model_fields)


def test_its_service_cannot_write_and_has_time_to_drain(compose: dict[str, Any]) -> None:
    service = compose["services"]["streetfix"]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert all(volume.endswith(":ro") for volume in service["volumes"])
    grace: float = Settings.model_fields["grace_s"].default
    assert float(service["stop_grace_period"].removesuffix("s")) > grace


def test_its_ports_are_published_to_this_machine_alone_unless_the_operator_says_otherwise(
    compose: dict[str, Any],
) -> None:
    for service in compose["services"].values():
        for port in service.get("ports", []):
            assert port.startswith(("127.0.0.1:", "${STREETFIX_PUBLISH_ADDRESS:-127.0.0.1}:")), port


def test_with_tls_the_service_finds_what_is_mounted() -> None:
    overlay = yaml.safe_load((DEPLOY / "compose.tls.yaml").read_text())
    service = overlay["services"]["streetfix"]
    names = {name.removeprefix("STREETFIX_").lower() for name in service["environment"]}
    assert names == {"tls_certificate", "tls_key"}
    mounted = {f"/run/secrets/{name}" for name in service["secrets"]}
    assert set(service["environment"].values()) <= mounted
    assert set(service["secrets"]) == set(overlay["secrets"]) | {"api_keys"}


@pytest.mark.parametrize("name", ["compose.yaml", "compose.tls.yaml"])
def test_variables_of_the_compose_files_do_not_keep_a_service_from_starting(name: str) -> None:
    """Whoever exports them for Compose may start a service in the same shell."""
    used = set(re.findall(r"\$\{(STREETFIX_\w+)", (DEPLOY / name).read_text()))
    assert used
    require_known(dict.fromkeys(used, "x"), Settings)


def test_its_ports_are_those_of_the_image(compose: dict[str, Any]) -> None:
    dockerfile = (DEPLOY.parent / "Dockerfile").read_text()
    exposed = re.search(r"^EXPOSE (.*)$", dockerfile, re.MULTILINE)
    assert exposed is not None
    inside = [port.rsplit(":", 1)[1] for port in compose["services"]["streetfix"]["ports"]]
    assert inside == exposed[1].split()


def test_the_dashboard_asks_for_metrics_that_are_there(
    bundle_path: Path, parts_of: Callable[..., dict[str, bytes]]
) -> None:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    parts = parts_of()
    engine.localize(query_from(parsed(parts["request"], LocalizeRequest), rgb=parts["rgb"], depth=parts["depth"]))
    engine.metrics.requested("rest", "localize", "200", 0.1)
    told = engine.metrics.text().decode()
    engine.close()
    there = set(re.findall(r"^# TYPE (\w+) ", told, re.MULTILINE)) | set(re.findall(r"^(\w+)[ {]", told, re.MULTILINE))
    dashboard = json.loads((DEPLOY / "grafana-dashboard.json").read_text())
    asked = {
        name
        for panel in dashboard["panels"]
        for target in panel["targets"]
        for name in re.findall(r"\b((?:streetfix|process)_\w+)", target["expr"])
    }
    assert len(asked) > 8
    # A histogram without an observation has a type but no bucket yet.
    plain = {re.sub(r"_(bucket|sum|count)$", "", name) for name in asked}
    assert {name for name in plain if name not in there and f"{name}_total" not in there} == set()


def test_every_file_that_is_mounted_is_there(compose: dict[str, Any]) -> None:
    mounted = [
        volume.split(":")[0] for name in ("prometheus", "grafana") for volume in compose["services"][name]["volumes"]
    ]
    assert len(mounted) == 4
    assert all((DEPLOY / path).is_file() for path in mounted)


def test_prometheus_scrapes_the_port_of_the_service(compose: dict[str, Any]) -> None:
    config = yaml.safe_load((DEPLOY / "prometheus.yaml").read_text())
    (scrape,) = config["scrape_configs"]
    assert scrape["static_configs"][0]["targets"] == ["streetfix:8000"]
    assert "scrape_key" in compose["services"]["prometheus"]["secrets"]
