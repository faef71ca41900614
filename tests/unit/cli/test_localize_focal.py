"""``localize`` and ``evaluate`` report a focal length that is wrong by a factor of two."""

import json
import re
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from model_training.datasets.dataset import Dataset
from service.cli.main import main
from service.http.app import create_app
from service.runtime.engine import Engine
from service.runtime.settings import Settings


@pytest.fixture(scope="module")
def url(stock_map: Path) -> Iterator[str]:
    engine = Engine.open(Settings(maps=(stock_map,), threads=1))
    server = uvicorn.Server(uvicorn.Config(create_app(engine), port=0, log_config=None, lifespan="off"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()
    engine.close()


@pytest.fixture
def ask(url: str, small_dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Return the output for a query of the small dataset with a camera file that has a wrong focal length."""

    def asked(*flags: str, focal: float, query: int) -> str:
        frame = list(small_dataset.queries("drive1_precise"))[query]
        document = frame.request()
        document["camera"] |= {name: focal * document["camera"][name] for name in ("fx", "fy")}
        camera = tmp_path / "camera.json"
        camera.write_text(json.dumps(document))
        given = ["--rgb", str(frame.rgb_path), "--depth", str(frame.depth_path), "--camera", str(camera)]
        with pytest.raises(SystemExit) as end:
            main(["localize", "--url", url, *given, *flags])
        assert end.value.code in (0, 3, None)
        captured = capsys.readouterr()
        assert captured.err == ""
        return captured.out

    return asked


@pytest.mark.parametrize("query", [0, 1, 3, 4])
@pytest.mark.parametrize(("focal", "factor"), [(2.0, 0.5), (0.5, 2.0)])
def test_a_focal_length_off_by_a_factor_of_two_is_named_first(
    ask: Any, focal: float, factor: float, query: int
) -> None:
    """Also if the wrong answer is accepted: the ground then seems to be 3 m below the camera (decision 0145)."""
    lines = ask(focal=focal, query=query).splitlines()
    named = f"the focal length is probably off by a factor of two: fx and fy times {factor:g} "
    if lines[0].split()[1] == "LOCALIZED":
        assert any(line.startswith(f"warning: {named}") for line in lines)
    else:
        why = next(k for k, line in enumerate(lines) if line.startswith("why it may not be LOCALIZED"))
        assert lines[why + 1].startswith(f"  1. {named}")
    assert json.loads(ask("--json", focal=focal, query=query))["focal_length_factor"] == factor


@pytest.mark.parametrize("query", range(5))  # some are LOCALIZED, so nothing is tried
def test_a_right_focal_length_is_not_suspected(ask: Any, query: int) -> None:
    assert json.loads(ask("--json", focal=1.0, query=query)).get("focal_length_factor") is None
    assert "focal length" not in ask(focal=1.0, query=query)


@pytest.mark.parametrize(("focal", "factor"), [(2.0, 0.5), (0.5, 2.0)])
def test_evaluate_names_it_too(
    stock_map: Path,
    small_dataset: Dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    focal: float,
    factor: float,
) -> None:
    folder = shutil.copytree(small_dataset.folder, tmp_path / "told_wrong")
    description = json.loads((folder / "dataset.json").read_text())
    for camera in description["sensors"]["cameras"]:
        camera["fx"], camera["fy"] = camera["fx"] * focal, camera["fy"] * focal
    (folder / "dataset.json").write_text(json.dumps(description))
    with pytest.raises(SystemExit) as end:
        main(["evaluate", str(stock_map), str(folder), "--queries", "drive1_precise", "--list", "0"])
    assert end.value.code in (0, None)
    lines = capsys.readouterr().out.splitlines()
    few = re.compile(r"drive1_precise: \d+% of the answers are accepted\. What to check, the likeliest first:")
    start = next(number for number, line in enumerate(lines) if few.fullmatch(line))
    assert lines[start + 1].startswith(
        f"  1. the focal length is off by a factor of two: fx and fy times {factor:g} fit"
    )
