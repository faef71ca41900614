import pytest

from model_training.streets.safe_xml import read_xml
from service.errors import DatasetError

BOMB = '<!DOCTYPE a [<!ENTITY x "ha"><!ENTITY y "&x;&x;">]><a>&y;</a>'


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "map.xodr"
    return lambda text: (path.write_bytes(text if isinstance(text, bytes) else text.encode()), path)[1]


def test_elements_attributes_and_text_are_read(file):
    tree = read_xml(file('<a><b c="1">text</b></a>'), root="a")
    found = tree.find("b")
    assert found is not None
    assert (found.get("c"), tree.findtext("b")) == ("1", "text")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("road network", "not valid XML"),
        ("", "not valid XML"),
        ("<a><b/>", "not valid XML"),
        (b"\x00\xff\xfe", "not valid XML"),
        ("<other/>", "its root element is <other>, not <a>"),
        (BOMB, "line 1: a document type"),
        ('<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "a document type"),
        ("<a>&undefined;</a>", "not valid XML"),
    ],
)
def test_unsafe_xml_is_refused_by_name(file, text, said):
    with pytest.raises(DatasetError, match=rf"map\.xodr: .*{said}"):
        read_xml(file(text), root="a")


def test_a_file_over_the_limit_is_not_read(file):
    with pytest.raises(DatasetError, match="9 bytes are more than 8"):
        read_xml(file("<a>  </a>"), root="a", largest_bytes=8)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DatasetError, match=r"nothing\.xodr: cannot be read"):
        read_xml(tmp_path / "nothing.xodr", root="a")
