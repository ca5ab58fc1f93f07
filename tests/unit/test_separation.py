"""Lights told from their background: nothing is lost, nothing is invented, at any size and exposure."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from envedit.core import latlong
from envedit.core.color import LUMINANCE
from envedit.images import images
from envedit.representations.layers import separation
from tests.oracles.maps import angle, toward

HEIGHT, WIDTH = 64, 128
SUNS = {
    "the sky": (20, 60),
    "the horizon": (32, 64),
    "the seam, first column": (20, 0),
    "the seam, last column": (20, WIDTH - 1),
    "near the pole": (1, 30),
    "near the lower pole": (HEIGHT - 2, 7),
}


def sky(height=HEIGHT, width=WIDTH, slope=0.3):
    return np.exp(slope * latlong.directions(height, width)[..., 1:2]) * [0.3, 0.4, 0.6]


def discs(*lights, height=HEIGHT, width=WIDTH):
    """Return a sky with lights, each (direction, radius in degrees, radiance)."""
    m, d = sky(height, width), latlong.directions(height, width)
    for v, radius, radiance in lights:
        m[angle(d, v) <= radius] = radiance
    return m


def checked(m, rows=None):
    """Separate; what holds for any map: the parts make the map, and the lights make the parts."""
    before = m.copy()
    s = separation.separate(m, rows)
    np.testing.assert_array_equal(m, before)  # the caller's own
    hidden = np.zeros_like(s.core).reshape(-1, 3)
    for light in s.lights:
        hidden[light.texels] = light.hidden
    assert (hidden >= 0).all()
    for part in (s.background, s.glow, s.core):
        assert part.shape == m.shape and part.dtype == np.float64
        assert np.isfinite(part).all() and (part >= 0).all()
    covered = m + hidden.reshape(m.shape)
    np.testing.assert_allclose(s.background * s.glow + s.core, covered, rtol=1e-12, atol=0)
    first, total = rows or (0, m.shape[0])
    d = latlong.directions(total, m.shape[1])[first : first + m.shape[0]]
    glow, core = np.ones_like(s.glow), np.zeros_like(s.core).reshape(-1, 3)
    for light in s.lights:
        assert abs(np.linalg.norm(light.direction) - 1) < 1e-12 and len(light.texels)
        assert not core[light.texels].any(), "a texel belongs to one light"
        core[light.texels] = light.radiance
        if light.glow is not None:
            assert light.glow.shape == (len(separation.GLOW_DEGREES), 3)
            assert (np.diff(light.glow, axis=0) <= 0).all() and (light.glow >= 0).all()
            glow *= 1 + separation.glow_at(light.glow, d @ light.direction)
    np.testing.assert_allclose(s.glow, glow, rtol=1e-12)
    np.testing.assert_array_equal(s.core, core.reshape(s.core.shape))
    if not s.lights:
        assert s.background.tobytes() == np.asarray(m, np.float64).tobytes()
        assert (s.glow == 1).all() and not s.core.any()
    return s


# ---- one light and several ---------------------------------------------------------------------------------
@pytest.mark.parametrize("where", SUNS)
def test_a_sun_of_one_texel_is_one_light(where):
    row, column = SUNS[where]
    m, truth = sky(), sky()[row, column]
    m[row, column] = 5e4
    s = checked(m)
    (light,) = s.lights
    assert angle(latlong.directions(HEIGHT, WIDTH)[row, column], light.direction) < 180 / (HEIGHT - 1)
    assert row * WIDTH + column in light.texels and len(light.texels) <= 9
    np.testing.assert_allclose((s.background * s.glow)[row, column], truth, rtol=0.05)


def test_a_sun_in_the_pole_is_one_light():
    m = sky()
    m[0] = 5e4
    (light,) = checked(m).lights
    assert angle(np.array([0, 1, 0]), light.direction) < 0.1


@pytest.mark.parametrize("azimuth", [0, 77])
def test_a_softbox_is_one_light_as_large_as_it_is(azimuth):
    v = toward(15, azimuth)
    s = checked(discs((v, 10, 20)))
    (light,) = s.lights
    assert angle(light.direction, v) < 1
    inside = angle(latlong.directions(HEIGHT, WIDTH), v) <= 10
    assert inside.ravel()[light.texels].sum() == inside.sum()
    np.testing.assert_allclose(s.background[inside], sky()[inside], rtol=0.05)


def test_a_winding_tube_across_the_seam_is_one_light():
    m = sky()
    for k, row in enumerate(range(20, 45, 4)):
        m[row, -3:], m[row, :4] = 50, 50
        m[row : row + 4, 3 if k % 2 else -3] = 50
    tube = (m == 50).all(axis=2)
    (light,) = checked(m).lights
    assert set(np.flatnonzero(tube)) <= set(light.texels.tolist())


def test_of_many_lamps_the_strongest_are_told_apart():
    lamps = [toward(35 if i % 2 else -30, 30 * i) for i in range(12)]
    strength = np.random.default_rng(3).permutation(12) * 200 + 1000
    m = discs(*((v, 2.5, s) for v, s in zip(lamps, strength, strict=True)))
    flux = strength * [(angle(latlong.directions(HEIGHT, WIDTH), v) <= 2.5).sum() for v in lamps]
    flux = flux * [np.hypot(v[0], v[2]) for v in lamps]
    lights = checked(m).lights
    found = [int(np.argmax(np.array(lamps) @ light.direction)) for light in lights]
    assert len(found) == separation.MOST_LIGHTS == 8
    assert found == np.argsort(-flux)[:8].tolist()


@pytest.mark.parametrize("exposure", [1, 1e-20])
def test_one_bright_texel_in_the_dark_is_all_there_is(exposure):
    m = np.zeros((HEIGHT, WIDTH, 3))
    m[20, -1] = exposure * np.array([3, 2, 1])
    s = checked(m)
    (light,) = s.lights
    assert light.texels.tolist() == [21 * WIDTH - 1]
    assert not s.background.any() and light.glow is None
    np.testing.assert_array_equal(light.radiance, m[20, -1:])


# ---- no light ----------------------------------------------------------------------------------------------
def noise():
    return np.random.default_rng(0).uniform(1, 2, (HEIGHT, WIDTH, 3))


def ramp():
    """Twenty times as bright ahead as behind."""
    return np.exp(1.5 * latlong.directions(HEIGHT, WIDTH)[..., [2]]) * [0.3, 0.4, 0.6]


@pytest.mark.parametrize("m", [
    np.full((HEIGHT, WIDTH, 3), 0.7), np.zeros((HEIGHT, WIDTH, 3)), sky(), ramp(), noise(),
], ids=["constant", "black", "sky", "gradient", "noise"])  # fmt: skip
def test_where_nothing_stands_out_the_background_is_the_map(m):
    s = checked(m)
    assert s.lights == [] and s.background.tobytes() == m.tobytes()


def test_a_lamp_without_flux_is_no_light():
    """One texel of 100 beside the pole: less than LEAST_SHARE; as bright at the horizon, it is a light."""
    m = sky()
    m[2, 9] = 30
    assert checked(m).lights == []
    m[32, 9] = 30
    (light,) = checked(m).lights
    assert abs(light.direction[1]) < 0.1


# ---- any map -----------------------------------------------------------------------------------------------
@settings(max_examples=30, deadline=None)
@given(
    st.integers(3, 14),
    st.integers(2, 24),
    st.sampled_from([0.1, 1, 2, 4]),
    st.floats(-6, 5),
    st.sampled_from([0, 0.5]),
    st.tuples(st.integers(0, 6), st.integers(0, 6)),
    st.integers(0, 2**32 - 1),
)
@example(5, 8, 4, 0.0, 0.5, (0, 0), 1)
def test_the_parts_of_any_map_make_the_map(height, width, spread, exposure, dark, around, seed):
    rng = np.random.default_rng(seed)
    m = np.exp(rng.normal(0, spread, (height, width, 3))) * 10.0**exposure
    m[rng.random((height, width)) < dark] = 0
    checked(m, (around[0], height + sum(around)))


@pytest.mark.parametrize("value", [1e-30, 65504, 1e6])
def test_extreme_values_stay_finite(value):
    m = sky()
    m[20, 3] = value
    m[40] *= value
    with np.errstate(all="raise", under="ignore"):
        checked(m)
        checked(sky() * value)


# ---- crops, sizes, exposures -------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("rows", [(0, 32), (10, 40), (19, 21)])
@pytest.mark.parametrize("scale", [1, 5])
def test_a_crop_has_the_light_where_the_map_has_it(rows, scale):
    """Five times as fine, lights are looked for in a copy."""
    height, width, (start, stop) = scale * HEIGHT, scale * WIDTH, np.multiply(rows, scale)
    d = latlong.directions(height, width)
    v = latlong.directions(HEIGHT, WIDTH)[20, 33]
    m = discs((v, 2, 2e4), height=height, width=width)
    s = checked(m[start:stop], (int(start), height))
    (light,) = s.lights
    assert angle(light.direction, v) < 1
    inside = np.flatnonzero(angle(d, v)[start:stop] <= 2)
    assert set(inside) <= set(light.texels.tolist())
    behind = s.background.reshape(-1, 3)[inside]
    np.testing.assert_allclose(behind, np.tile(sky()[20, 33], (len(inside), 1)), rtol=0.1)


@pytest.mark.parametrize("factor", [1000, 1e-6])
def test_lights_do_not_depend_on_the_exposure(factor):
    d = latlong.directions(HEIGHT, WIDTH)
    m = discs((toward(40, 10), 2.5, 3e4), (toward(-10, 200), 9, 300))
    m *= 1 + 4 * np.exp(-angle(d, toward(40, 10)) / 12)[..., None]
    one, other = checked(m), checked(m * factor)
    assert len(one.lights) == len(other.lights) == 2 and one.lights[0].glow is not None
    for a, b in zip(one.lights, other.lights, strict=True):
        np.testing.assert_allclose(b.direction, a.direction, atol=1e-9)
        if a.glow is not None:
            np.testing.assert_allclose(b.glow, a.glow, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(other.background, one.background * factor, rtol=1e-6)


@pytest.mark.slow
def test_lights_do_not_depend_on_the_resolution():
    where = [toward(40, 0.2), toward(-20, 120), toward(15, 250)]
    lamps = zip(where, (1.2, 8, 4), (3e4, 300, 600), strict=True)
    fine = discs(*lamps, height=512, width=1024)
    fine *= 1 + 4 * np.exp(-angle(latlong.directions(512, 1024), where[0]) / 12)[..., None]
    a, b = (checked(m).lights for m in (fine, latlong.resize(fine, 128, 256).astype(np.float64)))
    assert len(a) == len(b) == 3
    for one, other, v in zip(a, b, where, strict=True):
        assert angle(one.direction, other.direction) < 1 and angle(one.direction, v) < 1
        assert (one.glow is None) == (other.glow is None)
    assert a[0].glow is not None


# ---- glow --------------------------------------------------------------------------------------------------
def glowing(elevation, azimuth, strength, decay, unrest, horizon=0.0):
    """Return a sun in a glow, the sky without both, and the glow's factor at every texel.

    The sky is exp(``horizon``) times as bright at the horizon as at the poles.
    """
    d, v = latlong.directions(128, 256), toward(elevation, azimuth)
    away = angle(d, v)
    glow = (strength * np.exp(-away / decay) * (away < 70))[..., None] * [1, 0.9, 0.7]
    rng = np.random.default_rng(0)
    base = np.exp(unrest * rng.standard_normal((128, 256, 1))) * [0.3, 0.4, 0.6]
    base *= np.exp(horizon * (1 - np.abs(d[..., 1:2])))
    m = base * (1 + glow)
    m[away < 1] += 3e4
    return m, base, glow, away


@pytest.mark.parametrize("elevation, azimuth, strength, decay, unrest, horizon", [
    (45, 100, 5, 8, 0, 0), (30, 0, 10, 15, 0.1, 0), (3, 10, 20, 10, 0, 0), (80, 200, 5, 8, 0.1, 0),
    (20, 100, 8, 12, 0, 1.5), (10, 200, 8, 12, 0.1, 1.0),
])  # fmt: skip
def test_a_glow_is_found_and_taken_from_the_sky(elevation, azimuth, strength, decay, unrest, horizon):
    m, base, glow, away = glowing(elevation, azimuth, strength, decay, unrest, horizon)
    s = checked(m)
    (light,) = s.lights
    ratio = (s.glow / (1 + glow))[away > 3]
    assert ratio.min() > 0.85 and ratio.max() < 1.15
    clear = s.background / base
    assert 0.85 < np.median(clear[away < 3]) < 1.15
    assert np.quantile(clear, 0.01) > 0.85 and np.quantile(clear, 0.99) < 1.15
    before = m[(away > 3) & (away < 5)].mean() / m[(away > 65) & (away < 75)].mean()
    assert before > 2.5, "there is something to find"


@pytest.mark.parametrize("unrest", [0, 0.3])
def test_a_sun_without_glow_gets_none(unrest):
    m, base, _, away = glowing(45, 100, 0, 1, unrest)
    s = checked(m)
    (light,) = s.lights
    assert light.glow is None and (s.glow == 1).all()
    np.testing.assert_array_equal(s.background[away > 5], base[away > 5])


def test_a_glow_is_interpolated_and_ends():
    table = np.zeros((len(separation.GLOW_DEGREES), 3))
    table[:, 0], table[:, 1] = 3, np.arange(len(table))
    cosine = np.cos(np.radians([[0, 10.25], [120.5, 180]]))
    result = separation.glow_at(table, cosine)
    np.testing.assert_allclose(result[..., 0], [[3, 3], [0, 0]])
    np.testing.assert_allclose(result[..., 1], [[0, 10.25], [0, 0]], atol=1e-6)
    assert not result[..., 2].any()
    np.testing.assert_array_equal(separation.glow_at(table, np.array([1 + 1e-9])), [[3, 0, 0]])


# ---- filled ------------------------------------------------------------------------------------------------
def hole(height, width, column, radius):
    r, c = np.mgrid[:height, :width]
    return np.hypot(r - height // 2, (c - column + width // 2) % width - width // 2) <= radius


SIZES = [(3, 6), (9, 18), (33, 67), (50, 100), (63, 125), (64, 128), (65, 130)]


@pytest.mark.parametrize("size", SIZES)
def test_texels_outside_the_hole_keep_their_bits(size):
    m = np.exp(np.random.default_rng(1).normal(0, 3, (*size, 3)))
    m[0, 0] = 0
    mask = hole(*size, size[1] - 1, max(1, size[0] // 5))
    result = separation.filled(m, mask)
    assert result[~mask].tobytes() == m[~mask].tobytes()
    assert (result[mask] >= 0).all() and (result[mask] <= m[~mask].max() * (1 + 1e-9)).all()
    other = m.copy()
    other[mask] = 1e9
    np.testing.assert_array_equal(separation.filled(other, mask), result)  # what was there does not matter


@pytest.mark.parametrize("size", [(9, 18), (48, 96), (50, 100), (63, 125), (64, 127), (64, 128), (65, 130)])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_ramp_goes_on_under_a_hole(size, axis):
    """Its logarithm is linear; around the seam, there and back."""
    height, width = size
    r, c = np.mgrid[:height, :width]
    for column in (0, width // 4, width - 2):
        log = 2 * (r / height if axis == 0 else np.abs(2 * ((c - column + width // 4) % width) / width - 1))
        truth = np.exp(log)[..., None] * [1, 0.5, 2]
        mask = hole(height, width, column, max(1, height // 8))
        m = np.where(mask[..., None], 1e6, truth)
        np.testing.assert_allclose(separation.filled(m, mask), truth, rtol=0.03)


def test_nothing_known_is_black_and_nothing_missing_is_the_map():
    m = np.full((5, 7, 3), 3.0)
    assert not separation.filled(m, np.ones((5, 7), bool)).any()
    np.testing.assert_array_equal(separation.filled(m, np.zeros((5, 7), bool)), m)


# ---- survey ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rows", [None, (8, 64)])
def test_a_survey_tells_where_the_lights_are(rows):
    m = discs((toward(40, 0.2), 3, 3e4), (toward(10, 120), 9, 300))
    s = checked(m[8:50] if rows else m, rows)
    assert len(s.lights) == 2 and s.survey.rows == (rows or (0, HEIGHT))
    assert s.survey.label.shape == s.core.shape[:2] and set(np.unique(s.survey.label)) == {-1, 0, 1}
    for i, light in enumerate(s.lights):
        inside = (s.survey.label == i).ravel() & (s.core > 0).any(axis=2).ravel()
        np.testing.assert_array_equal(np.flatnonzero(inside), light.texels)
    lit = s.survey.label >= 0
    np.testing.assert_allclose(s.survey.below[lit], s.background[lit], rtol=1e-6)
    assert checked(sky()).survey is None


def test_a_label_grows_into_what_has_none():
    label = np.full((5, 8), -1)
    label[2, 0], label[2, 4] = 0, 3
    result = separation.grown(label)
    assert (result == 0).sum() == (result == 3).sum() == 9 and (result[1:4, [7, 0, 1]] == 0).all()
    assert result[0].max() == result[4].max() == -1
    label[2, 2] = 1
    result = separation.grown(label)
    assert (result[2, 0], result[2, 4]) == (0, 3), "what a light has it keeps"


# ---- real maps ---------------------------------------------------------------------------------------------

CLEAR = ["autumn_field", "rustig_koppie", "syferfontein_18d_clear"]
SUNNY = [*CLEAR, "kloofendal_48d_partly_cloudy", "sunflowers"]
OVERCAST = ["mud_road", "overcast_soil", "snow_field", "kloppenheim_06"]


def real(data, name):
    return images.load_envmap(data / f"puresky/{name}_puresky_1k.hdr", 256)[0].astype(np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("name", SUNNY)
def test_a_sunny_sky_has_its_sun_and_no_ghost_of_it(name, data):
    m = real(data, name)
    s = checked(m)
    (light,) = s.lights
    assert light.glow is not None
    brightest = np.unravel_index(np.argmax(m @ LUMINANCE), m.shape[:2])
    away = angle(latlong.directions(*m.shape[:2]), light.direction)
    assert away[brightest] < 2
    lum = s.background @ LUMINANCE
    surroundings = np.median(lum[away < 30])
    assert lum.ravel()[light.texels].max() < 4 * surroundings
    assert lum[away < 2.5].max() < 2 * surroundings
    if name in CLEAR:  # in the others there are bright clouds
        assert lum[away < 10].max() < 4 * surroundings
    assert (m @ LUMINANCE)[away < 10].max() > 1000 * surroundings


@pytest.mark.slow
@pytest.mark.parametrize("name", OVERCAST)
def test_an_overcast_sky_has_no_light(name, data):
    assert checked(real(data, name)).lights == []
