import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training.precision import forward_in, native_precision  # noqa: E402  # after the skip


@pytest.mark.parametrize(("precision", "dtype"), [("float32", torch.float32), ("bfloat16", torch.bfloat16)])
def test_products_have_the_requested_precision(precision, dtype):
    with forward_in(precision):
        assert (torch.ones(2, 2) @ torch.ones(2, 2)).dtype == dtype
    assert (torch.ones(2, 2) @ torch.ones(2, 2)).dtype == torch.float32


def test_float32_within_half_precision_is_float32_again():
    with forward_in("bfloat16"), forward_in("float32"):
        assert (torch.ones(2, 2) @ torch.ones(2, 2)).dtype == torch.float32


@pytest.mark.parametrize(("has", "precision"), [(True, "bfloat16"), (False, "float32")])
def test_half_precision_is_native_where_the_processor_has_it(monkeypatch, has, precision):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: has)
    assert native_precision() == precision
