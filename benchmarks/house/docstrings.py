"""Find public functions of the library whose docstrings are incomplete."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.report import ROOT

#: Packages that other code may call: the core and the client.
PACKAGES = (
    *("client", "confidence", "geometry", "imaging", "localization", "maps", "registration", "retrieval", "scoring"),
)
_ARRAY = re.compile(r"NDArray|Float\d|Int\d|Bool\[")
#: A shape such as "(N, 3)" or "(rows, columns)". With jaxtyping, the annotation gives the shape.
_SHAPE = re.compile(r"\([A-Za-z0-9_ ]+,[A-Za-z0-9_, ]*\)")
_JAXTYPING = re.compile(r"(?:Float|Int|UInt|Bool|Shaped|Num)\d*\[")
_FLOATS = re.compile(r"\bfloat\b|Float\d|NDArray")
#: How the text of an argument may write the unit that ends the argument's name.
_UNITS = {
    "m": re.compile(r"\bm\b|\bmet(?:re|er)s?\b"),
    "rad": re.compile(r"\brad\b|\bradians?\b"),
    "deg": re.compile(r"\bdegrees?\b"),
    "px": re.compile(r"\bpx\b|\bpixels?\b"),
    "s": re.compile(r"\bs\b|\bseconds?\b"),
    "ms": re.compile(r"\bms\b|\bmilliseconds?\b"),
}


@dataclass(frozen=True, slots=True)
class Lacking:
    """A public function and the part that its docstring lacks.

    Attributes:
        name: ``path:line name``.
        what: "docstring", "Args: NAME", "Raises", "shape" or "unit: NAME".
    """

    name: str
    what: str


def public_functions(package: str) -> Iterator[tuple[Path, ast.FunctionDef | ast.AsyncFunctionDef, bool]]:
    """Yield public functions, and methods of public classes, of a package of ``service``.

    Each item is the file, the function, and whether it is a method.

    Args:
        package: name of the package.
    """
    for path in sorted((ROOT / "service" / package).rglob("*.py")):
        if path.name.startswith("_") and path.name != "__init__.py":
            continue
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_"):
                yield path, node, False
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                for inner in node.body:
                    if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef) and not inner.name.startswith("_"):
                        yield path, inner, True


def lacking(function: ast.FunctionDef | ast.AsyncFunctionDef, *, is_method: bool) -> str | None:
    """Return the first part that a docstring lacks: itself, an argument, an error, a shape or a unit; None if complete.

    The text of a float or array argument must give the unit that ends its name, such as ``_m`` or ``_rad``.

    Args:
        function: a public function.
        is_method: whether its first argument is the instance.
    """
    text = ast.get_docstring(function)
    if text is None:
        return "docstring"
    given = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    given = given[1:] if is_method and not _is_static(function) else given
    for argument in given:
        if not re.search(rf"^\s+\*{{0,2}}{argument.arg}(?:, \w+)*:|^\s+(?:\w+, )*{argument.arg}:", text, re.MULTILINE):
            return f"Args: {argument.arg}"
    raises = any(isinstance(node, ast.Raise) and node.exc is not None for node in _own_nodes(function))
    if raises and "Raises:" not in text:
        return "Raises"
    annotations = [ast.unparse(a.annotation) for a in given if a.annotation is not None]
    annotations += [ast.unparse(function.returns)] if function.returns is not None else []
    for annotation in annotations:
        needs_shape = _ARRAY.search(annotation) and not _JAXTYPING.search(annotation)
        if needs_shape and not _SHAPE.search(text):
            return "shape"
    texts = _argument_texts(text)
    for argument in given:
        unit = _UNITS.get(argument.arg.rpartition("_")[2]) if "_" in argument.arg else None
        is_float = argument.annotation is not None and _FLOATS.search(ast.unparse(argument.annotation))
        if unit is not None and is_float and not unit.search(texts.get(argument.arg, "")):
            return f"unit: {argument.arg}"
    return None


def _argument_texts(docstring: str) -> dict[str, str]:
    """Return the text of each argument of a docstring, without its name and line breaks."""
    _, _, section = docstring.partition("Args:\n")
    section = re.split(r"^\S", section, maxsplit=1, flags=re.MULTILINE)[0]
    texts: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        if match := re.match(r" {4}(\*{0,2}\w+(?:, \w+)*): (.*)", line):
            names = [name.lstrip("*") for name in match[1].split(", ")]
            texts |= dict.fromkeys(names, match[2])
        else:
            texts |= {name: f"{texts[name]} {line.strip()}" for name in names}
    return texts


def all_lacking() -> tuple[list[Lacking], int]:
    """Return the public functions with incomplete docstrings, and the number of all public functions."""
    found, count = [], 0
    for package in PACKAGES:
        for path, function, is_method in public_functions(package):
            count += 1
            what = lacking(function, is_method=is_method)
            if what is not None:
                found.append(Lacking(f"{path.relative_to(ROOT)}:{function.lineno} {function.name}", what))
    return found, count


def code_lines(path: Path) -> int:
    """Count the lines of a module with code: no docstrings, no comments, no blank lines.

    Args:
        path: file of the module.
    """
    text = path.read_text()
    of_docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and ast.get_docstring(
            node
        ):
            first = node.body[0]
            of_docstrings.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    return sum(bool(line) and not line.startswith("#") and number not in of_docstrings for number, line in lines)


def _is_static(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any(isinstance(each, ast.Name) and each.id == "staticmethod" for each in function.decorator_list)


def _own_nodes(function: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a function without those of inner functions."""
    for node in ast.iter_child_nodes(function):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        yield node
        yield from _own_nodes(node)
