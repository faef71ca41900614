import numpy as np
import pytest
import shapely

from model_training.streets.map_frame import MapFrame
from model_training.streets.opendrive import read_network, read_opendrive
from service.errors import DatasetError
from service.geometry.earth import Georeference

WIDTH = '<width sOffset="0" a="{}" b="0" c="0" d="0"/>'
BOTH_SIDES = (
    f'<left><lane id="2" type="sidewalk">{WIDTH.format(2)}</lane><lane id="1" type="driving">{WIDTH.format(4)}</lane></left>'
    f'<center><lane id="0" type="none"/></center>'
    f'<right><lane id="-1" type="driving">{WIDTH.format(3)}</lane><lane id="-2" type="shoulder">{WIDTH.format(1)}</lane></right>'
)


def only(path, **options):
    (street,) = read_opendrive(path, **options).streets
    return street


def covers(surface, expected):
    return surface.symmetric_difference(expected).area < 0.01


def test_a_straight_road_is_as_long_and_wide_as_its_lanes(xodr, road):
    street = only(xodr(road(1, lanes=BOTH_SIDES)))
    assert covers(street.surface, shapely.box(0, -4, 100, 6))


def test_driving_lanes_alone_leave_pavements_and_shoulders_out(xodr, road):
    street = only(xodr(road(1, lanes=BOTH_SIDES)), lanes="driving")
    assert covers(street.surface, shapely.box(0, -3, 100, 4))


def test_a_lane_that_is_not_wanted_between_two_that_are_still_keeps_them_apart(xodr, road):
    lanes = "".join(
        f'<lane id="{n}" type="{kind}">{WIDTH.format(3)}</lane>'
        for n, kind in enumerate(("driving", "median", "driving"), 1)
    )
    street = only(xodr(road(1, lanes=f"<left>{lanes}</left>")), lanes="driving")
    assert covers(street.surface, shapely.union(shapely.box(0, 0, 100, 3), shapely.box(0, 6, 100, 9)))


def test_an_arcs_surface_is_a_piece_of_a_ring(xodr, road):
    street = only(xodr(road(1, '<arc curvature="0.02"/>', length=25 * np.pi)))
    assert street.surface.area == pytest.approx(np.pi / 4 * (50**2 - 46**2), rel=1e-4)
    assert street.surface.distance(shapely.Point(50, 50)) < 0.01


def test_a_bend_tighter_than_its_lane_is_covered_whole(xodr, road):
    street = only(xodr(road(1, '<arc curvature="0.5"/>', length=2 * np.pi)))  # radius 2, lane 4 m to the inside
    assert street.surface.contains(shapely.Point(0, 2).buffer(1.8))


def test_a_lane_offset_shifts_the_road(xodr, road):
    offset = '<laneOffset s="0" a="0" b="0" c="0" d="0"/><laneOffset s="50" a="2" b="0" c="0" d="0"/>'
    surface = only(xodr(road(1, offset=offset))).surface
    assert shapely.box(51, 2.1, 99, 5.9).within(surface)
    assert shapely.box(1, 0.1, 49, 3.9).within(surface)
    assert not surface.intersects(shapely.box(51, 0, 100, 1.9))


def test_a_lane_widens_by_its_cubic(xodr, road):
    lanes = '<left><lane id="1" type="driving"><width sOffset="0" a="2" b="0.04" c="0" d="0"/></lane></left>'
    assert only(xodr(road(1, lanes=lanes))).surface.area == pytest.approx(100 * (2 + 6) / 2)


def test_a_lane_section_ends_where_the_next_begins(xodr, road):
    two = f'<left><lane id="1" type="driving">{WIDTH.format(4)}</lane></left></laneSection><laneSection s="40">'
    two += f'<right><lane id="-1" type="driving">{WIDTH.format(3)}</lane></right>'
    surface = only(xodr(road(1, lanes=two))).surface
    assert covers(surface, shapely.union(shapely.box(0, 0, 40, 4), shapely.box(40, -3, 100, 0)))


def test_roads_of_one_name_are_one_street(xodr, road):
    street = only(xodr(road(1, name="High Street"), road(2, name="High Street", x=100)))
    assert (street.name, len(street.lines)) == ("High Street", 2)
    assert covers(street.surface, shapely.box(0, 0, 200, 4))


def test_roads_without_a_name_are_named_by_number_and_counted(xodr, road):
    read = read_opendrive(xodr(road(7), road(9, y=50, name="Mill Lane")))
    assert ([street.name for street in read.streets], read.unnamed) == (["Mill Lane", "Road 7"], 1)


def test_a_road_without_a_name_is_not_joined_with_one_that_is_called_like_it(xodr, road):
    read = read_opendrive(xodr(road(7), road(9, y=50, name="Road 7")))
    assert [street.name for street in read.streets] == ["Road 7", "Road 7 (without a name)"]


def test_a_road_without_the_requested_lanes_is_reported(xodr, road):
    pavement = f'<left><lane id="1" type="sidewalk">{WIDTH.format(2)}</lane></left>'
    read = read_opendrive(xodr(road(1), road(2, lanes=pavement)), lanes="driving")
    assert read.dropped == ("road 2 has no lane of the kind 'driving'",)


@pytest.fixture
def crossing(xodr, road):
    """Return two roads and the connections between them through junction 5."""

    def write(first, second, name=""):
        link = '<predecessor elementType="road" elementId="1"/><successor elementType="road" elementId="2"/>'
        return xodr(
            road(1, name=first),
            road(2, name=second, x=120),
            road(3, x=100, length=20, junction=5, link=link, name="x"),
            f'<junction id="5" name="{name}"/>',
        )

    return write


@pytest.mark.parametrize(
    ("first", "second", "own", "name"),
    [
        ("Mill Lane", "Abbey Road", "", "Abbey Road / Mill Lane"),
        ("Mill Lane", "Abbey Road", "junction5", "Abbey Road / Mill Lane"),
        ("Mill Lane", "Abbey Road", "Market Square", "Market Square"),
        ("", "", "", "Junction 5"),
        ("Mill Lane", "", "Junction 12", "Junction 5"),
    ],
)
def test_a_junction_is_called_by_its_name_or_the_streets_that_meet_or_by_number(crossing, first, second, own, name):
    street = read_opendrive(crossing(first, second, own)).streets[-1]
    assert (street.name, street.divisible) == (name, False)
    assert covers(street.surface, shapely.box(100, 0, 120, 4))


def test_a_junction_within_one_street_is_a_part_of_it(crossing):
    assert covers(only(crossing("High Street", "High Street")).surface, shapely.box(0, 0, 220, 4))


def test_junctions_of_the_same_streets_have_distinct_names(xodr, road):
    links = '<predecessor elementType="road" elementId="1"/><successor elementType="road" elementId="2"/>'
    through = [road(k, x=300 * k, length=20, junction=k, link=links) for k in (3, 4)]
    read = read_opendrive(xodr(road(1, name="A"), road(2, name="B", y=90), *through))
    assert [street.name for street in read.streets] == ["A", "B", "A / B", "A / B (2)"]


UTM = "<geoReference><![CDATA[+proj=utm +zone=32 +datum=WGS84 +units=m]]></geoReference>"


@pytest.mark.parametrize("offset", [0.0, 5_000_000.0])
def test_a_projected_map_lands_where_its_places_on_the_earth_do(xodr, road, ulm, offset):
    import pyproj

    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    latitude, longitude, _ = Georeference(**ulm).to_earth(np.array([300.0, 200.0, 0.0]))
    x, y = to_utm.transform(longitude, latitude)
    header = UTM + f'<offset x="0" y="{offset}" z="0" hdg="0"/>'
    street = only(xodr(road(1, x=x, y=y - offset), header=header), frame=MapFrame(ulm))
    start = np.array(street.lines[0].coords[0])
    np.testing.assert_allclose(start, [300, 200], atol=0.01)


def test_carlas_georeference_with_a_grid_of_heights_needs_no_grid(xodr, road):
    header = "<geoReference>+proj=tmerc +lat_0=0 +lon_0=0 +k=1 +datum=WGS84 +units=m +geoidgrids=egm96_15.gtx +vunits=m</geoReference>"
    frame = MapFrame({"latitude_deg": 0.0, "longitude_deg": 0.0, "height_m": 0.0})
    street = only(xodr(road(1, x=200, y=-300), header=header), frame=frame)
    np.testing.assert_allclose(street.lines[0].coords[0], [200, -300], atol=0.01)


def test_a_map_elsewhere_on_the_earth_is_refused(xodr, road, ulm):
    with pytest.raises(DatasetError, match="more than 50 km from the map's origin"):
        read_opendrive(xodr(road(1, x=400_000, y=0), header=UTM), frame=MapFrame(ulm))


@pytest.mark.parametrize(
    ("header", "said"),
    [("", "geoReference is missing"), ("<geoReference>here</geoReference>", "'here' is not a projection")],
)
def test_a_missing_or_unknown_projection_is_refused_with_the_remedy(xodr, road, ulm, header, said):
    with pytest.raises(DatasetError, match=f"{said}.*--frame map"):
        read_opendrive(xodr(road(1), header=header), frame=MapFrame(ulm))


DEFECTS = [
    (lambda _: "", "the file has no <road>"),
    (lambda road: road(1).replace("<line/>", ""), "road 1: a <geometry> has nothing"),
    (lambda road: road(1, "<bezier/>"), "road 1: a <geometry> has bezier"),
    (lambda road: road(1).replace("geometry", "other"), "road 1: planView has no <geometry>"),
    (lambda road: road(1).replace('x="0.0"', ""), "road 1: <geometry> has no attribute 'x'"),
    (lambda road: road(1, x=float("nan")), "road 1: <geometry>: x is 'nan', not a number"),
    (lambda road: road(1, y=1e300), "road 1: <geometry>: y is '1e\\+300'"),
    (
        lambda road: road(1).replace('d="0"', 'd="9e7"'),
        "road 1: its planView or lanes do not form a surface: a coordinate",
    ),
    (lambda road: road(1, length=0), "road 1: its length of 0 m"),
    (lambda road: road(1, length=1e6), "road 1: its length of 1e\\+06 m"),
    (lambda road: road(1).replace('geometry s="0"', 'geometry s="-9e7"'), "<geometry>: s is -9e\\+07"),
    (lambda road: road(1).replace('laneSection s="0"', 'laneSection s="-1"'), "<laneSection>: s is -1"),
    (lambda road: road(1, '<paramPoly3 pRange="half"/>'), "pRange 'half'"),
    (lambda road: road(1).replace("width", "border"), "lane 1 is described by <border>"),
    (lambda road: road(1).replace('lane id="1"', 'lane id="left"'), "laneSection at s = 0: a lane's id is 'left'"),
    (lambda road: road(1) + road(1), "two roads have the id '1'"),
]


@pytest.mark.parametrize(("made", "said"), DEFECTS)
def test_a_defective_road_is_refused_by_file_and_road(xodr, road, made, said):
    with pytest.raises(DatasetError, match=rf"map\.xodr.*{said}"):
        read_opendrive(xodr(made(road)))


def test_more_roads_than_memory_holds_are_refused(xodr, road):
    with pytest.raises(DatasetError, match="km of roads"):
        read_network(xodr(*(road(number, length=99_000) for number in range(60))))
