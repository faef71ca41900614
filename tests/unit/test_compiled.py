"""The loader of the compiled libraries: C and Python must declare shared structures equally."""

import ctypes
import re
from ctypes import Structure, c_double, c_float, c_int64
from pathlib import Path

import numpy as np
import pytest

import service
from model_training.mapping import passes, voxel_map
from service.compiled import compiled_layout, declared_layout, load
from service.errors import StreetfixError
from service.imaging import depth16, level, resample, view_grid
from service.imaging.as_c import CPicture
from service.registration import kernel, points, rays, visibility

LIBRARIES = (resample.LIBRARY, level.LIBRARY, kernel.LIBRARY, points.LIBRARY, visibility.LIBRARY)


@pytest.mark.parametrize(
    "loaded",
    [
        resample._library,
        level._library,
        kernel._library,
        points._library,
        visibility._library,
        rays._library,
        depth16.library,
        view_grid._library,
        voxel_map._library,
        passes._library,
    ],
)
def test_the_compiled_layout_fits_the_python_declarations(loaded):
    assert loaded() is not None


class SwappedPicture(Structure):
    _fields_ = [("width", c_int64), ("height", c_int64), *((name, c_double) for name in ("fx", "fy", "cx", "cy"))]


class NarrowPicture(Structure):
    _fields_ = [("height", c_int64), ("width", c_int64), *((name, c_float) for name in ("fx", "fy", "cx", "cy"))]


class LongPicture(Structure):
    _fields_ = [*CPicture._fields_, ("skew", c_double)]


class ShortPicture(Structure):
    _fields_ = CPicture._fields_[:-1]


class RenamedPicture(Structure):
    _fields_ = [("rows", c_int64), *CPicture._fields_[1:]]


@pytest.mark.parametrize(
    ("declared", "named"),
    [
        (SwappedPicture, "Picture.height"),
        (NarrowPicture, "Picture"),
        (LongPicture, "Picture"),
        (ShortPicture, "Picture"),
        (RenamedPicture, "Picture.height"),
        (np.dtype([(name, "<f8") for name in ("height", "width", "fx", "fy", "cx", "cy")][:5]), "Picture"),
    ],
)
def test_a_structure_that_lies_otherwise_is_refused(declared, named):
    with pytest.raises(
        StreetfixError, match=rf"_resample\.so .*: {named} is .* in C and .* in Python; install .* again"
    ):
        load(resample.LIBRARY, {"Picture": declared})


def test_a_structure_that_c_does_not_know_is_refused():
    with pytest.raises(StreetfixError, match=r"Scene is not there in C"):
        load(resample.LIBRARY, {"Scene": CPicture})


def test_a_constant_of_another_value_is_refused():
    with pytest.raises(
        StreetfixError, match=r"SAMPLES is \(offset 0, size 9\) in C and \(offset 0, size 4\) in Python"
    ):
        load(resample.LIBRARY, constants={"SAMPLES": 4})


def test_a_library_without_a_table_is_refused():
    with pytest.raises(StreetfixError, match="Picture is not there in C"):
        load(depth16.LIBRARY, {"Picture": CPicture})


def test_a_library_that_was_not_compiled_is_named():
    with pytest.raises(StreetfixError, match=r"_nothing\.so is missing .*pip install"):
        load(Path(__file__).with_name("_nothing.so"))


def test_every_structure_in_the_table_of_a_library_is_compared():
    source = "".join(path.read_text() for path in Path(service.__file__).parent.rglob("*.py"))
    for library in LIBRARIES:
        structures = {name.partition(".")[0] for name in compiled_layout(ctypes.CDLL(str(library)))}
        assert structures
        for name in structures:
            assert re.search(rf'load\(\s*LIBRARY[^)]*"{name}": ', source), f"{library.name}: nobody compares {name}"


@pytest.mark.parametrize("path", sorted(Path(service.__file__).parent.rglob("*.c")), ids=lambda path: path.stem)
def test_every_structure_that_a_function_takes_is_in_its_library_s_table(path):
    """Arguments such as ``const View *v`` of exported functions, for structs that Python declares too."""
    exported = re.findall(r"^(?:WIDE )?\w+ streetfix_\w+\(([^)]*)\)", path.read_text(), re.MULTILINE)
    taken = {name for arguments in exported for name in re.findall(r"\b([A-Z][a-z]\w*) \*", arguments)}
    library = ctypes.CDLL(str(path.with_name(f"_{path.stem}.so")))
    assert taken <= set(compiled_layout(library))


def test_a_dtype_and_a_structure_with_equal_fields_have_equal_layouts():
    dtype = np.dtype([("height", "<i8"), ("width", "<i8"), *((name, "<f8") for name in ("fx", "fy", "cx", "cy"))])
    assert declared_layout("Picture", dtype) == declared_layout("Picture", CPicture)
