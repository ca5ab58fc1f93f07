"""Where the sun stands, at a place and a time.

J. Meeus, *Astronomical Algorithms*, 2nd ed. 1998: the sun's apparent place of low accuracy (chapter 25, 0.01
degrees), sidereal time (chapter 12), azimuth and altitude (chapter 13), refraction by Saemundsson (Eq. 16.4).
"""

from __future__ import annotations

import datetime
import math

from envedit.core.errors import ConfigError

YEARS = 1800, 2200
"""Years in which time on clocks is taken for the uniform time of the formulas: the difference is below 7
minutes, 0.005 degrees along the ecliptic."""
PARALLAX_DEGREES = 8.794 / 3600
"""The sun's horizontal parallax."""


def moment(text: str) -> datetime.datetime:
    """Read a time in ISO 8601 with an offset from UTC, such as 2026-06-21T13:30+02:00 or ...T11:30Z.

    ConfigError if it is no such time, has no offset, or its year is not in :data:`YEARS`.
    """
    expected = "expected a time in ISO 8601 with its offset from UTC, such as 2026-06-21T13:30+02:00"
    try:
        time = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise ConfigError(f"--date: got {text!r}, {expected}") from None
    if time.tzinfo is None:
        raise ConfigError(f"--date: got {text!r} without an offset from UTC, {expected}, or Z for UTC")
    if not YEARS[0] <= time.year <= YEARS[1]:
        raise ConfigError(f"--date: got year {time.year}, expected {YEARS[0]} to {YEARS[1]}")
    return time.astimezone(datetime.UTC)


def sun_position(latitude: float, longitude: float, time: datetime.datetime) -> tuple[float, float]:
    """Compute where the sun is seen at a latitude and longitude in degrees, north and east positive.

    Returns its azimuth, degrees from north by east in [0, 360), and its elevation, degrees above the horizon,
    raised by refraction (10 degrees Celsius, 1010 hPa) down to -1 degree.
    """
    j2000 = datetime.datetime(2000, 1, 1, 12, tzinfo=datetime.UTC)
    days = (time - j2000) / datetime.timedelta(days=1)
    t = days / 36525

    # ---- Apparent longitude (25.2 to 25.8)
    mean_longitude = 280.46646 + t * (36000.76983 + 0.0003032 * t)
    m = math.radians(357.52911 + t * (35999.05029 - 0.0001537 * t))
    centre = (1.914602 - t * (0.004817 + 0.000014 * t)) * math.sin(m)
    centre += (0.019993 - 0.000101 * t) * math.sin(2 * m) + 0.000289 * math.sin(3 * m)
    node = math.radians(125.04 - 1934.136 * t)
    longitude_of_sun = math.radians(mean_longitude + centre - 0.00569 - 0.00478 * math.sin(node))

    # ---- Right ascension and declination
    obliquity = math.radians(23.43929111 - 0.0130042 * t + 0.00256 * math.cos(node))
    sine = math.sin(longitude_of_sun)
    ascension = math.atan2(math.cos(obliquity) * sine, math.cos(longitude_of_sun))
    declination = math.asin(math.sin(obliquity) * sine)

    # ---- Azimuth and elevation (12.4, 13.5, 13.6)
    sidereal = 280.46061837 + 360.98564736629 * days + t * t * (0.000387933 - t / 38710000)
    hour = math.radians(sidereal + longitude) - ascension
    phi = math.radians(latitude)
    south = math.cos(hour) * math.sin(phi) - math.tan(declination) * math.cos(phi)
    azimuth = math.degrees(math.atan2(math.sin(hour), south)) + 180
    up = math.sin(phi) * math.sin(declination) + math.cos(phi) * math.cos(declination) * math.cos(hour)
    elevation = math.degrees(math.asin(max(-1.0, min(1.0, up))))
    elevation -= PARALLAX_DEGREES * math.cos(math.radians(elevation))
    return azimuth % 360, elevation + _refraction(elevation)


def _refraction(elevation):
    """Return by how many degrees refraction raises the sun; none where it is 1 degree below the horizon."""
    if elevation < -1:
        return 0.0
    return max(1.02 / 60 / math.tan(math.radians(elevation + 10.3 / (elevation + 5.11))), 0.0)
