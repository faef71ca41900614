"""The hash that names a version of the code."""

import subprocess
from pathlib import Path

from model_training.calibration.answer_code import CODE, ENDINGS, code_of_answers, hash_of


def write(root, name, text):
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_a_changed_source_file_changes_the_hash_and_another_file_does_not(tmp_path):
    def code():
        code_of_answers.cache_clear()
        return code_of_answers(tmp_path)

    write(tmp_path, "service/maps/a.py", "1")
    first = code()
    write(tmp_path, "service/maps/a.so", "built")
    write(tmp_path, "service/http/a.py", "of no answer")
    write(tmp_path, "model_training/calibration/fit.py", "of no answer")
    assert code() == first
    write(tmp_path, "model_training/calibration/rigs.py", "1")
    second = code()
    write(tmp_path, "service/maps/a.py", "2")
    assert len({first, second, code()}) == 3
    code_of_answers.cache_clear()


def test_the_hash_is_that_of_gits_tree(tmp_path):
    """So a commit with these files can be found."""
    write(tmp_path, "service/maps/a.py", "x = 1\n")
    write(tmp_path, "service/maps/b.c", "int x;\n")
    write(tmp_path, "service/maps/b.txt", "no code")
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    subprocess.run(["git", "add", "."], cwd=tmp_path, check=True)
    listed = subprocess.run(
        ["git", "ls-files", "--stage"], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    files = [(line.split("\t")[1], line.split()[1]) for line in listed]
    assert {path.rsplit(".", 1)[1] for path, _ in files} == {"py", "c", "txt"}
    assert hash_of(files) == code_of_answers(tmp_path)
    assert ".txt" not in ENDINGS


def test_all_parts_of_the_code_exist():
    root = Path(__file__).parents[3]
    assert all((root / name).exists() for name in CODE)
