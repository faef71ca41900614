import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import provenance
from benchmarks.provenance import (
    BAG_IMPORT,
    MEASURED,
    NOT_RUN,
    OPTIONS_OF_IMPORTS,
    ROOT,
    TILED_AND_STORED,
    mark_stale,
    measured_paths,
)
from model_training.calibration.answer_code import code_of_answers
from service.maps import inverted_file

REPORTS = sorted((ROOT / "reports").glob("*.json"))
IMPORTING = ROOT / "model_training" / "importing"


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository with three commits: the second changes the map code, the third a document."""
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    monkeypatch.setitem(MEASURED, "mine", {"": ("service/maps",), "all.": ("service", "docs")})
    provenance._changed_files.cache_clear()

    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        done = subprocess.run(["git", *identity, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    def commit(file, text):
        path = tmp_path / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        git("add", ".")
        git("commit", "-qm", file)
        return git("rev-parse", "HEAD")

    git("init", "-q")
    yield [commit("service/maps/a.py", "1"), commit("service/maps/a.py", "2"), commit("docs/a.md", "3")], commit
    provenance._changed_files.cache_clear()


def ages(commits, head, *row_ids):
    rows = [{"id": row_id, "run": commit} for commit in commits for row_id in row_ids]
    mark_stale("mine", rows, {commit: {"commit": commit} for commit in commits}, head)
    return [row.get("stale") for row in rows]


def test_a_row_is_stale_where_code_that_it_measures_has_changed_since(repository):
    (first, second, third), _ = repository
    assert ages([first, second, third], third, "map") == [True, None, None]
    assert ages([first, second, third], third, "all.map") == [True, True, None]


def test_a_file_that_no_row_of_the_report_runs_does_not_count(repository, monkeypatch):
    (_, _, third), commit = repository
    monkeypatch.setitem(NOT_RUN, "mine", ("service/maps/store", "service/maps/tiles.py"))
    head = [commit(f"service/maps/{name}", "1") for name in ("store/cache.py", "tiles.py")][-1]
    assert ages([third], head, "map") == [None]
    assert ages([third], commit("service/maps/tiles.pyi", "1"), "map") == [True]


def test_a_file_that_only_some_rows_run_counts_for_these(repository, monkeypatch):
    (_, _, third), commit = repository
    monkeypatch.setitem(provenance.ONLY_RUN_BY, "mine", {"service/maps/track.py": ("track.",)})
    monkeypatch.setitem(MEASURED["mine"], "track.", ("service/maps",))
    assert ages([third], commit("service/maps/track.py", "1"), "map", "track.a") == [None, True]


def test_code_that_was_changed_back_is_the_same(repository):
    (first, _, _), commit = repository
    assert ages([first], commit("service/maps/a.py", "1"), "map") == [None]


def test_comments_docstrings_and_layout_count_only_for_rows_that_measure_text(repository, monkeypatch):
    _, commit = repository
    monkeypatch.setitem(provenance.TEXT, "mine", ("all.",))
    before = commit("service/maps/a.py", 'def a():\n    """Return one."""\n    return 1\n')
    assert ages([before], commit("service/maps/a.py", "def a():\n    return 1  # one\n"), "map", "all.map") == [
        None,
        True,
    ]
    assert ages([before], commit("service/maps/a.py", "def a():\n    return 2\n"), "map") == [True]


def test_a_comment_changes_no_program_and_a_statement_does(repository):
    _, commit = repository
    before = commit("service/maps/kernel.c", "int a = 1; // one\n")
    commented = commit("service/maps/kernel.c", "int a = 1; /* 1 */\n")
    assert provenance.changed_programs(before, commented) == []
    assert provenance.changed_programs(before, commit("service/maps/kernel.c", "int a = 2;\n")) == [
        "service/maps/kernel.c"
    ]
    assert provenance.changed_programs("f" * 40, commented) is None


def test_a_new_or_missing_file_counts(repository):
    (_, _, third), commit = repository
    head = commit("service/maps/new.py", "")
    assert ages([third], head, "map") == [True]
    assert ages([head], third, "map") == [True]


def test_a_stale_mark_is_removed_from_a_row_that_is_measured_again(repository):
    (_, second, third), _ = repository
    row = {"id": "map", "run": "r", "stale": True}
    mark_stale("mine", [row], {"r": {"commit": second}}, third)
    assert "stale" not in row


def test_a_check_that_answers_are_equal_connects_two_versions(repository, tmp_path, monkeypatch):
    """Rows of the first version stay valid over checked changes. Other rows, and later changes, are stale as before."""
    (first, second, third), commit = repository
    checks = tmp_path / "checks.json"
    monkeypatch.setattr(provenance, "CHECKS", checks)
    fourth = commit("service/maps/a.py", "4")
    covered, but_not = {"mine": ["map."]}, {"mine": ["map.frames"]}

    def checked(*pairs):
        kept = [{"before": one, "after": other, "covered": covered, "not_covered": but_not} for one, other in pairs]
        checks.write_text(json.dumps(kept))
        return ages([first], fourth, "map.a", "other")

    assert checked((first, second)) == [True, True]  # the change after the check is not compared
    assert checked((third, fourth)) == [True, True]  # nor is the one before it
    assert checked((first, second), (third, fourth)) == ["same answers", True]
    assert checked((first, fourth)) == ["same answers", True]
    assert ages([first], fourth, "map.frames") == [True]
    covered["mine"], covered["another"] = ["all."], ["map."]
    assert checked((first, fourth)) == [True, True]


def test_without_git_the_age_is_unknown(repository, tmp_path, monkeypatch):
    (first, _, third), _ = repository
    assert ages(["0" * 40], third, "map") == ["unknown"]
    monkeypatch.setenv("PATH", "")
    provenance._changed_files.cache_clear()
    assert provenance.head_commit() == ""
    assert ages([first], third, "map") == ["unknown"]
    assert ages([first], "", "map") == ["unknown"]


def test_git_is_asked_once_for_a_commit(repository, monkeypatch):
    (first, _, third), _ = repository
    asked = []
    monkeypatch.setattr(provenance, "git", lambda *arguments: asked.append(arguments) or "")
    ages([first], third, *(f"row{number}" for number in range(50)))
    assert [each[0] for each in asked] == ["diff"]


def test_every_report_says_what_its_rows_measure_and_that_is_there():
    assert set(MEASURED) == {path.stem for path in REPORTS}
    for groups in MEASURED.values():
        assert "" in groups
        for path in {path for paths in groups.values() for path in paths}:
            assert (ROOT / path).exists(), path


#: Loads each benchmark in a fork of one process, which has loaded the large packages.
_LOADS = """
import importlib, os, sys
import matplotlib.pyplot, scipy.spatial, torch
for module in sys.argv[1:]:
    if os.fork() == 0:
        importlib.import_module(module)
        print(module, *(getattr(m, "__file__", None) for m in sys.modules.values()), sep="\\t", flush=True)
        os._exit(0)
    assert os.wait()[1] == 0, module
"""


@pytest.fixture(scope="module")
def loaded():
    """Return the files that each benchmark loads, by report."""
    modules = {}
    for report in NOT_RUN:
        name = {"real_data": "real"}.get(report, report)
        modules[report] = f"benchmarks.{name}" + (".__main__" if (ROOT / "benchmarks" / name).is_dir() else "")
    command = [sys.executable, "-c", _LOADS, *modules.values()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = [line.split("\t") for line in done.stdout.splitlines()]
    files = {module: {Path(file) for file in loaded} for module, *loaded in lines}
    return {report: files[module] for report, module in modules.items()}


@pytest.mark.parametrize("report", NOT_RUN)
def test_a_benchmark_does_not_load_what_it_claims_not_to_run(loaded, report):
    files = loaded[report]
    assert ROOT / "model_training" / "mapping" / "build.py" in files
    for path in {*NOT_RUN[report], *TILED_AND_STORED}:
        assert (ROOT / path).exists(), path
        assert not [each for each in files if each.is_relative_to(ROOT / path)], path


@pytest.mark.parametrize("report", ["accuracy", "kitti", "real_data"])
def test_only_rows_that_import_a_bag_depend_on_its_import(loaded, report):
    """``open_recording`` loads these files for a bag alone. So loading a benchmark loads none of them."""
    assert set(BAG_IMPORT) == {f"model_training/importing/{file.name}" for file in IMPORTING.glob("ros_*.py")}
    assert any(file.is_relative_to(IMPORTING) for file in loaded[report])
    for path in (*BAG_IMPORT, *OPTIONS_OF_IMPORTS):
        assert (ROOT / path).exists(), path
        assert ROOT / path not in loaded[report], path
    assert {provenance.ONLY_RUN_BY[report][path] for path in OPTIONS_OF_IMPORTS} == {()}
    rows = {rows for file, rows in provenance.ONLY_RUN_BY[report].items() if file in BAG_IMPORT}
    of_bags = ("import.", "roundtrip.bag.", "roundtrip.mcap.") if report == "real_data" else ()
    assert rows == {of_bags}
    ids = [row["id"] for row in json.loads((ROOT / "reports" / f"{report}.json").read_text())["rows"]]
    assert {beginning for beginning in of_bags if any(row_id.startswith(beginning) for row_id in ids)} == set(of_bags)


def test_the_maps_of_accuracy_rows_have_no_search_index():
    """Their rows do not depend on the code of the index. With a smaller limit they would."""
    assert inverted_file.SMALLEST >= provenance.MOST_VIEWS


def test_the_commit_of_a_version_of_the_code_is_found(tmp_path, monkeypatch):
    """The search goes back from the head. A change of other files does not matter."""
    monkeypatch.setattr(provenance, "ROOT", tmp_path)

    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        done = subprocess.run(["git", *identity, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    def commit(file, text):
        path = tmp_path / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        git("add", ".")
        git("commit", "-qm", file)
        code_of_answers.cache_clear()
        return git("rev-parse", "HEAD"), code_of_answers(tmp_path)

    git("init", "-q")
    (first, one), (second, two) = commit("service/maps/a.py", "1"), commit("service/maps/a.py", "2")
    (third, same) = commit("docs/a.md", "3")
    assert one != two == same
    assert provenance.commit_with_code(one) == first
    assert provenance.commit_with_code(two) in (second, third)
    assert provenance.commit_with_code("0" * 16) is None
    code_of_answers.cache_clear()


def test_only_rows_of_single_stages_depend_on_their_code():
    (rows,) = (each for file, each in provenance.ONLY_RUN_BY["real_data"].items() if file == provenance.STAGES)
    told = json.loads((ROOT / "reports" / "real_data.json").read_text())
    ids = {row["id"] for row in told["rows"] if row["id"].startswith(rows)}
    names = ("retrieval_at_1_5m", "inliers_at_truth", "inliers_from_truth")
    assert {f"real.kitti_{drive}.{name}" for drive in ("0005", "0013") for name in names} <= ids


def test_the_longest_beginning_says_what_a_row_measures():
    assert "model_training/importing" in measured_paths("accuracy", "real.kitti_stereo.recall_at_1")
    assert "model_training/importing" not in measured_paths("accuracy", "full.unseen")
    assert measured_paths("a report that is new", "a") == ("streetfix", "service", "model_training", "native")


@pytest.mark.parametrize("path", REPORTS, ids=lambda path: path.stem)
def test_every_row_of_a_committed_report_names_its_run_and_every_run_is_named(path: Path):
    told = json.loads(path.read_text())
    assert {row["run"] for row in told["rows"]} == set(told["runs"])
    ids = [row["id"] for row in told["rows"]]
    assert len(ids) == len(set(ids))
    for run in told["runs"].values():
        assert len(run["commit"]) == 40
        assert run["command"]
        assert run["date"] or run["before"]
        assert {"dirty", "machine"} <= set(run)
