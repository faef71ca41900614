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
    named = {name for path in TEMPLATES for name in re.findall(r"\.Values\.([A-Za-z.]+)", path.read_text())}
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


@needs_helm
def test_helm_finds_nothing_to_complain_of() -> None:
    subprocess.run(["helm", "lint", "--strict", str(CHART)], check=True, capture_output=True)


@needs_helm
@pytest.mark.parametrize(
    "options",
    [
        [],
        [
            "--set",
            "autoscaling.enabled=true,tls.secret=certificate,network.collector=10.0.0.0/8,monitor.enabled=true,monitor.secret=key",
        ],
    ],
)
def test_what_it_renders_is_what_kubernetes_reads(options: list[str]) -> None:
    done = subprocess.run(["helm", "template", "x", str(CHART), *options], check=True, capture_output=True, text=True)
    kinds = [document["kind"] for document in yaml.safe_load_all(done.stdout)]
    assert {"Deployment", "Service", "PodDisruptionBudget", "NetworkPolicy"} <= set(kinds)
    assert ("HorizontalPodAutoscaler" in kinds) == ("PodMonitor" in kinds) == bool(options)
