"""The tiny map, and its pictures as a frame that was looked up in it."""

import pytest

from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.query import Query


@pytest.fixture(scope="module")
def localizer(bundle_path):
    return Localizer.open(MapBundle.open(bundle_path))


@pytest.fixture(scope="module")
def frame(localizer, pictures):
    rgb, depth_m, camera = pictures
    return localizer.encode_and_search(Query(rgb=rgb, depth_m=depth_m, camera=camera))
