import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import KeysError, UnauthorizedError
from service.runtime.keys import Caller, KeyRing, hash_of, new_key, presented_key

A, B = hashlib.sha256(b"a").hexdigest(), hashlib.sha256(b"b").hexdigest()


def ring_of(tmp_path, text):
    path = tmp_path / "keys.txt"
    path.write_text(text)
    return KeyRing.open(path)


def test_a_key_leads_to_its_name(tmp_path):
    ring = ring_of(tmp_path, f"# robots\n\nrobot-7 {A}  # the red one\nlab {B}\n")
    assert (ring.require("a"), ring.require("b")) == (Caller("robot-7"), Caller("lab"))


def test_an_operator_key_is_marked(tmp_path):
    ring = ring_of(tmp_path, f"robot {A}\nme {B} operator")
    assert (ring.require("a").operator, ring.require("b").operator) == (False, True)


@pytest.mark.parametrize("presented", [None, "", "c", A, "a ", "A", "a" * 10_000])
def test_anything_else_is_refused(tmp_path, presented):
    with pytest.raises(UnauthorizedError):
        ring_of(tmp_path, f"robot {A}").require(presented)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "the key file is empty"),
        ("# none\n", "the key file is empty"),
        ("robot", "line 1"),
        (f"ok {A}\nrobot {B[:-1]}", "line 2"),
        (f"robot {A.upper()}", "line 1"),
        (f"a robot {A}", "line 1"),
        (f"rob/ot {A}", "line 1"),
        (f"{A} robot", "line 1"),
        (f"one {A}\ntwo {A}", "line 2"),
        (f"one {A} admin", "line 1"),
        (f"one {A} operator too", "line 1"),
        (f"one {A}\none {B}", "line 2"),
        ("x" * (2**20 + 1), "the key file exceeds 1 MiB"),
    ],
)
def test_a_file_that_is_none_is_named_with_its_line(tmp_path, text, told):
    with pytest.raises(KeysError, match=told) as caught:
        ring_of(tmp_path, text)
    assert "keys.txt" in str(caught.value)


def test_a_file_that_is_not_there_or_no_text_is_named(tmp_path):
    with pytest.raises(KeysError, match=r"nowhere\.txt"):
        KeyRing.open(tmp_path / "nowhere.txt")
    (tmp_path / "binary").write_bytes(b"\xff\xfe")
    with pytest.raises(KeysError, match="binary"):
        KeyRing.open(tmp_path / "binary")


def test_new_keys_are_long_and_differ_and_get_in(tmp_path):
    one, other = new_key(), new_key()
    assert one != other
    assert len(one) >= 43
    assert ring_of(tmp_path, f"r {hash_of(one)}").require(one) == Caller("r")


@pytest.mark.parametrize(
    ("authorization", "api_key", "expected"),
    [
        (None, None, None),
        ("Bearer k", None, "k"),
        ("bearer  k ", None, "k"),
        (None, "k", "k"),
        ("Bearer k", "x", "k"),
        ("Basic dTpw", None, None),
        ("Basic dTpw", "k", "k"),
        ("Bearer ", "k", "k"),
        ("", "", None),
    ],
)
def test_a_key_comes_in_either_header(authorization, api_key, expected):
    assert presented_key(authorization, api_key) == expected


@given(st.text(max_size=100))
def test_any_text_can_be_hashed(text):
    assert len(hash_of(text)) == 64
