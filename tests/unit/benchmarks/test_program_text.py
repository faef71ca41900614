import pytest

from benchmarks.program_text import same_program

PYTHON = '''"""About the file."""
def area(side):
    """Return the area."""
    return side * side
'''
C = "int two(void) { return 2; } /* of two */\n#define HALF 0.5\n"


@pytest.mark.parametrize(
    ("name", "one", "other"),
    [
        ("a.py", PYTHON, "def area(side):\n    # a square\n    return (side\n            * side)\n"),
        ("a.py", PYTHON, PYTHON.replace("area.", "square.")),
        ("a.c", C, "int two(void)  { return 2; } // two\n\n  #define HALF 0.5 /* a half */\n"),
        ("a.h", "#define LONG 1 + \\\n  2\n", "#define LONG 1 +   2\n"),
        ("a.json", "{}", "{}"),
    ],
)
def test_comments_docstrings_and_layout_do_not_change_a_program(name, one, other):
    assert same_program(name, one, other)


@pytest.mark.parametrize(
    ("name", "one", "other"),
    [
        ("a.py", PYTHON, PYTHON.replace("side * side", "side + side")),
        ("a.py", PYTHON, PYTHON.replace("return", "yield")),
        ("a.py", 'A = "one"\n', 'A = "two"\n'),
        ("a.py", "a = (", "a = ( "),  # does not parse
        ("a.c", C, C.replace("2;", "3;")),
        ("a.c", C, C.replace("\n#", " #")),  # the directive is gone
        ("a.c", 'char *a = "// one";\n', 'char *a = "// two";\n'),  # not a comment
        ("a.json", "{}", "{} "),
    ],
)
def test_other_differences_change_it(name, one, other):
    assert not same_program(name, one, other)
