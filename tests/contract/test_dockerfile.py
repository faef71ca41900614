"""There may be no container engine where this runs: the Dockerfile is parsed instead."""

import json
import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def instructions() -> list[tuple[str, str]]:
    """Instruction and arguments, continued lines joined, comments left out."""
    lines = [line for line in (ROOT / "Dockerfile").read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\s*\\\n\s*", " ", "\n".join(lines))
    return [
        (name.upper(), rest.strip()) for name, _, rest in (line.partition(" ") for line in joined.splitlines() if line)
    ]


def stages() -> list[list[tuple[str, str]]]:
    found: list[list[tuple[str, str]]] = []
    for name, rest in instructions():
        if name == "FROM":
            found.append([])
        found[-1].append((name, rest))
    return found


def values(stage: list[tuple[str, str]], name: str) -> list[str]:
    return [rest for each, rest in stage if each == name]


def sources() -> list[str]:
    """What is copied from the repository, not from another stage."""
    copies = [shlex.split(rest) for stage in stages() for rest in values(stage, "COPY")]
    return [source for copy in copies if not copy[0].startswith("--from=") for source in copy[:-1]]


@pytest.mark.parametrize("source", sources())
def test_what_is_copied_exists_and_is_not_ignored(source: str) -> None:
    assert (ROOT / source).exists()
    kept = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    assert source in kept


def test_nothing_is_let_in_that_is_not_copied() -> None:
    kept = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    assert {name for name in kept if not name.startswith("native/")} == set(sources())


def test_both_images_are_pinned_by_digest_and_are_of_one_python() -> None:
    images = [values(stage, "FROM")[0].split()[0] for stage in stages()]
    found = [re.fullmatch(r"python:(3\.\d+\.\d+)(-slim)?-([a-z]+)@sha256:[0-9a-f]{64}", image) for image in images]
    assert [each[2] for each in found if each] == [None, "-slim"]
    # One interpreter and one C library: what the first builds runs on the last.
    assert len({(each[1], each[3]) for each in found if each}) == 1


@pytest.mark.parametrize("lock", ["service", "build"])
def test_every_locked_package_has_its_hashes(lock: str) -> None:
    told = (ROOT / "locks" / f"{lock}.txt").read_text()
    entries = re.split(r"^(?=[A-Za-z0-9])", told, flags=re.MULTILINE)[1:]
    assert entries
    for entry in entries:
        assert re.match(r"[A-Za-z0-9._-]+(\[[^\]]*\])?==\S+", entry), entry
        assert "--hash=sha256:" in entry, entry


def test_every_package_that_the_build_fetches_is_locked() -> None:
    for step in values(stages()[0], "RUN"):
        for command in step.split("&&"):
            if re.search(r"\bpip\b.*\b(install|wheel)\b", command):
                assert "--require-hashes" in command or "--no-index" in command, command


def test_the_wheel_is_of_the_service_alone() -> None:
    assert "--config-settings wheel.packages=service " in " ".join(values(stages()[0], "RUN"))
    assert not any("model_training" in source for source in sources())


def test_the_last_stage_copies_from_the_first_only() -> None:
    assert all(rest.startswith("--from=build ") for rest in values(stages()[-1], "COPY"))


def test_the_service_runs_as_a_user_without_rights() -> None:
    user, group = values(stages()[-1], "USER")[-1].split(":")
    assert int(user) >= 1000
    assert int(group) >= 1000


def test_packages_are_installed_from_the_lock_by_hash() -> None:
    run = " ".join(values(stages()[0], "RUN"))
    assert "--require-hashes --requirement locks/service.txt" in run
    lock = (ROOT / "locks" / "service.txt").read_text()
    pinned = re.findall(r"^[A-Za-z0-9._-]+(?:\[[^\]]*\])?==", lock, flags=re.MULTILINE)
    assert pinned
    assert lock.count("--hash=sha256:") >= len(pinned)


@pytest.mark.parametrize("package", ["obstore", "opentelemetry-exporter-otlp-proto-http"])
def test_the_image_can_do_what_the_chart_offers(package: str) -> None:
    """The chart has `maps.urls` and `network.collector`: maps in object storage, and traces."""
    lock = (ROOT / "locks" / "service.txt").read_text()
    assert re.search(rf"^{package}==", lock, flags=re.MULTILINE)


def test_no_torch_and_no_build_tool_gets_in() -> None:
    lock = (ROOT / "locks" / "service.txt").read_text()
    assert not re.search(r"^(torch|embreex|tensorboard|nvidia|pytest|setuptools|wheel)\b", lock, flags=re.MULTILINE)
    last = " ".join(rest for _, rest in stages()[-1])
    assert not re.search(r"\b(apt|apt-get|gcc|make|pip install)\b", last)
    assert "pip uninstall" in last


def test_nothing_is_written_at_run_time() -> None:
    assert "PYTHONDONTWRITEBYTECODE=1" in " ".join(values(stages()[-1], "ENV"))
    assert values(stages()[-1], "WORKDIR") == ["/tmp"]  # noqa: S108  # the one folder that may be written


def test_the_ports_are_those_of_the_settings_and_health_has_its_own() -> None:
    stage = stages()[-1]
    rest, grpc = values(stage, "EXPOSE")[0].split()
    assert f"STREETFIX_PORT={rest}" in values(stage, "ENV")[0]
    assert f"STREETFIX_GRPC_PORT={grpc}" in values(stage, "ENV")[0]
    health = values(stage, "HEALTHCHECK")[0]
    assert json.loads(health[health.index("CMD ") + 4 :]) == ["streetfix-ready"]
    # Inside the container alone: the health port is not one of those that are published.
    assert re.search(r"STREETFIX_HEALTH_PORT=\d+", values(stage, "ENV")[0])


def test_the_health_check_starts_no_python() -> None:
    assert "install -m 755 docker/ready /opt/streetfix/bin/streetfix-ready" in " ".join(values(stages()[0], "RUN"))
    lines = (ROOT / "docker" / "ready").read_text().splitlines()
    assert lines[0] == "#!/bin/bash"
    # Without a health port, which the image sets, there may be TLS: Python can speak that.
    assert [line.strip() for line in lines if "streetfix" in line and not line.startswith("#")] == [
        "exec streetfix health"
    ]


def test_the_command_serves_the_mounted_maps_on_all_addresses_of_the_container() -> None:
    stage = stages()[-1]
    assert json.loads(values(stage, "CMD")[0]) == ["streetfix", "serve", "--host", "0.0.0.0"]  # noqa: S104
    assert values(stage, "VOLUME") == ['["/maps"]']
    assert "STREETFIX_MAPS=/maps" in values(stage, "ENV")[0]
