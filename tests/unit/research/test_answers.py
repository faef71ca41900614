import numpy as np

from research.baselines.answers import nearest_streets
from service.maps.streets import Streets


def square(number: int, x: float) -> dict[str, object]:
    ring = [[x, 0.0], [x + 10, 0.0], [x + 10, 10.0], [x, 10.0], [x, 0.0]]
    return {
        "properties": {
            "id": str(number),
            "street": str(number),
            "section": None,
            "name": f"Street {number}",
            "class_index": number,
        },
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }


def test_a_point_off_every_street_is_of_the_nearest_and_none_is_of_none() -> None:
    streets = Streets.from_geojson({"type": "FeatureCollection", "features": [square(0, 0.0), square(1, 30.0)]})

    found = nearest_streets(streets, np.array([[5.0, 5.0], [19.0, 5.0], [21.0, 5.0], [np.nan, np.nan], [35.0, -3.0]]))

    assert found.tolist() == [0, 0, 1, -1, 1]
