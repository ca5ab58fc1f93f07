"""Lights before and after an edit: which is which."""

import itertools
import math

import numpy as np
import pytest

from envedit.core import latlong
from envedit.export import light_list
from envedit.representations.layers.separation import separate

HEIGHT, WIDTH = 32, 64


def light(azimuth, elevation, flux=1.0):
    return {"azimuth": azimuth, "elevation": elevation, "flux": [flux] * 3}


def numbers(lights):
    return [(one["id"], one["added"], one["moved_degrees"]) for one in lights["after"]]


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (2, 4), (4, 2), (0, 3), (3, 0)])
def test_pairs_are_the_cheapest_of_all(shape, rng):
    """Against all ways there are."""
    for _ in range(10):
        cost = rng.random(shape) * 1.5 * light_list.FARTHEST
        found = light_list._paired(cost)
        taken = [j for j in found if j is not None]
        assert len(found) == shape[0] and len(set(taken)) == len(taken)

        def total(partners, cost=cost):
            return sum(light_list.FARTHEST if j is None else cost[i, j] for i, j in enumerate(partners))

        choices = [*range(shape[1]), *[None] * shape[0]]
        least = min(total(partners) for partners in itertools.permutations(choices, shape[0]))
        assert total(found) == pytest.approx(least)


def test_a_light_that_is_turned_with_its_map_is_the_same_light():
    """Two lights of one flux a turn apart: the first comes to where the second was."""
    before = [light(10, 20), light(50, 20)]
    after = [light(90, 20), light(50, 20)]
    (first, second) = numbers(light_list.matched(before, after, -40.0))
    expected = math.degrees(2 * math.asin(math.sin(math.radians(20)) * math.cos(math.radians(20))))
    assert (first[0], second[0]) == (2, 1)
    assert first[2] == pytest.approx(expected) and second[2] == pytest.approx(expected)


def test_a_turn_goes_the_way_of_the_map():
    envmap = np.full((HEIGHT, WIDTH, 3), 0.2, np.float32)
    envmap[9, 50], envmap[6, 20] = 900, 500
    turned = latlong.rotate(envmap, 45.0)
    lists = [light_list.listed(separate(one), np.eye(3)) for one in (envmap, turned)]
    assert [len(one) for one in lists] == [2, 2]
    start, end = (np.array([light_list._toward(one) for one in lights]) for lights in lists)
    np.testing.assert_allclose(light_list._turned(start, 45.0), end, atol=1e-4)
    np.testing.assert_allclose(start[0], latlong.directions(HEIGHT, WIDTH)[9, 50], atol=1e-4)
    assert [row[0] for row in numbers(light_list.matched(*lists, 45.0))] == [1, 2]


def test_lights_that_come_go_and_stay_are_told():
    before = [light(90, 35, 3), light(200, 60, 1), light(300, 10, 1e-4)]
    after = [light(92, 35, 3.1), light(200, 60, 2.0), light(20, 80, 1.5)]
    found = light_list.matched(before, after)
    assert [one["removed"] for one in found["before"]] == [False, False, True]
    assert [row[:2] for row in numbers(found)] == [(1, False), (2, False), (4, True)]
    assert numbers(found)[2][2] is None
    assert light_list.summary(found, HEIGHT) == (
        "light 1 at azimuth 90, elevation 35 stayed; light 2 at azimuth 200, elevation 60 stayed, flux x 2; "
        "light 3 at azimuth 300, elevation 10 is gone; light 4 at azimuth 20, elevation 80 is new"
    )
    moved = light_list.matched([light(90, 0)], [light(120, 0)])
    assert "moved by 30.0 degrees to azimuth 120, elevation 0" in light_list.summary(moved, HEIGHT)
    many = light_list.matched([light(30 * k, 0) for k in range(12)], [])
    assert light_list.summary(many, HEIGHT).endswith("; and 4 more in lights.json")
    assert light_list.summary(light_list.matched([], []), HEIGHT) is None
    level = light_list.matched([], [light(359.9, -0.2)])
    assert light_list.summary(level, HEIGHT) == "light 1 at azimuth 0, elevation 0 is new"
    dark = light_list.matched([light(0, 0, 0.0)], [light(0, 0, 0.0)])
    assert numbers(dark) == [(1, False, 0.0)]
