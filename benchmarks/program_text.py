"""Whether two versions of a source file are the same program, so that only comments, docstrings or layout differ."""

import ast
import re

#: Endings of the files that are compared as programs.
PROGRAMS = (".py", ".pyi", ".c", ".h")
#: Comments, string literals and character literals of C. The literals are here so that a comment mark inside them is no comment.
_C_TOKEN = re.compile(r"//[^\n]*|/\*.*?\*/|\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\])*'", re.DOTALL)


def same_program(name: str, one: str, other: str) -> bool:
    """Return whether two versions of a file are the same program.

    Python and C are compared without comments, docstrings and layout. Versions of any other file must be equal. A Python version
    that does not parse equals only itself.

    Args:
        name: name of the file; its ending names the language.
        one: text of one version.
        other: text of the other version.
    """
    if one == other:
        return True
    if name.endswith((".py", ".pyi")):
        try:
            return _python(one) == _python(other)
        except (SyntaxError, ValueError):
            return False
    return name.endswith(PROGRAMS) and _c(one) == _c(other)


def _python(text: str) -> str:
    """Return the syntax tree without docstrings as text."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
    return ast.dump(tree)


def _c(text: str) -> list[str]:
    """Return the lines without comments and without superfluous space. A line end counts: it ends a preprocessor directive."""
    bare = _C_TOKEN.sub(lambda found: " " if found[0].startswith(("//", "/*")) else found[0], text.replace("\\\n", " "))
    return [" ".join(line.split()) for line in bare.splitlines() if line.strip()]
