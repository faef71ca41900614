"""README and docs: links lead somewhere, every code block runs or says why not, commands exist with their options."""

import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest
import typer
import yaml
from typer.main import get_command

from benchmarks.docs_blocks import PAGES, Block, blocks_of, commands_of, pages
from service.cli.main import app_for
from service.option_limits import FALSE_ACCEPT_RATE
from service.registration.points import PointSettings
from service.registration.register import RegistrationSettings
from service.retrieval.hypotheses import ClusterSettings
from service.retrieval.starts import StartSettings
from service.scoring.support import SupportWeights

ROOT = Path(__file__).parents[2]
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCKS = [block for page in pages() for block in blocks_of(page)]


def named(block: Block) -> str:
    return f"{block.page}:{block.line}"


def anchors_of(page: Path) -> set[str]:
    """As GitHub and mkdocs make them of headings."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL), re.MULTILINE
    )
    plain = [re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in headings]
    return {re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-") for text in plain}


def test_every_page_is_among_those_that_are_run_and_in_the_sites_contents() -> None:
    # Decisions hold no code, and their index leads to them.
    single = {page for page in TEXTS if not page.match("decisions/[0-9]*.md")}
    assert set(pages()) == single
    assert len(set(PAGES)) == len(PAGES)
    contents = re.findall(r": ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(ROOT / "docs" / page for page in contents) == sorted(single - {ROOT / "README.md"})


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.name)
def test_every_relative_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"(?<!`)!?\[[^\]]*\]\(([^)\s]+)\)", text):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        path, _, anchor = unquote(target).partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target}"
        assert file.is_relative_to(ROOT), f"{page.name}: {target} leaves the repository"
        if anchor:
            assert anchor in anchors_of(file), f"{page.name}: {target}"


def test_the_files_that_the_architecture_names_exist() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    named_files = re.findall(r"`([a-z0-9_/]+\.py)`", text)
    assert len(named_files) > 40
    folders = [
        ROOT / "service",
        ROOT / "service" / "scoring",
        ROOT / "service" / "localization",
        ROOT / "model_training",
    ]
    assert [name for name in named_files if not any((folder / name).is_file() for folder in folders)] == []
    of_service, of_training = (
        {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
        for package in ("service", "model_training")
    )
    assert of_service | of_training <= set(re.findall(r"`(\w+)`", text))


@pytest.mark.parametrize("block", [each for each in BLOCKS if each.kind in ("json", "yaml") and each.runs], ids=named)
def test_documents_parse(block: Block) -> None:
    assert json.loads(block.text) if block.kind == "json" else yaml.safe_load(block.text)


@pytest.mark.parametrize("block", [each for each in BLOCKS if each.kind == "python"], ids=named)
def test_python_compiles(block: Block) -> None:
    compile(block.text, named(block), "exec")


@pytest.mark.parametrize("block", [each for each in BLOCKS if each.kind == "sh"], ids=named)
def test_every_streetfix_command_exists_with_its_options(block: Block) -> None:
    for line in commands_of(block):
        words = shlex.split(line.replace("...", ""))
        while words and "=" in words[0]:
            words = words[1:]
        if words[:1] != ["streetfix"]:
            continue
        assert_known(words[1:], named(block))


def assert_known(words: list[str], where: str) -> None:
    command: typer.core.TyperGroup | object = get_command(app_for(words))
    while hasattr(command, "commands"):
        assert words, where
        assert words[0] in command.commands, f"{where}: no command {words[0]!r}"
        command, words = command.commands[words[0]], words[1:]
    options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}  # type: ignore[attr-defined]
    for word in words:
        if word in (">>", ">", "|", "&&"):
            break
        if word.startswith("--"):
            assert word.partition("=")[0] in options, f"{where}: no option {word}"


def test_an_option_that_does_not_exist_is_found() -> None:
    with pytest.raises(AssertionError, match="no option --colour"):
        assert_known(["evaluate", "maps/small", "--colour"], "here")
    with pytest.raises(AssertionError, match="no command 'fly'"):
        assert_known(["fly"], "here")


@pytest.mark.parametrize(
    ("text", "told"),
    [("```\nls\n```", "line 1: the fence says ''"), ("a\n\n```sh\nls", "line 3: the fence is not closed")],
)
def test_a_block_that_does_not_say_what_it_is_is_refused(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "page.md").write_text(text)
    with pytest.raises(ValueError, match=told):
        blocks_of(tmp_path / "page.md")


def test_marks_stand_right_above_their_fence(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text(
        "<!-- not run: why -->\n```sh\na\n```\n<!-- file: c.json -->\n```json\n{}\n```\n<!-- not run: x -->\n\n```sh\nb \\\n  c  # d\n```\n"
    )
    first, second, third = blocks_of(tmp_path / "page.md")
    assert (first.why_not, first.runs) == ("why", False)
    assert (second.file, second.runs) == ("c.json", True)
    assert (third.why_not, third.runs, commands_of(third)) == (None, True, ["b    c"])


def test_pictures_of_the_pages_are_small() -> None:
    sizes = {path.name: path.stat().st_size for path in (ROOT / "docs" / "pictures").iterdir()}
    assert {"street.png", "map.png", "demo.png"} <= set(sizes)
    assert max(sizes.values()) < 250_000


def test_the_site_builds_strictly_and_asks_no_other_host(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="mkdocs-material is in the dependency group `docs` of pyproject.toml")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "repository" / "openapi" / "openapi.json").is_file()
    for page in tmp_path.glob("*.html"):
        loaded = re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="(https?://[^"]+)"', page.read_text())
        assert loaded == [], page.name


def test_what_lies_outside_docs_is_linked_as_a_copy_and_a_folder_by_name() -> None:
    hooks = runpy.run_path(str(ROOT / "mkdocs_hooks.py"))
    text = "[card](../stock/CARD.md) [api](../openapi/openapi.json#x) [deploy](../deploy/) [here](maps.md)"
    assert hooks["on_page_markdown"](text) == (
        "[card](repository/stock/CARD.md.txt) [api](repository/openapi/openapi.json) `deploy/` [here](maps.md)"
    )


def test_how_it_works_tells_the_numbers_that_are_set() -> None:
    """Settings change, and so must the page that tells of them."""
    told = " ".join(re.sub(r"<!-- .*? -->", "", (ROOT / "docs" / "how_it_works.md").read_text()).split())
    registration, support = RegistrationSettings(), SupportWeights()
    structure = support.structure
    words = {5: "five", 6: "six", 8: "eight", 10: "ten", 11: "eleven"}
    for text in (
        f"Up to {StartSettings().most} hypotheses have {words[len(registration.offsets_m)]} starts each",
        f"A coarse stage registers {registration.coarse_points} points",
        f"A middle stage registers {registration.middle_points} points",
        f"The fine stage takes the {words[registration.refined]} most promising",
        f"thinned to {PointSettings().points:,} points",
        f"{support.inliers:g} inliers + {support.similarity:g} similarity + {support.likelihood:g} log likelihood",
        f"{structure.shared_edges:g} shared edges + {structure.upper_inliers:g} upper inliers + {structure.contrast:g} contrast",
        f"exp((s_v - s_max) / {ClusterSettings().temperature:g})",
        f"{100 * FALSE_ACCEPT_RATE:g} % by default",
    ):
        assert text in told
