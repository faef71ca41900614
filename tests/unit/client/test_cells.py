"""Nearby positions have the same cell, and the client sends it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.client.cells import cell_of
from service.contract import schema


def at(x: float, y: float) -> schema.Prior:
    return schema.Prior(position=schema.PriorPosition(x=x, y=y))


@pytest.mark.parametrize(
    ("prior", "map_name", "cell"),
    [
        (at(10.0, 999.0), None, "map-0-0"),
        (at(-1.0, 1000.0), "town", "town-map--1-1"),
        (at(0.0, 0.0), "town@3f9c2a7be01d4586", "town-map-0-0"),
        (at(5.0, 5.0), "Zürich", "Z%C3%BCrich-map-0-0"),
        (schema.Prior(wgs84=schema.PriorWgs84(latitude_deg=49.016, longitude_deg=-8.421)), None, "earth-4901--843"),
    ],
)
def test_the_cell_of_a_prior(prior: schema.Prior, map_name: str | None, cell: str) -> None:
    assert cell_of(prior, map_name) == cell


@given(st.floats(-1e7, 1e7), st.floats(-1e7, 1e7))
def test_a_cell_is_a_header_value(x: float, y: float) -> None:
    cell = cell_of(at(x, y), "a-b.c")
    assert cell.isascii()
    assert cell.isprintable()
    assert len(cell) < 64


@pytest.mark.parametrize("prior", [None, schema.Prior(heading_deg=10.0)])
def test_requests_without_a_position_spread(prior: schema.Prior | None) -> None:
    assert len({cell_of(prior, "town") for _ in range(20)}) == 20
