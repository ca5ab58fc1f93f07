"""``envedit sky``: the sun's position against an ephemeris, and a sky whose sun stands there."""

import json

import numpy as np
import pytest

from envedit.cli import sky
from envedit.core import latlong
from envedit.core.color import luminance
from envedit.images import images
from envedit.maps import sun_position

EPHEMERIS = [
    (47.37, 8.54, "2026-06-21T11:26:00Z", 179.0659, 66.0718),
    (47.37, 8.54, "2026-12-21T16:00:00+01:00", 228.0997, 4.3396),
    (-33.87, 151.21, "2026-01-15T20:30:00Z", 104.5144, 16.6234),
    (64.15, -21.94, "2026-06-21T23:30:00Z", 332.7628, 1.0371),
    (0.0, 0.0, "2000-03-20T12:00:00Z", 87.7426, 88.1545),
    (35.68, 139.69, "2045-09-01T03:00:00Z", 189.9714, 62.1516),
    (-54.8, -68.3, "1995-07-04T15:00:00Z", 22.6884, 9.6444),
    (71.0, 25.8, "2026-05-20T22:30:00Z", 3.9070, 1.5193),
]
"""Latitude, longitude, time; azimuth and elevation of the sun by PyEphem 4 (VSOP87; pressure 1010, temp 10):
``o = ephem.Observer(); o.lat, o.lon, o.date = ...; s = ephem.Sun(o); s.az, s.alt``."""


@pytest.mark.parametrize(("latitude", "longitude", "time", "azimuth", "elevation"), EPHEMERIS)
def test_the_sun_stands_where_the_ephemeris_has_it(latitude, longitude, time, azimuth, elevation):
    sun_azimuth, sun_elevation = sun_position.sun_position(latitude, longitude, sun_position.moment(time))
    assert sun_elevation == pytest.approx(elevation, abs=0.02)  # of it 0.01 are refraction at the horizon
    off = np.radians(sun_azimuth - azimuth) * np.cos(np.radians(elevation))
    assert abs(np.degrees(off)) < 0.01


def test_poles_and_dates_at_the_ends_are_finite():
    for latitude in (-90, 90):
        for year in sun_position.YEARS:
            moment = sun_position.moment(f"{year}-06-21T00:00Z")
            azimuth, elevation = sun_position.sun_position(latitude, 0, moment)
            assert abs(abs(elevation) - 23.45) < 0.1 and 0 <= azimuth < 360


@pytest.mark.slow
def test_the_sun_of_the_map_is_at_that_azimuth_from_north_and_elevation(tmp_path, capsys):
    out = str(tmp_path / "noon.exr")
    place = ["--place", "47.37", "8.54", "--date", "2026-06-21T17:00+02:00", "--width", "128"]
    assert sky.main([*place, "--out", out, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    envmap = images.load_envmap(out)[0]
    toward = latlong.directions(64, 128).reshape(-1, 3)[luminance(envmap).argmax()]
    azimuth, elevation = np.radians(said["azimuth"]), np.radians(said["elevation"])
    north, east = np.array([0, 0, -1]), np.array([1, 0, 0])
    level = np.cos(azimuth) * north + np.sin(azimuth) * east
    expected = np.cos(elevation) * level + np.sin(elevation) * np.array([0, 1, 0])
    assert toward @ expected > np.cos(np.radians(360 / 128)) and 240 < said["azimuth"] < 280


def test_a_sun_by_its_angles_and_a_name_that_is_free(capsys, here):
    for name in ("sky.exr", "sky_2.exr"):
        assert sky.main(["--elevation", "30", "--width", "32", "--json"]) == 0
        said = json.loads(capsys.readouterr().out)
        assert said["files"] == {"map": name} and said["azimuth"] == 180
    row, column = np.unravel_index(luminance(images.read("sky.exr")[0]).argmax(), (16, 32))
    assert column in (15, 16) and row == 5


PLACE = ["--place", "47", "8"]


@pytest.mark.parametrize(("options", "says"), [
    ([], "which sun? give --elevation"),
    (["--azimuth", "3"], "which sun? give --elevation"),
    (["--elevation", "3", *PLACE], "which sun?"),
    (PLACE, "--place and --date are needed together"),
    ([*PLACE, "--date", "2026-06-21T12:00"], "without an offset from UTC"),
    ([*PLACE, "--date", "noon"], "expected a time in ISO 8601"),
    ([*PLACE, "--date", "1066-10-14T12:00Z"], "got year 1066, expected 1800 to 2200"),
    ([*PLACE, "--date", "2026-06-21T23:30Z"], "below the horizon there and then"),
    (["--place", "91", "8", "--date", "2026-06-21T12:00Z"], "got 91 8, expected a latitude from -90 to 90"),
    (["--elevation", "30", "--width", "7"], "envedit: --width: got 7, expected an even integer"),
])  # fmt: skip
def test_bad_options_are_one_line(options, says, tmp_path, capsys, here):
    assert sky.main(options) == 2
    err = capsys.readouterr().err
    assert says in err and len(err.splitlines()) == 1 and not list(tmp_path.iterdir())
