"""The extrapolation to a country, with values worked out by hand."""

import pytest

from benchmarks.country import country_figures
from benchmarks.figures import CODE, figure

INDEX = "search.views_48900000.index"
ROWS = {
    ("scale", "town.kb_per_metre"): 25.0,
    ("scale", f"{INDEX}_bytes_per_view"): 40.0,
    ("scale", f"{INDEX}_build_s"): 978.0,
    ("scale", f"{INDEX}_ms"): 20.0,
    ("serving", "full.answers_per_s"): 10.0,
}


def test_each_figure_is_the_product_of_rows_and_assumptions() -> None:
    found = country_figures(lambda report, name: ROWS[report, name])
    expected = {
        "served_tb": 25.0,  # 10^9 m x 25 kB
        "index_tb": 0.96,  # 2.4 x 10^10 views x 40 bytes
        "build_usd": 5000.0,  # 100,000 hours x 0.05
        "index_core_hours": 267.0,  # 490.8 regions x 978 s x 2 / 3,600
        "cores": 1670.0,  # 10,000 / 10 / 0.6 = 1,667
        "replicas": 209.0,  # 1,670 / 8 = 208.75
        "disk_tb": 51.92,  # 2 x (25 + 0.96)
        "usd_processors": 61_000.0,  # 1,670 x 36.50 = 60,955
        "usd_disks": 4150.0,  # 51,920 x 0.08 = 4,153.6
        "usd_store": 1240.0,  # (25 + 27.9 + 0.96) x 1,000 x 0.023 = 1,238.8
        "usd": 66_300.0,  # 60,955 + 4,153.6 + 1,238.8 = 66,347.4
        "usd_per_robot": 0.663474,
        "whole_search_s": 9.815951,  # 490.8 x 20 ms
        "whole_search_cores": 273.0,  # 27.78 x 9.816
        "places_file_gb": 132.0,  # 10^9 places x 132 bytes
        "more_views_gb": 4.0,  # 10^8 x 40 bytes
        "more_views_minutes": 33.333333,  # 10^8 / 48.9 x 10^6 x 978 s
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-6)


def test_a_figure_follows_its_rows() -> None:
    before = country_figures(lambda *row: ROWS[row])
    after = country_figures(lambda *row: ROWS[row] * (2.0 if row[1] == "full.answers_per_s" else 1.0))
    changed = {name for name in before if before[name] != after[name]}
    assert changed == {"cores", "replicas", "disk_tb_per_replica", "usd_processors", "usd", "usd_per_robot"}
    assert after["cores"] == 833.0


def test_documents_take_the_figures_from_the_reports() -> None:
    assert {name for name in CODE if name.startswith("country.")} == {
        f"country.{name}" for name in country_figures(lambda *row: ROWS[row])
    }
    assert figure("code", "country.place_bytes", ".0f") == "132"
    assert float(figure("code", "country.served_tb", ".6f")) == pytest.approx(
        float(figure("scale", "town.kb_per_metre", ".6f"))
    )
