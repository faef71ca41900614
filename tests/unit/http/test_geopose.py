import pytest

from service.http.geopose import GEOPOSE, wants_geopose


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        ("", False), ("*/*", False), ("application/json", False), (GEOPOSE, True), (f"{GEOPOSE};version=1.0", True),
        (f"application/json, {GEOPOSE}", False), (f"{GEOPOSE}, application/json", True), (f"{GEOPOSE};q=0.5, application/json", False),
        (f"application/json;q=0.5, {GEOPOSE};q=0.9", True), (f"*/*;q=0.1, {GEOPOSE};q=0.2", True), (f"{GEOPOSE};q=0", False),
        (f"{GEOPOSE};q=lots", False), ("text/html, application/xml;q=0.9, */*;q=0.8", False), (GEOPOSE.upper(), True),
    ],
)  # fmt: skip
def test_qualities_decide_and_of_equal_ones_the_first(accept, expected):
    assert wants_geopose(accept) == expected
