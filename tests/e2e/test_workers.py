"""Several processes on the same ports: one falls, the others answer; what one is told, all do; what all count is one number."""

import os
import random
import re
import shutil
import signal
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from benchmarks.serving.agreement import Named, Switch, disagreements
from model_training.loadtest.processes import descendants
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.maps.content import BundleContent
from service.maps.writer import write_bundle

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()", "serve"]
Parts = Callable[..., dict[str, bytes]]
WORKERS = 2
#: Clients of plain HTTP need no authorities. Reading them takes more processor time than a request.
NO_AUTHORITIES = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
get = partial(httpx.get, verify=NO_AUTHORITIES, timeout=30)
put = partial(httpx.put, verify=NO_AUTHORITIES, timeout=30)


class Service:
    def __init__(self, folder: Path) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, str(folder), "--workers", str(WORKERS), "--port", "0", "--grpc-port", "0"],
            text=True,
            env={"PATH": "", "STREETFIX_WATCH_S": "0.2"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        found: dict[str, str] = {}
        for line in self.process.stdout or ():
            if match := re.search(r"serving( gRPC)? at (\S+)", line):
                found["grpc" if match[1] else "url"] = match[2]
                if "url" in found:
                    break
        self.url, self.grpc = found["url"], found["grpc"]
        until = time.monotonic() + 60
        while len(self.workers) < WORKERS:
            assert time.monotonic() < until
            time.sleep(0.01)
        self.until(lambda: self.listening == WORKERS)

    @property
    def listening(self) -> int:
        """Sockets that listen on the port: one of each worker that answers."""
        port, rows = f"{httpx.URL(self.url).port:04X}", Path("/proc/net/tcp").read_text().splitlines()[1:]
        return sum(row.split()[1].endswith(f":{port}") and row.split()[3] == "0A" for row in rows)

    @property
    def workers(self) -> set[int]:
        return descendants(self.process.pid) - {self.process.pid}

    def metric(self, name: str, **labels: str) -> float:
        """Sum over samples of a name that have these labels."""
        text = get(f"{self.url}/metrics").text
        samples = [each for family in text_string_to_metric_families(text) for each in family.samples]
        return sum(s.value for s in samples if s.name == name and labels.items() <= s.labels.items())

    @staticmethod
    def until(true: Callable[[], bool]) -> None:
        end = time.monotonic() + 60
        while not true():
            assert time.monotonic() < end
            time.sleep(0.05)


@pytest.fixture
def folder(content_of: Callable[..., BundleContent], tmp_path: Path) -> Path:
    write_bundle(tmp_path / "maps" / "v0", content_of(seed=0))
    return tmp_path / "maps"


@pytest.fixture
def service(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    monkeypatch.setenv("STREETFIX_THREADS", "1")
    running = Service(folder)
    yield running
    if running.process.poll() is None:
        running.process.send_signal(signal.SIGTERM)
    running.process.communicate(timeout=60)


@pytest.fixture(scope="module")
def undisturbed(
    content_of: Callable[..., BundleContent], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Service]:
    """A service of the tests that change nothing and count nothing."""
    folder = tmp_path_factory.mktemp("undisturbed")
    write_bundle(folder / "v0", content_of(seed=0))
    running = Service(folder)
    yield running
    running.process.send_signal(signal.SIGTERM)
    running.process.communicate(timeout=60)


def post(url: str, parts: dict[str, bytes]) -> httpx.Response:
    files = {name: (name, data) for name, data in parts.items()}
    return httpx.post(f"{url}/v1/localize", files=files, verify=NO_AUTHORITIES, timeout=30)


def test_a_worker_that_falls_is_started_again_and_the_others_answer_meanwhile(
    service: Service, parts_of: Parts
) -> None:
    before = service.workers
    os.kill(min(before), signal.SIGKILL)
    service.until(lambda: service.listening == WORKERS - 1)
    assert {post(service.url, parts_of()).status_code for _ in range(6)} == {200}
    service.until(lambda: len(service.workers) == WORKERS and service.workers != before)
    service.until(lambda: service.listening == WORKERS)
    assert service.metric("streetfix_capacity") == WORKERS * (1 + 64)
    assert post(service.url, parts_of()).status_code == 200
    service.process.send_signal(signal.SIGTERM)
    _, told = service.process.communicate(timeout=60)
    assert service.process.returncode == 0
    assert "ended unexpectedly and is started again" in told


def test_all_workers_count_together(service: Service, parts_of: Parts) -> None:
    assert {post(service.url, parts_of()).status_code for _ in range(8)} == {200}
    assert service.metric("streetfix_answers_total") == 8
    assert service.metric("streetfix_stage_seconds_count", stage="decode") == 8
    assert service.metric("streetfix_working") == service.metric("streetfix_waiting") == 0
    assert service.metric("streetfix_map") > 0


def test_processor_time_and_memory_are_those_of_all_workers(undisturbed: Service, parts_of: Parts) -> None:
    assert post(undisturbed.url, parts_of()).status_code == 200
    each = [of_process(pid) for pid in undisturbed.workers]
    assert undisturbed.metric("process_resident_memory_bytes") == pytest.approx(sum(rss for rss, _ in each), rel=0.2)
    assert undisturbed.metric("process_cpu_seconds_total") == pytest.approx(sum(cpu for _, cpu in each), rel=0.3)
    assert undisturbed.metric("process_open_fds") > WORKERS * 3


def of_process(pid: int) -> tuple[float, float]:
    """Resident bytes and processor seconds of one process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    seconds = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return int(fields[21]) * os.sysconf("SC_PAGE_SIZE"), seconds


def test_both_faces_answer_on_one_port_each(undisturbed: Service, parts_of: Parts) -> None:
    with grpc.insecure_channel(undisturbed.grpc) as channel:
        maps = LocalizationServiceStub(channel).ListMaps(pb.ListMapsRequest(), timeout=30).maps
    assert [each.name for each in maps] == [each["name"] for each in get(f"{undisturbed.url}/v1/maps").json()["maps"]]


def test_a_version_that_an_operator_chooses_serves_in_every_worker(
    service: Service, folder: Path, content_of: Callable[..., BundleContent]
) -> None:
    def entry() -> dict[str, Any]:
        (found,) = get(f"{service.url}/v1/maps").json()["maps"]
        return dict(found)

    old = entry()
    write_bundle(folder / "v1", content_of(seed=1))
    service.process.send_signal(signal.SIGHUP)
    # New connections come to either worker: so many in a row are those of both.
    service.until(lambda: all(entry()["version"] != old["version"] for _ in range(12)))
    done = put(f"{service.url}/v1/maps/{old['name']}/serving", json={"version": old["version"]})
    assert done.status_code == 200
    service.until(lambda: all(entry()["version"] == old["version"] for _ in range(12)))


def test_all_answers_name_one_version_while_workers_are_killed_and_versions_come_are_chosen_and_go(
    service: Service, folder: Path, content_of: Callable[..., BundleContent], parts_of: Parts
) -> None:
    """Both workers are asked all the time; the unit test of the serving table does the same a thousand times quicker."""
    parts, stop, answers = parts_of(), threading.Event(), list[Named]()

    def ask(client: httpx.Client) -> str:
        return str(client.get("/v1/maps").raise_for_status().json()["maps"][0]["version"])

    def localize(client: httpx.Client) -> str:
        files = {name: (name, data) for name, data in parts.items()}
        return str(client.post("/v1/localize", files=files).raise_for_status().json()["map"]["version"])

    def keep_asking(what: Callable[[httpx.Client], str]) -> None:
        while not stop.is_set():
            asked = time.monotonic()
            try:
                # a new connection may come to either worker
                with httpx.Client(base_url=service.url, verify=NO_AUTHORITIES, timeout=30) as client:
                    answers.append(Named(what(client), asked, time.monotonic()))
            except httpx.TransportError:  # of a worker that was killed
                continue
            time.sleep(0.03)  # so the workers have the processor too

    def serving() -> tuple[str, list[str]]:
        (entry,) = get(f"{service.url}/v1/maps").json()["maps"]
        return entry["version"], entry["versions"]

    def switched(act: Callable[[], object], version: str | None = None) -> str:
        """What serves after an act, and that it does."""
        (before, _), begun = serving(), time.monotonic()
        act()
        service.until(lambda: serving()[0] == version if version else serving()[0] != before)
        switches.append(Switch(serving()[0], begun, time.monotonic()))
        return switches[-1].version

    def choose(version: str) -> None:
        switched(
            lambda: put(f"{service.url}/v1/maps/tiny/serving", json={"version": version}).raise_for_status(),
            version,
        )

    def write(seed: int) -> str:
        return switched(lambda: write_bundle(folder / f"v{seed}", content_of(seed=seed)))

    def kill() -> None:
        """One worker; the other one goes on."""
        before = service.workers
        os.kill(random.choice(sorted(before)), signal.SIGKILL)  # noqa: S311  # no secret
        service.until(lambda: len(service.workers) == WORKERS and service.workers != before)

    def all_answer() -> bool:
        return service.listening == WORKERS

    first, switches = serving()[0], list[Switch]()
    with ThreadPoolExecutor(3) as pool:
        asking = [pool.submit(keep_asking, each) for each in (ask, ask, localize)]
        try:
            second = write(1)
            kill()
            choose(first)  # while one worker starts
            service.until(all_answer)
            third = write(2)
            kill()
            service.until(all_answer)
            assert serving() == (third, [third, second, first])
            shutil.rmtree(folder / "v0")
            choose(first)  # its folder is gone: it holds
            time.sleep(0.5)  # several looks at the folders
            assert serving()[0] == first
            kill()  # what is started again cannot open it, and waits
            assert serving()[0] == first
            assert service.listening == 1
            switched(lambda: service.process.send_signal(signal.SIGHUP), third)
            service.until(all_answer)
            write(3)
        finally:
            stop.set()
            for each in asking:
                each.result(60)
    assert len(answers) > 50
    assert disagreements(first, switches, answers) == []


def test_sigterm_during_the_start_ends_all_processes(folder: Path) -> None:
    process = subprocess.Popen(
        [*COMMAND, str(folder), "--workers", "8", "--port", "0"],
        env={"PATH": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    until = time.monotonic() + 60
    while len(descendants(process.pid)) < 3:  # itself and two workers, while it forks the others
        assert time.monotonic() < until
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)  # ends when nobody has the pipes open any more
    assert process.returncode == 0


def test_workers_of_an_empty_maps_folder_become_ready_when_a_bundle_comes(
    tmp_path: Path, content_of: Callable[..., BundleContent], monkeypatch: pytest.MonkeyPatch, parts_of: Parts
) -> None:
    (tmp_path / "maps").mkdir()
    service = Service(tmp_path / "maps")
    try:
        ready = get(f"{service.url}/readyz")
        assert (ready.status_code, ready.json()["code"]) == (503, "not-ready")
        assert post(service.url, parts_of()).json()["code"] == "not-ready"
        write_bundle(tmp_path / "maps" / "v0", content_of(seed=0))
        service.until(lambda: all(get(f"{service.url}/readyz").status_code == 200 for _ in range(8)))
        assert {post(service.url, parts_of()).status_code for _ in range(6)} == {200}
    finally:
        service.process.send_signal(signal.SIGTERM)
        service.process.communicate(timeout=60)


def test_a_damaged_bundle_beside_a_good_one_is_reported_and_nobody_is_kept_from_an_answer(
    folder: Path, content_of: Callable[..., BundleContent], parts_of: Parts
) -> None:
    write_bundle(folder / "bad", content_of(name="west"))
    (folder / "bad" / "descriptors.npy").write_bytes(b"short")
    service = Service(folder)
    try:
        (refused,) = get(f"{service.url}/readyz").json()["refused"]
        assert refused["bundle"] == "bad"
        assert refused["reason"].startswith("bad/descriptors.npy: 5 bytes instead of")
        assert service.metric("streetfix_bundle_refused", bundle="bad") == 1
        assert post(service.url, parts_of()).status_code == 200
    finally:
        service.process.send_signal(signal.SIGTERM)
        _, told = service.process.communicate(timeout=60)
    assert "map_refused" in told
    strict = subprocess.run(
        [*COMMAND, str(folder), "--workers", "2", "--port", "0", "--strict"],
        env={"PATH": ""},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert strict.returncode == 1
    assert "descriptors.npy" in strict.stderr


def test_workers_leave_with_their_parent(service: Service) -> None:
    workers = service.workers
    service.process.kill()
    service.process.wait(30)
    service.until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))


def test_a_map_that_cannot_be_opened_ends_the_service_with_its_message(folder: Path) -> None:
    (folder / "v0" / "manifest.json").write_text("{}")
    done = subprocess.run(
        [*COMMAND, str(folder), "--workers", "2", "--port", "0"],
        env={"PATH": ""},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert "manifest.json" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_port_that_is_taken_is_refused_though_workers_share_theirs(undisturbed: Service, folder: Path) -> None:
    port = undisturbed.url.rsplit(":", 1)[1]
    done = subprocess.run(
        [*COMMAND, str(folder), "--workers", "2", "--port", port],
        env={"PATH": ""},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert f"cannot listen on 127.0.0.1:{port}" in done.stderr
