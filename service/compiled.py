"""Loads the libraries that the build compiled from the C files beside their Python modules.

Structures that C and Python share are declared on both sides. A library that was built from other sources would read wrong memory, so
each library says how its structs lie (``layout.h``), and the loader compares.
"""

import ctypes
from collections.abc import Mapping
from ctypes import POINTER, Structure, c_char_p, c_int64
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import StreetfixError
from service.platforms import require_supported

require_supported()

#: A structure that C shares: its ctypes declaration, or the dtype of the arrays that hold it.
Declaration = type[Structure] | np.dtype[Any]


class _LayoutEntry(Structure):
    """``LayoutEntry`` of ``layout.h``."""

    _fields_ = [("name", c_char_p), ("offset", c_int64), ("value", c_int64)]


def load(
    path: Path, structures: Mapping[str, Declaration] | None = None, constants: Mapping[str, int] | None = None
) -> ctypes.CDLL:
    """Load a library; its functions run without Python's lock.

    Args:
        path: of the library.
        structures: that its functions take, by their names in C. Fields have the same names in C and in Python.
        constants: that both sides define, by their names in C.

    Raises:
        StreetfixError: it was not compiled, or a structure lies otherwise in C than in Python.
    """
    if not path.exists():
        raise StreetfixError(
            f"{path.name} is missing beside its source in {path.parent}: install the package again (pip install .)"
        )
    library = ctypes.CDLL(str(path))
    if structures or constants:
        _compare(path, compiled_layout(library), structures or {}, constants or {})
    return library


def compiled_layout(library: ctypes.CDLL) -> dict[str, tuple[int, int]]:
    """Offset and size (bytes) of each struct and of each field (``Struct.field``); 0 and the value of each constant."""
    try:
        first = _LayoutEntry.in_dll(library, "streetfix_layout")
    except ValueError:  # of a release before layouts were compared
        return {}
    entry = ctypes.cast(ctypes.addressof(first), POINTER(_LayoutEntry))
    found: dict[str, tuple[int, int]] = {}
    number = 0
    while entry[number].name is not None:
        found[entry[number].name.decode()] = (entry[number].offset, entry[number].value)
        number += 1
    return found


def declared_layout(name: str, declaration: Declaration) -> dict[str, tuple[int, int]]:
    """What ``compiled_layout`` must say of a structure that Python declares so."""
    if isinstance(declaration, np.dtype):
        fields = {field: (int(at[1]), at[0].itemsize) for field, at in (declaration.fields or {}).items()}
        size = declaration.itemsize
    else:
        names = [field[0] for field in declaration._fields_]
        fields = {field: (getattr(declaration, field).offset, getattr(declaration, field).size) for field in names}
        size = ctypes.sizeof(declaration)
    return {name: (0, size)} | {f"{name}.{field}": at for field, at in fields.items()}


def _compare(
    path: Path,
    compiled: dict[str, tuple[int, int]],
    structures: Mapping[str, Declaration],
    constants: Mapping[str, int],
) -> None:
    declared = {constant: (0, value) for constant, value in constants.items()}
    for name, declaration in structures.items():
        declared |= declared_layout(name, declaration)
    compiled_entries = {
        entry: at for entry, at in compiled.items() if entry in declared or entry.partition(".")[0] in structures
    }
    for entry in sorted(declared.keys() | compiled_entries.keys()):
        in_python, in_c = declared.get(entry), compiled_entries.get(entry)
        if in_python != in_c:
            raise StreetfixError(
                f"{path.name} was not compiled from the C files of this release: {entry} is {_shown(in_c)} in C and "
                f"{_shown(in_python)} in Python; install the package again (pip install .)"
            )


def _shown(at: tuple[int, int] | None) -> str:
    return "not there" if at is None else f"(offset {at[0]}, size {at[1]})"
