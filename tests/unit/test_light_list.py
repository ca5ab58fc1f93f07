"""Lights before and after an edit: which is which."""

import itertools
import math

import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.rotations import Orientation
from envedit.export import light_list
from envedit.representations.layers.separation import separate
from tests.oracles.maps import toward

HEIGHT, WIDTH = 32, 64


def light(azimuth, elevation, flux=1.0):
    return {"azimuth": azimuth, "elevation": elevation, "flux": [flux] * 3}


def numbers(lights):
    return [(one["id"], one["added"], one["moved_degrees"]) for one in lights["after"]]


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (2, 4), (4, 2), (0, 3), (3, 0)])
def test_pairs_are_the_cheapest_of_all(shape, rng):
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
    (first, second) = numbers(light_list.matched(before, after, Orientation(-40).matrix))
    expected = math.degrees(2 * math.asin(math.sin(math.radians(20)) * math.cos(math.radians(20))))
    assert (first[0], second[0]) == (2, 1)
    assert first[2] == pytest.approx(expected) and second[2] == pytest.approx(expected)


def test_a_light_that_an_edit_has_put_elsewhere_is_the_same_light():
    """The brighter of two ends far away and ten times as bright: without more, the other one seems to."""
    before = [light(30, 84, 3.7), light(250, 77, 2.5)]
    after = [light(150, 0, 34.0), light(35, 84, 2.4)]
    assert [row[0] for row in numbers(light_list.matched(before, after))] == [1, 2]
    moves = [(toward(84, 30), toward(84, 30), 0.7), (toward(77, 250), toward(0, 150), 13.0)]
    found = light_list.matched(before, after, moves=moves)
    assert [row[0] for row in numbers(found)] == [2, 1]
    assert numbers(found)[0][2] > 70

    # ---- The whole map turned by 110 degrees as well
    moves = [(toward(84, 140), toward(84, 140), 0.7), (toward(77, 360), toward(0, 150), 13.0)]
    after = [light(140, 84, 2.4), light(150, 0, 34.0)]
    found = light_list.matched(before, after, Orientation(-110).matrix, moves)
    assert [row[0] for row in numbers(found)] == [1, 2]


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_a_light_in_its_place_is_the_same_light_whatever_its_flux(factor):
    before = [light(30, 40), light(200, 10)]
    after = [light(31, 40, factor), light(206, 10, factor)]
    assert [row[:2] for row in numbers(light_list.matched(before, after))] == [(1, False), (3, True)]


def test_a_turn_goes_the_way_of_the_map():
    envmap = np.full((HEIGHT, WIDTH, 3), 0.2, np.float32)
    envmap[9, 50], envmap[6, 20] = 900, 500
    turned = latlong.rotate(envmap, 45.0)
    lists = [light_list.listed(separate(one).lights, one.shape[:2], np.eye(3)) for one in (envmap, turned)]
    assert [len(one) for one in lists] == [2, 2]
    start, end = (np.array([one["direction"] for one in lights]) for lights in lists)
    np.testing.assert_allclose(start @ Orientation(45).matrix.T, end, atol=1e-4)
    np.testing.assert_allclose(start[0], latlong.directions(HEIGHT, WIDTH)[9, 50], atol=1e-4)
    assert [row[0] for row in numbers(light_list.matched(*lists, Orientation(45).matrix))] == [1, 2]


@pytest.mark.parametrize("changed", [False, True])
def test_a_light_that_the_edit_left_alone_is_the_same_light(changed):
    """Half a texel of turn halves its contrast, so that it is separated no more."""
    envmap = np.full((HEIGHT, WIDTH, 3), 0.2, np.float32)
    envmap[12:14, 50] = 1.2
    degrees = 2.5 * 360 / WIDTH
    turned = latlong.rotate(envmap, degrees)
    if changed:
        turned[12, 47] = 0.6  # one of the texels that it lies in now
    before, after = separate(envmap), separate(turned)
    assert len(before.lights) == 1 and not after.lights
    found = light_list.kept(before, after, envmap, turned, degrees)
    lists = [light_list.listed(one.lights, one.core.shape[:2], np.eye(3)) for one in (before, found)]
    said = light_list.summary(light_list.matched(*lists, Orientation(degrees).matrix), HEIGHT)
    azimuth = round(50.5 / WIDTH * 360 - degrees)
    assert "no longer stands out" in said if changed else f"to azimuth {azimuth}, elevation" in said
    np.testing.assert_array_equal(found.core, 0 if changed else latlong.rotate(before.core, degrees))


def test_what_was_no_light_and_did_not_change_is_none():
    envmap = np.full((HEIGHT, WIDTH, 3), 0.2, np.float32)
    envmap[12, 50], envmap[9, 20] = 100, 200
    sun, both = separate(envmap, most=1), separate(envmap)
    assert len(sun.lights) == 1 and len(both.lights) == 2
    assert len(light_list.kept(sun, both, envmap, envmap, 0.0).lights) == 1
    brighter = envmap.copy()
    brighter[12, 50] = 120
    assert len(light_list.kept(sun, separate(brighter), envmap, brighter, 0.0).lights) == 2


def test_radii_are_those_of_half_and_nearly_all_of_the_flux():
    """Of an even disc, and of a sun of one texel whose faint glare is five degrees wide."""
    height, width, row, column = 256, 512, 80, 300
    toward = latlong.directions(height, width)
    angle = np.degrees(np.arccos(np.clip(toward @ toward[row, column], -1, 1)))[..., None]
    disc, sun = (np.full((height, width, 3), 0.1, np.float32) for _ in range(2))
    disc[angle[..., 0] < 6] = 50
    sun[angle[..., 0] < 5] = 0.6
    sun[row, column] = 5000
    lights = [light_list.listed(separate(one).lights, one.shape[:2], np.eye(3)) for one in (disc, sun)]
    (of_disc,), (of_sun,) = lights
    assert of_disc["radius_50"] == pytest.approx(6 * np.sqrt(0.5), abs=0.1)
    assert of_disc["radius_97"] == pytest.approx(6 * np.sqrt(0.97), abs=0.2)
    texel = 360 / width
    assert 0.3 * texel < of_sun["radius_50"] < 0.7 * texel and of_sun["radius_97"] < 1.5 * texel
    assert of_sun["angle"] == 2 * of_sun["radius_97"] < of_disc["angle"] / 4


def test_lights_that_come_go_and_stay_are_told():
    before = [light(90, 35, 3), light(200, 60, 1), light(300, 10, 1e-4)]
    after = [light(92, 35, 3.1), light(200, 60, 2.0), light(20, 80, 1.5)]
    found = light_list.matched(before, after)
    assert [one["removed"] for one in found["before"]] == [False, False, True]
    assert [row[:2] for row in numbers(found)] == [(1, False), (2, False), (4, True)]
    assert numbers(found)[2][2] is None
    one, two, three, four = light_list.summary(found, HEIGHT).split("; ")
    assert one == "light 1 at azimuth 90, elevation 35 stayed" and two.endswith("60 stayed, flux x 2")
    assert three.endswith("elevation 10 no longer stands out") and four.endswith("elevation 80 is new")
    moved = light_list.matched([light(90, 0)], [light(120, 0)])
    assert "moved by 30.0 degrees to azimuth 120, elevation 0" in light_list.summary(moved, HEIGHT)
    many = light_list.matched([light(30 * k, 0) for k in range(12)], [])
    assert light_list.summary(many, HEIGHT).endswith("; and 4 more in lights.json")
    assert light_list.summary(light_list.matched([], []), HEIGHT) is None
    level = light_list.matched([], [light(359.9, -0.2)])
    assert light_list.summary(level, HEIGHT) == "light 1 at azimuth 0, elevation 0 is new"
    dark = light_list.matched([light(0, 0, 0.0)], [light(0, 0, 0.0)])
    assert numbers(dark) == [(1, False, 0.0)]
