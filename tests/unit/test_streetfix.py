"""``import streetfix``: the names that most programs need, each loaded on first use."""

import subprocess
import sys

import pytest

import streetfix


def test_every_name_is_there() -> None:
    assert dir(streetfix) == sorted(streetfix.__all__)
    for name in streetfix.__all__:
        assert getattr(streetfix, name).__name__ == name


def test_an_unknown_name_is_an_error_that_lists_the_known_ones() -> None:
    with pytest.raises(AttributeError, match="Localizer, MapBundle"):
        _ = streetfix.Locator


def test_a_defect_of_our_own_is_no_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(streetfix._MODULES, "Localizer", "service.a_module_that_is_not_there")
    monkeypatch.delitem(vars(streetfix), "Localizer", raising=False)
    with pytest.raises(ModuleNotFoundError, match="a_module_that_is_not_there"):
        _ = streetfix.Localizer


def test_a_client_does_not_load_the_localizer() -> None:
    told = "import sys, streetfix; streetfix.Client; print({'onnxruntime', 'faiss', 'cv2', 'grpc', 'PIL'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
