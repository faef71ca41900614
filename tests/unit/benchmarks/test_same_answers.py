import json
import runpy
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from benchmarks import same_answers
from benchmarks.same_answers import DifferentAnswersError, Version, compare, main


def written(folder, *, cloud="aa", status="LOCALIZED", ms=1.0, confidence=np.nan, sets=("drive1",), **more):
    (folder / "map").mkdir(parents=True)
    (folder / "map" / "manifest.json").write_text(json.dumps({"files": {"cloud": {"sha256": cloud}}}))
    (folder / "answers").mkdir()
    for name in sets:
        fields: dict[str, Any] = {
            "T_true": np.zeros((2, 4, 4)),
            "status": np.array([status, ""]),
            "confidence": np.array([confidence, 0.5]),
        }
        np.savez(folder / "answers" / f"{name}.npz", ms=np.full(2, ms), **fields, **more)
    return folder


def test_equal_answers_are_counted_and_durations_do_not_matter(tmp_path):
    one = written(tmp_path / "a" / "city", sets=("drive1", "drive2"))
    assert compare(one, written(tmp_path / "b" / "city", ms=2.0, sets=("drive1", "drive2"))) == 4


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"cloud": "bb"}, "city: the map's file cloud differs"),
        ({"status": "AMBIGUOUS"}, "city/answers/drive1.npz: status differs"),
        ({"confidence": 0.1}, "city/answers/drive1.npz: confidence differs"),
        ({"sets": ("drive2",)}, "city: query sets"),
        ({"sets": ()}, "city: query sets"),
        ({"candidates": np.zeros(2)}, r"city/answers/drive1.npz: fields \['candidates'\]"),
    ],
)
def test_the_first_difference_is_named(tmp_path, change, what):
    with pytest.raises(DifferentAnswersError, match=what):
        compare(written(tmp_path / "a" / "city"), written(tmp_path / "b" / "city", **change))


def test_answers_that_a_change_alters_on_purpose_are_left_out_and_their_rows_are_not_covered(tmp_path):
    one = written(tmp_path / "a" / "city", sets=("single", "right_prior"))
    other = written(tmp_path / "b" / "city", sets=("single", "right_prior"))
    np.savez(other / "answers" / "right_prior.npz", T_true=np.zeros((2, 4, 4)), status=np.array(["", ""]))
    with pytest.raises(DifferentAnswersError, match="right_prior"):
        compare(one, other)
    files, rows = same_answers.CHANGED["priors"]
    assert compare(one, other, files) == 2
    found = same_answers.record("a", "b", {"city": 2}, "priors")["not_covered"]
    assert found["accuracy"] == ["survey.two_passes_", "prior."]
    assert set(rows["real_data"]) < set(found["real_data"])
    assert same_answers.record("a", "b", {"city": 2})["not_covered"]["accuracy"] == ["survey.two_passes_"]


def test_a_number_that_differs_in_its_last_bit_differs(tmp_path):
    with pytest.raises(DifferentAnswersError, match="confidence"):
        compare(
            written(tmp_path / "a" / "city", confidence=0.1),
            written(tmp_path / "b" / "city", confidence=np.nextafter(0.1, 1)),
        )


def test_a_version_runs_its_own_code_only(tmp_path):
    """Without its own packages the installed code would run, and the check would compare it with itself."""
    with pytest.raises(subprocess.CalledProcessError):
        Version(tmp_path, tmp_path / "work").run("--help")


def test_both_versions_run_the_program_of_several_frames(tmp_path, monkeypatch):
    """The program is a text that starts with the code of a version. It writes answers, which are compared."""
    started: list[list[str]] = []
    monkeypatch.setattr(subprocess, "run", lambda command, **_: started.append(command))
    folder = Version(tmp_path, tmp_path / "work").answers_of_frames()
    (command,) = started
    assert command[-1] == str(folder)
    assert folder.is_dir()
    assert "root = pathlib.Path" in command[2]
    assert "def right_prior" in command[2]


def test_changes_that_are_not_committed_are_refused(monkeypatch, capsys):
    monkeypatch.setattr(same_answers, "is_dirty", lambda: True)
    with pytest.raises(SystemExit):
        main(["--before", "HEAD"])
    assert "commit first" in capsys.readouterr().err


def test_an_unknown_commit_is_refused(monkeypatch, capsys):
    answers = {"rev-parse": "f" * 40, "cat-file": None, "worktree": ""}
    monkeypatch.setattr(same_answers, "is_dirty", lambda: False)
    monkeypatch.setattr(same_answers, "git", lambda command, *_: answers[command])
    with pytest.raises(SystemExit):
        main(["--before", "HEAD"])
    assert "is not a commit" in capsys.readouterr().err


@pytest.mark.parametrize("changed", ["service/a.py", "service/a.c", "native/CMakeLists.txt"])
def test_other_c_code_is_compiled_and_equal_c_code_is_copied(tmp_path, monkeypatch, changed):
    """The stand-in of CMake writes down its arguments, and the repository has one library."""
    root, tree = tmp_path / "root", tmp_path / "tree"
    for folder in (root / "service", tree / "service", tmp_path / "bin"):
        folder.mkdir(parents=True)
    (root / "service" / "_a.so").write_bytes(b"compiled")
    cmake, log = tmp_path / "bin" / "cmake", tmp_path / "log"
    cmake.write_text(f"#!/bin/sh\necho $@ >> {log}\n")
    cmake.chmod(0o755)
    monkeypatch.setattr(same_answers, "ROOT", root)
    monkeypatch.setattr(same_answers, "git", lambda *_: "")
    monkeypatch.setattr(same_answers, "changed_programs", lambda _: [changed])
    monkeypatch.setattr("sys.executable", str(tmp_path / "bin" / "python"))
    same_answers.work_tree("f" * 40, tree)
    assert (tree / "service" / "_a.so").exists() == (not log.exists()) == (changed == "service/a.py")
    if log.exists():
        configure, build = log.read_text().splitlines()
        assert configure.startswith(f"-S {tree}/native -B {tree}/build/same_answers")
        assert build == f"--build {tree}/build/same_answers"


def test_a_difference_fails_and_leaves_no_record(tmp_path, monkeypatch, capsys):
    """Both versions are folders that were written before; git and streetfix do not run."""
    found = {"before": written(tmp_path / "before" / "city"), "after": written(tmp_path / "after" / "city", cloud="bb")}
    checks = tmp_path / "checks" / "same_answers.json"
    monkeypatch.setattr(same_answers, "ROOT", tmp_path)
    monkeypatch.setattr(same_answers, "CHECKS", checks)
    monkeypatch.setattr(same_answers, "is_dirty", lambda: False)
    monkeypatch.setattr(same_answers, "git", lambda *_: "f" * 40)
    monkeypatch.setattr(same_answers, "work_tree", lambda *_: None)
    monkeypatch.setattr(same_answers, "head_commit", lambda: "e" * 40)
    monkeypatch.setattr(same_answers, "SIMULATED", same_answers.SIMULATED[:1])
    monkeypatch.setattr(Version, "answers", lambda version, *_: found[version.work.name.removeprefix("answers_")])
    monkeypatch.setattr(Version, "answers_of_frames", lambda _: found["before"])
    arguments = ["--before", "HEAD", "--data", str(tmp_path)]
    assert main(arguments) == 1
    assert "the map's file cloud differs" in capsys.readouterr().out
    assert not checks.exists()
    found["after"] = found["before"]
    assert main(arguments) == 0
    (kept,) = json.loads(checks.read_text())
    assert (kept["before"], kept["after"], kept["queries"]) == ("f" * 40, "e" * 40, {"city": 2, "frames": 2})


def test_a_commit_during_the_check_leaves_no_record(tmp_path, monkeypatch, capsys):
    """The record would name code that was not compared."""
    commits, names = iter(["e" * 40, "d" * 40]), iter(["one", "other"])
    monkeypatch.setattr(same_answers, "CHECKS", tmp_path / "same_answers.json")
    monkeypatch.setattr(same_answers, "is_dirty", lambda: False)
    monkeypatch.setattr(same_answers, "git", lambda *_: "f" * 40)
    monkeypatch.setattr(same_answers, "head_commit", lambda: next(commits))
    monkeypatch.setattr(same_answers, "work_tree", lambda *_: None)
    monkeypatch.setattr(same_answers, "SIMULATED", ())
    monkeypatch.setattr(Version, "answers_of_frames", lambda _: written(tmp_path / "frames" / next(names)))
    assert main(["--before", "HEAD", "--data", str(tmp_path)]) == 1
    assert "start it again" in capsys.readouterr().out
    assert not (tmp_path / "same_answers.json").exists()


def test_the_command_has_help(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["same_answers", "--help"])
    monkeypatch.delitem(sys.modules, "benchmarks.same_answers")  # run as a program, it is not a module of the others
    with pytest.raises(SystemExit) as end:
        runpy.run_module("benchmarks.same_answers", run_name="__main__")
    assert end.value.code == 0
    assert "Example:" in capsys.readouterr().out
