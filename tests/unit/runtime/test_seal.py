"""Sealed bytes come back unchanged or not at all."""

from hypothesis import given
from hypothesis import strategies as st

from service.runtime.seal import LEAST_KEY, Seal

KEY = "k" * LEAST_KEY


@given(st.binary(max_size=300))
def test_sealed_bytes_come_back(content):
    assert Seal(KEY).opened(Seal(KEY).sealed(content)) == content


@given(st.binary(min_size=1, max_size=50), st.integers(0), st.integers(1, 255))
def test_a_change_of_any_byte_is_noticed(content, at, flip):
    sealed = bytearray(Seal(KEY).sealed(content))
    sealed[at % len(sealed)] ^= flip
    assert Seal(KEY).opened(bytes(sealed)) is None


@given(st.binary(max_size=31))
def test_bytes_that_are_shorter_than_a_code_are_refused(content):
    assert Seal(KEY).opened(content) is None


def test_another_key_opens_nothing():
    sealed = Seal(KEY).sealed(b"belief")
    assert Seal("x" * LEAST_KEY).opened(sealed) is None
    assert Seal().opened(sealed) is None


def test_the_code_is_hmac_sha256():
    """Test case 2 of RFC 4231."""
    sealed = Seal("Jefe").sealed(b"what do ya want for nothing?")
    assert sealed[:32].hex() == "5bdcc146bf60754e6a042426089575c75a003f089d2739839dec58b964ec3843"
