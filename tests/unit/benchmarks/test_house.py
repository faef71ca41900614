"""Figures of ``make house`` for texts with values that we computed by hand."""

import ast

import pytest

from benchmarks.house.docstrings import code_lines, lacking
from benchmarks.house.installation import distributions_of
from benchmarks.house.prose import prose_of_docstrings, prose_of_markdown, reading_ease


def test_prose_of_a_page_has_no_code_tables_headings_or_comments():
    text = """# A title

The service *answers* a [query](api.md). <!-- figure: x y z -->3<!-- /figure --> maps are `loaded`.

| a | table |
|---|---|

```sh
streetfix serve
```

- an item
- another one.
"""
    assert prose_of_markdown(text).split("\n") == ["The service answers a query. maps are.", "an item.", "another one."]


def test_prose_of_docstrings_takes_each_argument_for_a_sentence():
    source = '''
def f(a, b):
    """Add two numbers.

    Args:
        a: the first number.
        b: the second one, ``b > 0``.
    """
'''
    assert prose_of_docstrings(source).split("\n") == ["Add two numbers.", "the first number.", "the second one."]


def test_reading_ease_is_flesch_s_formula():
    pytest.importorskip("textstat", reason="`make house` installs it")
    # six words, six syllables, one sentence
    assert reading_ease("The cat sat on the mat.") == pytest.approx(206.835 - 1.015 * 6 - 84.6, abs=0.01)
    with pytest.raises(ValueError, match="no word"):
        reading_ease("1 2 3")


@pytest.mark.parametrize(
    ("source", "missing"),
    [
        ("def f(): pass", "docstring"),
        ('def f(a):\n    """Do it."""', "Args: a"),
        ('def f(a):\n    """Do it.\n\n    Args:\n        a: metres.\n    """', None),
        ('def f(a_m: float):\n    """Do it.\n\n    Args:\n        a_m: radius.\n    """', "unit: a_m"),
        ('def f(a_m: float):\n    """Do it.\n\n    Args:\n        a_m: radius, m.\n    """', None),
        ('def f(a_m: float):\n    """Do it.\n\n    Args:\n        a_m: radius\n            in metres.\n    """', None),
        ('def f(a_s: str):\n    """Do it.\n\n    Args:\n        a_s: text.\n    """', None),
        (
            'def f(a_s: float):\n    """Do it.\n\n    Args:\n        a_s: it.\n\n    Returns:\n        s.\n    """',
            "unit: a_s",
        ),
        ('def f():\n    """Do it."""\n    raise ValueError("x")', "Raises"),
        ('def f():\n    """Do it."""\n    def g():\n        raise ValueError("x")', None),
        ('def f() -> NDArray[np.float64]:\n    """Points."""', "shape"),
        ('def f() -> NDArray[np.float64]:\n    """Points (N, 3)."""', None),
        ('def f() -> Float64[NDArray[np.float64], "N 3"]:\n    """Points."""', None),
    ],
)
def test_missing_parts_of_a_docstring_are_found(source, missing):
    assert lacking(ast.parse(source).body[0], is_method=False) == missing


def test_the_instance_is_no_argument():
    (kind,) = ast.parse('class C:\n    def f(self):\n        """Do it."""').body
    assert isinstance(kind, ast.ClassDef)
    (function,) = kind.body
    assert isinstance(function, ast.FunctionDef)
    assert lacking(function, is_method=True) is None


def test_lines_of_code_are_without_docstrings_comments_and_blank_lines(tmp_path):
    path = tmp_path / "module.py"
    path.write_text('"""Two\nlines."""\n\nx = 1  # one\n\n\ndef f():\n    """Do it."""\n    # why\n    return x\n')
    assert code_lines(path) == 3


def test_an_installation_brings_requirements_of_requirements_and_of_extras():
    found = distributions_of(["httpx>=0.27"])
    assert {"httpx", "httpcore", "h11", "anyio"} <= found
    assert "h2" not in found  # of an extra that nobody asked for
    assert "lazrs" in distributions_of(["laspy[lazrs]"])
