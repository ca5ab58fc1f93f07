"""An edit carried to the source: the same light, the source's own detail, and nothing else touched."""

import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.errors import NumericalError
from envedit.core.rotations import rotation_vector
from envedit.core.rows import Rows
from envedit.export import full_resolution, texel_maps
from envedit.representations import Pixels
from envedit.representations.layers import layers
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import DARK, LOBE_DEGREES
from tests.oracles.builders import grey
from tests.oracles.devices import on_cpu
from tests.oracles.maps import angle, flux, toward
from tests.oracles.plain import lookup

WORKING, ROWS = (64, 128), (0, 32)


def sky(height, width, sun=(25.0, 200.0), radius=1.0, peak=2e4, glow=True, seed=0):
    """A blue sky with detail of its own, a disc of a sun and a glow."""
    d = latlong.directions(height, width)
    m = (0.4 + 0.3 * d[..., 1:2]) * [0.5, 0.7, 1.0]
    m = m * np.exp(0.2 * np.random.default_rng(seed).standard_normal((height, width, 1)))
    if sun:
        away = angle(d, toward(*sun))[..., None]
        m = m * (1 + 4 * np.exp(-away / 10) * (away < 60)) if glow else m
        m = np.where(away <= radius, peak * np.array([1, 0.9, 0.7]), m)
    return m.astype(np.float32)


def near(shape, v, degrees):
    return angle(latlong.directions(*shape), v) < degrees


def small(source, size=WORKING):
    return latlong.resize(source, *size)


def encoded(working, rows=ROWS, free=None, aureoles=True):
    first, count = rows
    image = working[first : first + count]
    made = Layers.of(image, (first, len(working)), aureoles=aureoles).keeping(free)
    return made, {k: v.numpy().copy() for k, v in made.start().items()}


def sent(made, params, v, light=0):
    params = {k: v.copy() for k, v in params.items()}
    params["turn"][light] = rotation_vector(made.lights.centres[light], v) / layers.SCALES["turn"]
    return params


def carried(made, params, working, source, rows=ROWS, free=None):
    params = {k: mi.TensorXf(v) for k, v in params.items()}
    edited = working.copy()
    edited[rows[0] : rows[0] + rows[1]] = made.decode(params).numpy()
    before = source.copy()
    result = full_resolution.carry(made, params, working, edited, source, Rows(*rows, len(working)), free)
    np.testing.assert_array_equal(source, before)  # the caller's own
    assert result.shape == source.shape and result.dtype == np.float32
    assert np.isfinite(result).all() and (result >= 0).all()
    return result, edited


def active(source, rows=ROWS, total=WORKING[0]):
    """Rows of a source that belong to active rows of the working map."""
    height = len(source)
    nearest = np.rint(np.arange(height) * ((total - 1) / (height - 1)))
    return (nearest >= rows[0]) & (nearest < sum(rows))


@pytest.fixture(scope="module")
def sunny():
    source = sky(256, 512)
    working = small(source)
    made, params = encoded(working)
    assert len(made.separation.lights) == 1 and made.lights.glowing
    return source, working, made, params


# ---- layers: what stays ------------------------------------------------------------------------------------
@pytest.mark.parametrize("band", [1 << 21, 700, 5120])
def test_no_edit_is_the_source_bit_for_bit(sunny, band, monkeypatch):
    monkeypatch.setattr(texel_maps, "BAND_TEXELS", band)
    source, working, made, params = sunny
    assert carried(made, params, working, source)[0].tobytes() == source.tobytes()


def test_a_red_sun_leaves_no_stain_in_the_sky_and_stays_red():
    source = sky(256, 512, glow=False)
    sun = near(source.shape[:2], toward(25, 200), 1.0)
    source[sun] = [6500, 1000, 0]
    working = small(source)
    made, params = encoded(working)
    (light,) = made.separation.lights
    assert light.hidden.any()
    np.testing.assert_array_equal(carried(made, params, working, source)[0], source)

    # ---- Where it was, all channels are those of the sky around, at both resolutions
    result, edited = carried(made, sent(made, params, toward(60, 60)), working, source)
    for image in (result, edited):
        shape = image.shape[:2]
        around = near(shape, toward(25, 200), 12) & ~near(shape, toward(25, 200), 6)
        covered = near(shape, toward(25, 200), 2)
        np.testing.assert_allclose(image[covered].mean(axis=0), image[around].mean(axis=0), rtol=0.15)
        assert (image[covered] > 0.5 * np.median(image[around], axis=0)).all()

    # ---- Dimmed to half where it is, half of what it hides comes back
    half = {name: value.copy() for name, value in params.items()}
    half["flux"][0] = np.log(0.5) / layers.SCALES["flux"]
    dimmed, _ = carried(made, half, working, source)
    np.testing.assert_allclose(dimmed[sun][:, 2], 0.5 * result[sun][:, 2], rtol=0.01)


@pytest.mark.slow
def test_bands_do_not_show(sunny, rng, monkeypatch):
    source, working, made, params = sunny
    params = sent(made, params, toward(50, 90))
    params["gain.1"] += rng.normal(size=params["gain.1"].shape).astype(np.float32)
    whole = carried(made, params, working, source)[0]
    for band in (512 * 7, 512 * 50):
        monkeypatch.setattr(texel_maps, "BAND_TEXELS", band)
        np.testing.assert_allclose(carried(made, params, working, source)[0], whole, rtol=1e-4)


@pytest.mark.slow
def test_inactive_rows_keep_their_bits(rng):
    source = sky(256, 512)
    working, rows = small(source), (5, 25)
    made, params = encoded(working, rows)
    params = sent(made, params, toward(40, 90))
    params["gain.0"] += rng.normal(size=params["gain.0"].shape).astype(np.float32)
    result, _ = carried(made, params, working, source, rows)
    inside = active(source, rows)
    np.testing.assert_array_equal(result[~inside], source[~inside])
    assert (result[inside] != source[inside]).any(axis=2).mean() > 0.9


def test_kept_texels_keep_their_gain_and_their_neighbours_fall_off(rng):
    source = sky(256, 512, sun=None)
    working, free = small(source), np.ones((32, 128), bool)
    free[10:20, 30:60] = False
    made, params = encoded(working, free=free)
    params["gain.0"] += 1.0
    params["saturation"] = np.full((1, 1), -1, np.float32)
    result, _ = carried(made, params, working, source)
    nearest = np.rint(np.arange(256) * (63 / 255)).astype(int)
    kept = ~free[np.minimum(nearest, 31)][:, np.arange(512) // 4] & active(source)[:, None]
    np.testing.assert_array_equal(result[kept], source[kept])
    ratio = (result / source)[..., 1]
    assert ratio[100, 300] > 1.9
    across = ratio[60, 236:250]  # from a kept texel to a free one that touches it and the next
    assert across[0] == 1 and across[-1] > 1.9 and (np.diff(across) < 0.7).all() and (across[4:7] < 1.9).all()


def test_texels_far_from_a_moved_light_without_glow_keep_their_bits():
    source = sky(256, 512, glow=False)
    working = small(source)
    made, params = encoded(working, aureoles=False)
    assert not made.lights.glowing
    old, new = made.lights.centres[0], toward(50, 90)
    result, _ = carried(made, sent(made, params, new), working, source)
    far = ~near(source.shape[:2], old, 12) & ~near(source.shape[:2], new, 12)
    np.testing.assert_array_equal(result[far], source[far])
    assert (result[~far] != source[~far]).mean() > 0.02


# ---- layers: what changes ----------------------------------------------------------------------------------
@pytest.mark.parametrize("value", [-1.0, 0.7])
def test_an_even_gain_is_the_formula(value):
    source = sky(128, 256, sun=None)
    working = small(source)
    made, params = encoded(working)
    params["gain.0"] += value
    result, _ = carried(made, params, working, source)
    factor, inside = np.exp(value), active(source)
    grey_ = source * 0.8 + (source @ [0.212671, 0.715160, 0.072169])[..., None] * 0.2
    expected = source * factor if value < 0 else source + (factor - 1) * grey_
    np.testing.assert_allclose(result[inside], expected[inside], rtol=1e-4)


def test_a_gain_lies_where_it_lay(rng):
    """The factor at the source's texels is that of the working map, interpolated."""
    source = np.full((256, 512, 3), 0.7, np.float32)
    working = small(source)
    made, params = encoded(working)
    for k in range(3):
        params[f"gain.{k}"] += 0.3 * rng.normal(size=params[f"gain.{k}"].shape).astype(np.float32)
    result, edited = carried(made, params, working, source)
    expected = lookup(edited, latlong.directions(256, 512))
    inside = active(source, (1, 30))  # not at the pole, where a row has one value in all columns
    np.testing.assert_allclose(result[inside], expected[inside], rtol=0.005)
    shifted = np.roll(expected, 6, axis=1)
    assert np.abs(result[inside] / shifted[inside] - 1).max() > 0.05  # negative control


@pytest.mark.slow
@pytest.mark.parametrize("where", [(50, 90), (20, 1), (80, 300), (35, 230)])
def test_a_moved_sun_keeps_its_flux_and_stays_sharp(sunny, where):
    source, working, made, params = sunny
    old, new = made.lights.centres[0], toward(*where)
    result, edited = carried(made, sent(made, params, new), working, source)
    np.testing.assert_allclose(flux(result), flux(edited), rtol=0.005)
    there = near(source.shape[:2], new, 6), near(WORKING, new, 6)
    np.testing.assert_allclose(flux(result, there[0]), flux(edited, there[1]), rtol=0.01)
    # The disc: as bright as it was, where the working map has spread it over a texel of 2.8 degrees.
    if where[0] < 60:
        assert result.max() > 0.8 * source.max()
    assert edited.max() < 0.6 * source.max()
    peak = latlong.directions(256, 512).reshape(-1, 3)[result[..., 1].argmax()]
    assert angle(peak, new) < 1.5
    if angle(old, new) > 40:
        left = near(source.shape[:2], old, 8)
        assert result[left].max() < 8 * np.median(result[left])  # no ghost
        assert source[left].max() > 1e3 * np.median(source[left])


@pytest.mark.slow
def test_no_outline_is_left_of_a_smooth_light():
    """An aureole that the region of the light cuts off: no edge where it was nor where it has gone."""
    height, width = 512, 1024
    d, v = latlong.directions(height, width), toward(30, 200.3)
    away = angle(d, v)[..., None]
    source = (0.3 + 3000 * np.exp(-((away / 1.2) ** 2)) + 3 * np.exp(-away / 3)) * np.float32([1, 1, 1])
    source = source.astype(np.float32)
    working = small(source, (128, 256))
    made, params = encoded(working, (0, 64))
    new = toward(30, 100.3)
    result, _ = carried(made, sent(made, params, new), working, source, (0, 64))
    log = np.log(result[..., 1])

    def steepest(m, v):
        inside = near((height, width), v, 12)
        steps = np.abs(np.diff(m, axis=1, append=m[:, :1])), np.abs(np.diff(m, axis=0, append=m[-1:]))
        return max(s[inside].max() for s in steps)

    was = steepest(np.log(source[..., 1]), v)
    assert steepest(log, v) < 0.15 < was
    assert steepest(log, new) < 1.2 * was


def test_a_light_that_stays_is_scaled_in_place(sunny):
    source, working, made, params = sunny
    changed = {k: v.copy() for k, v in params.items()}
    changed["flux"][0] = np.log(0.25)
    result, edited = carried(made, changed, working, source)
    disc = source.max(axis=2) > 1e4
    np.testing.assert_allclose(result[disc], 0.25 * source[disc], rtol=0.01)
    np.testing.assert_allclose(flux(result), flux(edited), rtol=0.005)
    changed["flux"][0] = DARK
    result, edited = carried(made, changed, working, source)
    assert result[disc].max() < 5
    np.testing.assert_allclose(flux(result), flux(edited), rtol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.03, 0.5, 3.0])
@pytest.mark.parametrize("width", [256, 1024])
def test_a_light_that_was_added_is_a_round_gaussian(width, degrees):
    shape = width // 2, width
    source = np.zeros((*shape, 3), np.float32)
    made, params = encoded(small(source))
    for elevation in (8.3, 41.7, 79.2):
        new = toward(elevation, 61.3)
        changed = sent(made, params, new)
        changed["flux"][0] = 0.0
        changed["size"][0] = np.log(degrees / LOBE_DEGREES) / layers.SCALES["size"]
        result, _ = carried(made, changed, small(source), source)
        seen = active(source)
        whole = flux(result) / made.lights.flux[0]
        assert np.ptp(whole) < 1e-5
        if elevation > 20:  # none of it falls on rows that are not edited
            np.testing.assert_allclose(whole, 1, rtol=1e-4)
        radius = np.hypot(max(degrees, np.exp(-6) * LOBE_DEGREES), 0.6 * 180 / (shape[0] - 1))
        chord = np.degrees(np.linalg.norm(latlong.directions(*shape) - new, axis=2))
        expected = np.exp(-0.5 * np.square(chord / radius)) * seen[:, None]
        expected *= result.max() / expected.max()
        np.testing.assert_allclose(result[..., 0], expected, atol=2e-4 * result.max())


@pytest.mark.slow
def test_an_added_light_brings_the_glow_of_the_maps_sun(sunny):
    """As bright as the sun, in its mirror image: the sky around it is as bright as the sun's, and no more."""
    source, working, made, params = sunny
    new, added = toward(25, 20), made.lights.own
    changed = sent(made, params, new, light=added)
    changed["flux"][added] = 0.0
    result, edited = carried(made, changed, working, source)
    for image, before in ((result, source), (edited, working)):
        away = angle(latlong.directions(*image.shape[:2]), new)
        for degrees in (10, 20, 40):
            ring = (np.abs(away - degrees) < 2) & active(image)[:, None]
            ratio = np.float64(image)[ring].mean() / before[ring].mean()
            assert ratio == pytest.approx(1 + 4 * np.exp(-degrees / 10), rel=0.12), degrees
    changed["flux"][added] = DARK
    result, _ = carried(made, changed, working, source)
    np.testing.assert_array_equal(result, source)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(64, 128), (48, 96), (101, 202), (300, 512)])
def test_sources_of_any_size(sunny, shape):
    source, working, made, params = sunny
    source = latlong.resize(source, *shape)
    result, edited = carried(made, sent(made, params, toward(40, 90)), working, source)
    np.testing.assert_allclose(flux(result), flux(edited), rtol=0.03)
    assert carried(made, params, working, source)[0].tobytes() == source.tobytes()


def test_black_maps_and_huge_values():
    for value in (0.0, 1e-30, 65504.0, 1e6):
        source = grey(value, 128, 256)
        working = small(source)
        made, params = encoded(working)
        params["gain.0"] += 0.5
        result, edited = carried(made, params, working, source)
        np.testing.assert_allclose(result[4], np.repeat(edited[1], 2, axis=0), rtol=1e-4)


def test_what_is_not_finite_is_refused(sunny):
    source, working, made, params = sunny
    broken = source.copy()
    broken[40, 70, 1] = np.nan
    with pytest.raises(NumericalError, match="row 40, column 70"):
        carried(made, sent(made, params, toward(40, 90)), working, broken)


# ---- other representations ---------------------------------------------------------------------------------
def ratio(working, edited, source, rows=ROWS, free=None):
    result = full_resolution.carry(Pixels(), {}, working, edited, source, Rows(*rows, len(working)), free)
    assert result.dtype == np.float32 and np.isfinite(result).all() and (result >= 0).all()
    return result


def around(m):
    padded = np.pad(np.pad(m, ((1, 1), (0, 0), (0, 0)), mode="edge"), ((0, 0), (1, 1), (0, 0)), mode="wrap")
    shifts = [(r, c) for r in (0, 1, 2) for c in (0, 1, 2)]
    return np.max([padded[r : r + m.shape[0], c : c + m.shape[1]] for r, c in shifts], axis=0)


def noise(rng, size=0.3):
    edit = np.ones((*WORKING, 3), np.float32)
    edit[:32] = np.exp(size * rng.standard_normal((32, WORKING[1], 3)))
    return edit


def sun_turned(working):
    return np.concatenate([np.roll(working[:32], 40, axis=1), working[32:]])


EDITS = ["noise", "strong noise", "a turned sun", "one texel", "black", "from black"]


@pytest.mark.parametrize("edit", EDITS)
def test_means_are_those_of_the_edited_map(edit, rng):
    source = sky(256, 512)
    if edit == "from black":
        source[:100] = 0
    working = small(source)
    edited = working.copy()
    if edit == "one texel":
        edited[12, 30] = [50, 3, 1]
    elif edit == "black":
        edited[5:20] = 0
    elif edit == "a turned sun":
        edited = sun_turned(working)
    elif edit == "from black":
        edited[3:9, 20:40] = rng.random((6, 20, 3)).astype(np.float32)
    else:
        edited = working * noise(rng, 0.3 if edit == "noise" else 1.5)
    result = ratio(working, edited, source)
    off = np.abs(small(result) - edited) / np.maximum(around(edited), 1e-3 * edited.mean())
    if edit == "black":  # its first and last row share source texels with rows that stay
        assert off[[4, 5, 19, 20]].max() > 0.01
        off[[5, 19]] = 0
    assert off.max() < 0.01
    if edit != "black":
        np.testing.assert_allclose(flux(result), flux(edited), rtol=0.003)
    assert np.abs(small(source) - edited).max() > 0.1  # negative control


@on_cpu
@pytest.mark.slow
@pytest.mark.parametrize("row", range(8, 12))
def test_bands_do_not_show_beside_a_lamp_that_is_put_out(row, monkeypatch):
    source = sky(256, 512)
    working = small(source)
    edited = working * np.float32(1.01)
    edited[row, 30] = 1e-3 * working[row, 30]
    whole = ratio(working, edited, source)
    for rows in (1, 5):
        monkeypatch.setattr(texel_maps, "BAND_TEXELS", rows * 512)
        np.testing.assert_allclose(ratio(working, edited, source), whole, rtol=1e-5)


def test_equal_working_texels_are_the_source_bit_for_bit(rng):
    source = sky(256, 512)
    working = small(source)
    edited = sun_turned(working)
    same = rng.random(WORKING) < 0.5
    edited[same] = working[same]
    result = ratio(working, edited, source)
    row, column = np.rint(np.arange(256) * (63 / 255)).astype(int), np.arange(512) // 4
    kept = same[row][:, column]
    np.testing.assert_array_equal(result[kept], source[kept])
    assert ratio(working, working, source).tobytes() == source.tobytes()
    none = ratio(working, edited, source, free=np.zeros((32, 128), bool))
    assert none.tobytes() == source.tobytes()
    few = ratio(working, edited, source, (3, 10))
    np.testing.assert_array_equal(few[~active(source, (3, 10))], source[~active(source, (3, 10))])
    assert (few != source).any()


def test_detail_is_kept_under_a_smooth_edit(rng):
    source = sky(256, 512, sun=None)
    working = small(source)
    edited = working.copy()
    edited[:32] *= 1.4
    result = ratio(working, edited, source)
    inside = active(source, (0, 31))
    np.testing.assert_allclose(result[inside], 1.4 * source[inside], rtol=0.01)


def test_a_sun_that_is_gone_leaves_no_ghost():
    source = sky(512, 1024, radius=0.4)
    working = small(source)
    edited = sun_turned(working)
    result, old = ratio(working, edited, source), near((512, 1024), toward(25, 200), 6)
    assert result[old].max() < 4 * np.median(result[old]) and source[old].max() > 1e4 * np.median(source[old])


# ---- rows below the horizon that follow --------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("finer", [2, 4])
@pytest.mark.parametrize("kind", ["mirror", "keep"])
@pytest.mark.parametrize("saturation", [None, -0.7])
def test_rows_that_follow_are_carried_and_join_at_the_horizon(kind, finer, saturation):
    """Of a map whose lower half is the mirror of its sky, the sun moved; against the working map."""
    height, width = WORKING[0] * finer, WORKING[1] * finer
    up = sky(height, width, sun=(20.0, 200.0), seed=1)[: height // 2]
    source = np.concatenate([up, np.minimum(up[::-1], 3)])
    working = latlong.resize(source, *WORKING)
    made = Layers.of(working, horizon=kind)
    params = made.start()
    turn = np.zeros((made.lights.count, 3))
    turn[0] = rotation_vector(made.lights.centres[0], toward(25.0, 90.0))
    params = params | {"turn": mi.TensorXf(np.float32(turn / made.scales["turn"]))}
    if saturation is not None:
        params["saturation"] = mi.TensorXf(np.full((1, 1), saturation, np.float32))
    edited = made.decode(params).numpy()
    full = full_resolution.carry(made, params, working, edited, source, Rows.of(WORKING[0]))
    assert full.shape == source.shape and np.isfinite(full).all()
    small = latlong.resize(full, *WORKING)
    low = slice(WORKING[0] // 2, None)
    ratio = np.log(small[low] / edited[low])
    assert np.abs(ratio).mean() < 0.02 and np.abs(np.log(edited[low] / working[low])).max() > 0.1
    # The factor of the edit has no edge: across the horizon it steps no more than from row to row beside it.
    change = np.log(full / source).mean(axis=2)
    steps = np.abs(np.diff(change, axis=0)).mean(axis=1)
    middle = height // 2 - 1
    beside = np.r_[steps[middle - 4 : middle], steps[middle + 1 : middle + 5]]
    assert steps[middle] < 3 * max(beside.max(), 1e-3)


@pytest.mark.parametrize("added", [False, True])
def test_a_light_that_sets_is_cut_off_by_the_horizon(added):
    height, width = 2 * WORKING[0], 2 * WORKING[1]
    source = np.minimum(sky(height, width, sun=None), 1)
    source[: height // 2] = sky(height, width, sun=(40.0, 200.0), radius=4.0, glow=False)[: height // 2]
    working = latlong.resize(source, *WORKING)
    made = Layers.of(working, horizon="keep", aureoles=False)
    light = 1 if added else 0
    start = {name: value.numpy().copy() for name, value in made.start().items()}
    start["flux"][:2] = DARK
    start["flux"][light] = 0.0
    start["size"][light] = np.log(4 / LOBE_DEGREES) / layers.SCALES["size"] if added else 0.0
    shown = []
    for elevation in (30.0, 0.0):
        placed = sent(made, start, toward(elevation, 90.0), light)
        params = {name: mi.TensorXf(value) for name, value in placed.items()}
        _, core = made.parts(params)
        edited = made.decode(params).numpy()
        full = full_resolution.carry(made, params, working, edited, source, Rows.of(WORKING[0]))
        assert not core.numpy()[WORKING[0] // 2 :].any()
        assert full[height // 2 :].max() < 5
        shown.append([flux(core.numpy()), flux(np.where(full > 100, full, 0))])
    np.testing.assert_allclose(np.divide(shown[1], shown[0]), 0.5, atol=0.1)  # at both sizes
