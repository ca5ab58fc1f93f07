"""Light transport against Mitsuba's path tracer, against integrals, and against itself."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core import shipped
from envedit.core.errors import InputError
from envedit.renderers import StoredRenderer
from envedit.scene import scene
from envedit.transport.block_transport import Overview
from envedit.transport.exact_columns import Columns
from envedit.transport.sampling_plan import COLUMN_PATHS, FEW_PATHS, FEW_TOLERANCE
from tests.oracles.kernels import compiled
from tests.oracles.plain import lookup
from tests.oracles.scenes import (
    HEIGHT,
    LAMP,
    METAL,
    SCENES,
    SEEDS,
    WALL,
    WHITE,
    WIDTH,
    ball,
    black,
    build,
    dot,
    load,
    noise,
    one_hot,
    picture,
    references,
    refined,
    stage,
    sun,
)
from tests.oracles.statistics import disagreement

pytestmark = pytest.mark.usefixtures("own_core")

# ---- scenes ------------------------------------------------------------------------------------------------


SUNS = {
    "the horizon": (HEIGHT // 2 - 1, 9),
    "the seam, first column": (4, 0),
    "the seam, last column": (5, WIDTH - 1),
    "the pole": (0, 5),
}
EVERY_SUN = ("turned and cropped", "in the air")
SUNS_BELOW = {"below the horizon": (HEIGHT // 2, 22), "the lower pole": (HEIGHT - 1, 5)}


# ---- Mitsuba's pictures ------------------------------------------------------------------------------------


def test_every_shipped_scene_is_compared():
    assert {value[0] for value in SCENES.values() if isinstance(value, tuple)} == set(shipped.scenes())


SEEN_BY_OTHERS = ("matte", "pair", "mitchell filter", "sphere, alpha 1", "statue")
"""Scenes of other tests; the statue is that of the scene \"mesh\"."""


@pytest.fixture(scope="module", params=[name for name in SCENES if name not in SEEN_BY_OTHERS])
def recorded(request):
    """Return a scene's name, the scene, and independent transports of it."""
    s = load(request.param)
    return request.param, s, [build(s, seed=seed) for seed in range(SEEDS)]


@pytest.mark.slow
def test_pictures_are_those_of_mitsuba(recorded):
    name, s, transports = recorded
    wrong, unseen, some = {}, {}, noise(2, *transports[0].shape)

    def compare(what, image, theirs, sees=1.03):
        ours = np.stack([picture(t, image) for t in transports])
        if text := disagreement(ours, theirs):
            wrong[what] = text
        if not disagreement(sees * ours, theirs):  # negative control
            unseen[what] = sees

    # The coarse tier alone.
    grey = np.full((HEIGHT, WIDTH, 3), 0.7, np.float32)
    compare("grey", grey, references(s, grey), sees=1.02)
    under_noise = references(s, noise())
    compare("noise", noise(), under_noise)
    if name == "mirror":  # negative control: only a mirror sees single texels of a noisy sky
        moved = np.stack([picture(t, np.roll(noise(), 1, axis=1)) for t in transports])
        assert disagreement(moved, under_noise) != ""
    assert_transpose(transports[0], noise(), some)

    # Both tiers. What the pole and the seam do to a texel does not depend on the surface that it lights.
    suns = SUNS | (SUNS_BELOW if name == "in the air" else {})
    if name not in EVERY_SUN:
        some_suns = "the seam, first column", "the seam, last column"
        suns = {what: SUNS[what] for what in some_suns if name == "sphere" or "last" in what}
    for what, (row, column) in suns.items():
        image = sun(row, column)
        transports = [t.resolved(image) for t in transports]
        assert all(row * WIDTH + column in t.columns for t in transports)
        # The plane sees a sun at the horizon at grazing incidence: both renderings are noisier.
        theirs = references(s, refined(image), spp=128)
        compare(f"sun at {what}", image, theirs, sees=1.1 if what == "the horizon" else 1.03)
        assert_transpose(transports[0], image, some)
        if name == "sphere" and what == "the seam, first column":  # negative control: one texel further
            moved = np.roll(image, 1, axis=1)
            others = [t.resolved(moved) for t in transports]
            assert disagreement(np.stack([picture(t, moved) for t in others]), theirs) != ""
    # Columns do not spoil other maps.
    compare("noise through both tiers", noise(), under_noise)
    assert_transpose(transports[0], noise(), some)
    assert not wrong, wrong
    assert not unseen, f"a bias would not have been seen: {unseen}"


@pytest.mark.slow
def test_depth_means_what_it_means_to_mitsuba():
    depth = 3
    film = {"width": 24, "height": 24}
    # Low and level, so that the sky is in view; the light of the lamp is cut at the same depth.
    s = scene.load(stage(ball(WHITE), WALL, LAMP, film=film, origin=(0, 1.2, 7)))
    transports = [build(s, max_depth=depth, seed=seed) for seed in range(SEEDS)]
    # Low contrast: at 64 samples a pixel that sees the fringe of one bright texel is far from normal.
    for image in (1 + noise(), black()):
        ours = np.stack([picture(t, image) for t in transports])
        assert disagreement(ours, references(s, image, depth=depth)) == ""


@pytest.mark.slow
def test_sky_seen_directly_converges_with_every_seed():
    # Were jitter within the pixel and choice among four texels correlated, more samples would not help.
    s = scene.load(stage(film={"width": 12, "height": 12}, origin=(0, 1.2, 7), up=(0, 1, 0)))
    image = noise()
    exact = np.mean(references(s, image, spp=4096, depth=1), axis=0)

    def error(seed, spp):
        return np.sqrt(np.mean((picture(build(s, max_depth=1, seed=seed, spp=spp), image) - exact) ** 2))

    for seed in range(3):
        # 16 times the samples: a quarter of the error; 2.5 leaves room for chance in 144 pixels.
        assert error(seed, 1024) < error(seed, 64) / 2.5


# ---- integrals ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_plane_under_one_texel_receives_its_irradiance():
    # I = albedo / pi * integral of cos(theta) times the texel's tent over the upper hemisphere.
    image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    image[0, 3] = (1e5, 2e5, 3e5)
    v = (np.arange(1500) + 0.5) / 3000  # midpoints; the error is of the order of the step squared
    phi = 2 * np.pi * (np.arange(640) + 0.5) / 640
    theta = np.pi * v[:, None]
    ring = np.sin(theta)
    d = np.stack([ring * np.sin(phi), np.cos(theta) + 0 * phi, -ring * np.cos(phi)], axis=-1)
    measure = np.cos(theta) * np.sin(theta) * (np.pi / 3000) * (2 * np.pi / 640)
    expected = 0.5 / np.pi * (lookup(image, d) * measure[..., None]).sum(axis=(0, 1))

    s = scene.load(stage(origin=(0, 5, 0), up=(0, 0, -1)))
    ours = []
    for seed in range(SEEDS):
        t = build(s, max_depth=2, seed=seed).resolved(image)
        assert len(t.columns) == 1
        ours.append(picture(t, image))
    ours = np.stack(ours)
    assert disagreement(ours, np.broadcast_to(expected, ours.shape), sizes=(4, 0)) == ""
    # Negative control.
    assert disagreement(1.01 * ours, np.broadcast_to(expected, ours.shape), sizes=(0,)) != ""


# ---- a linear operation and its adjoint --------------------------------------------------------------------


@pytest.fixture(scope="module")
def lamp_scene():
    return scene.load(stage(ball(METAL), WALL, LAMP, film={"width": 23, "height": 17}))


@pytest.fixture(scope="module")
def lit(lamp_scene):
    """Transport without columns, for a scene with a lamp, on an odd number of pixels."""
    return build(lamp_scene, spp=32)


@pytest.fixture(scope="module")
def resolved(lamp_scene):
    """The same with exact columns."""
    t = build(lamp_scene, spp=32).resolved(sun(4, 0)).resolved(sun(7, 9)).resolved(noise(), limit=20)
    assert 2 <= len(t.columns) <= 22
    return t


@pytest.fixture(params=["coarse", "with columns"])
def transport(request):
    return request.getfixturevalue("lit" if request.param == "coarse" else "resolved")


def assert_transpose(transport, x, y):
    """Compare <T x, y> and <x, T' y>.

    All terms must be positive: float32 sums of some hundred terms have errors of some 1e-6.
    """
    lit = (picture(transport, x) - picture(transport, black()).astype(np.float64)) * y
    pulled = transport.adjoint(mi.TensorXf(y)).numpy()
    assert lit.sum() > 0
    assert abs(lit.sum() - dot(x, pulled)) <= 1e-5 * lit.sum()


def test_adjoint_is_the_transpose(transport, rng):
    for _ in range(3):
        x = rng.random((HEIGHT, WIDTH, 3), dtype=np.float32)
        y = rng.random((*transport.shape, 3), dtype=np.float32)
        assert_transpose(transport, x, y)
        # Each channel on its own; a mixture of channels would not be seen in the sum.
        only = np.zeros_like(y)
        only[..., 1] = y[..., 1]
        pulled = transport.adjoint(mi.TensorXf(only)).numpy()
        assert (pulled[..., [0, 2]] == 0).all()
        assert_transpose(transport, x, only)


def test_reverse_mode_gives_the_adjoint(transport, rng):
    y = mi.TensorXf(rng.standard_normal((*transport.shape, 3)).astype(np.float32))
    x = mi.TensorXf(rng.random((HEIGHT, WIDTH, 3), dtype=np.float32))
    dr.enable_grad(x)
    dr.backward(dr.sum(transport.apply(x) * y, axis=None))
    np.testing.assert_array_equal(dr.grad(x).numpy(), transport.adjoint(y).numpy())


def test_forward_mode_gives_the_product_without_the_lamp(transport, rng):
    x, v = (rng.random((HEIGHT, WIDTH, 3), dtype=np.float32) for _ in range(2))
    variable = mi.TensorXf(x)
    dr.enable_grad(variable)
    dr.set_grad(variable, mi.TensorXf(v))
    tangent = dr.forward_to(transport.apply(variable)).numpy()
    np.testing.assert_allclose(tangent, transport.linear(mi.TensorXf(v)).numpy(), rtol=1e-5)


def test_linear_is_the_rendering_without_other_lamps(transport, rng):
    x = rng.random((HEIGHT, WIDTH, 3), dtype=np.float32)
    alone, lamp = transport.linear(mi.TensorXf(x)).numpy(), picture(transport, black())
    # The difference cancels digits where the lamp is bright.
    np.testing.assert_allclose(alone, picture(transport, x) - lamp, rtol=1e-5, atol=1e-6 * lamp.max())
    assert lamp.max() > 0.1 * alone.max() > 0  # a lamp that crept in would be seen
    np.testing.assert_array_equal(transport.other_light(), lamp)
    assert (transport.linear(mi.TensorXf(black())).numpy() == 0).all()


def test_several_maps_are_rendered_as_each_is_alone(transport, rng):
    maps = rng.standard_normal((3, HEIGHT, WIDTH, 3)).astype(np.float32)
    together = transport.linear(mi.TensorXf(maps)).numpy()
    apart = np.stack([transport.linear(mi.TensorXf(one)).numpy() for one in maps])
    np.testing.assert_array_equal(together, apart)


# ---- columns -----------------------------------------------------------------------------------------------


def test_texels_that_deserve_it_get_columns(lamp_scene):
    t = build(lamp_scene, spp=32)
    grey = t.resolved(np.ones((HEIGHT, WIDTH, 3), np.float32))
    assert len(grey.columns) == 0  # a grey sky has no error
    image = sun(4, 0)
    image[12, 3] = 1e6  # below the ground: bright, but of no consequence
    lit = t.resolved(image)
    np.testing.assert_array_equal(lit.columns, [4 * WIDTH])
    assert len(t.columns) == 0, "what a transport renders does not change"
    np.testing.assert_array_equal(lit.resolved(image).columns, lit.columns)
    many = t.bright_texels(noise(), tolerance=0.001)
    radiance = noise().reshape(-1, 3).max(axis=1)[many]
    assert len(many) > len(t.bright_texels(noise(), tolerance=0.01))
    assert (np.diff(radiance) <= 0).all()  # brightest first


def test_a_rendering_depends_on_map_and_columns_alone(lamp_scene):
    """Not on what was rendered in between, nor on the order in which columns were asked for."""
    pixels = lamp_scene.width * lamp_scene.height
    base = build(lamp_scene, spp=32, memory_gb=(pixels * 32 * 1.5 * 32 + 12 * 16 * pixels) / 1e9)
    assert base.capacity == 6
    first, second = (base.resolved(noise(seed), tolerance=0) for seed in (0, 1))
    before = [picture(t, noise()) for t in (base, first, second)]
    assert (before[0] != before[1]).any() and (before[1] != before[2]).any()
    for texel in range(2 * WIDTH, 3 * WIDTH):  # more than there is memory for
        base.with_probed(np.array([texel])).apply(noise())
    for t, drawn in zip((base, first, second), before, strict=True):
        np.testing.assert_array_equal(picture(t, noise()), drawn)
    exact = Columns(first.columns[::-1], first.exact.paths[::-1])
    np.testing.assert_array_equal(picture(base.with_columns(exact), noise()), before[1])


@pytest.mark.slow
@pytest.mark.parametrize("rows", [slice(0, HEIGHT), slice(3, 11)])
def test_pictures_of_few_texels_are_those_of_the_whole_map(lamp_scene, rng, rows):
    t = build(lamp_scene, spp=32)
    maps = np.zeros((3, rows.stop - rows.start, WIDTH, 3))
    maps[0, 2, 9] = 5.0, 1.0, 0.1
    maps[1, 1:4, 3:8] = rng.normal(size=(3, 5, 3))  # a derivative has any sign
    for exact in (0, 2, 30):  # coarse texels, both tiers, exact columns alone
        bright = np.ones((HEIGHT, WIDTH, 3), np.float32)
        bright[rows][np.nonzero(maps.any(axis=(0, 3)))] = 1e4
        before = len(t.columns)
        t = t.resolved(bright, limit=exact)
        assert len(t.columns) <= before + exact
        got = t.pictures(maps, rows, most=0)
        assert got.shape == (3, *t.shape, 3) and got.dtype == np.float32 and not got[2].any()
        whole = np.zeros((3, HEIGHT, WIDTH, 3), np.float32)
        whole[:, rows] = maps
        expected = np.stack([t.linear(mi.TensorXf(image)).numpy() for image in whole])
        size = np.stack([t.linear(mi.TensorXf(np.abs(image))).numpy() for image in whole])
        assert np.abs(expected).max() > 0.01
        # Sums of some hundred terms in float32, of any sign: to 1e-5 of the sum of their sizes.
        assert (np.abs(got - expected) <= 1e-5 * size + 1e-12).all(), exact
    assert len(t.columns) >= 16
    assert not t.pictures(0 * maps, rows).any()


def test_main_texels_of_pictures_are_rendered_by_columns(lamp_scene):
    """By those of the fewest paths where there are no better ones; texels with little light by none."""
    t = build(lamp_scene, spp=32).resolved(sun(3, 9))
    better = t.columns[t.exact.paths > t.paths[0]]
    assert len(better) == 1
    maps = np.zeros((1, HEIGHT, WIDTH, 3))
    maps[0, 2, 4:8], maps[0, 3, 9], maps[0, 2, 12] = -1.0, 1.0, 1e-4
    main = [2 * WIDTH + column for column in range(4, 8)] + [3 * WIDTH + 9]
    assert sorted(t.main(maps, slice(0, HEIGHT))) == main
    got = t.pictures(maps, slice(0, HEIGHT))[0]
    whole = np.float32(maps[0])
    by_columns = t.with_probed(np.array(main)).linear(mi.TensorXf(whole)).numpy()
    np.testing.assert_allclose(got, by_columns, rtol=1e-4, atol=1e-6)
    assert np.abs(got - t.linear(mi.TensorXf(whole)).numpy()).max() > 1e-3 * np.abs(got).max()
    assert len(t.columns) == 1
    assert len(t.main(maps, slice(0, HEIGHT), most=2)) == 2


def test_limit_bounds_the_new_columns(lamp_scene):
    t = build(lamp_scene, spp=32)
    image = noise()
    image[4, :3] = 1e4  # lights and mere bright texels are traced differently, and bounded together
    assert len(t.resolved(image, tolerance=0, limit=2).columns) == 2


@pytest.mark.slow
def test_capacity_is_never_exceeded(lamp_scene):
    pixels = lamp_scene.width * lamp_scene.height
    coarse = pixels * 32 * 1.5 * 32 / 1e9
    t = build(lamp_scene, spp=32, memory_gb=coarse + 11 * 16 * pixels / 1e9)
    assert t.capacity == 5
    first = t.resolved(noise(), tolerance=0)
    assert len(first.columns) == 5 and len(set(first.columns)) == 5
    # Texels that are bright now take the places of those that were.
    second = first.resolved(noise(1), tolerance=0)
    assert set(second.columns) == set(t.bright_texels(noise(1), 0)[:5]) != set(first.columns)
    fresh = t.resolved(noise(1), tolerance=0)
    np.testing.assert_array_equal(picture(second, noise()), picture(fresh, noise()))
    none = build(lamp_scene, spp=32, memory_gb=coarse * 1.0001)
    assert none.capacity == 0 and not len(none.resolved(sun(4, 0)).columns)
    assert np.isfinite(none.probe(np.array([9, 10]))).all()
    gradient = none.adjoint(mi.TensorXf(np.ones((*none.shape, 3), np.float32))).numpy()
    assert np.isfinite(picture(none, sun(4, 0))).all() and np.isfinite(gradient).all()


@pytest.mark.slow
def test_columns_of_maps_that_were_bright_lately_stay_longest(lamp_scene):
    """What is compared with a map that was rendered before keeps the columns that it was rendered with."""
    pixels = lamp_scene.width * lamp_scene.height
    t = build(lamp_scene, spp=32, memory_gb=(pixels * 32 * 1.5 * 32 + 11 * 16 * pixels) / 1e9)
    assert t.capacity == 5
    first, second, third = (row * WIDTH + np.array([4, 5]) for row in (2, 3, 4))
    for texels in (first, second, first, third):
        image = np.full((HEIGHT * WIDTH, 3), 1e-3, np.float32)
        image[texels] = 1e4
        t = t.resolved(image.reshape(HEIGHT, WIDTH, 3), tolerance=0.5)
    assert set(first) | set(third) <= set(t.columns)
    assert set(third) <= set(t.with_probed(np.array([9, 10, 11]) + WIDTH * 5).columns)


@pytest.mark.slow
def test_state_brings_back_the_same_bytes(lamp_scene):
    recorded = build(lamp_scene, spp=32)
    renderer = StoredRenderer(recorded, refresh=4)
    image = mi.TensorXf(sun(7, 9))
    for step in (0, 5):  # the second in the next epoch: everything was traced afresh
        drawn = renderer.render(image, step).numpy()
    renderer.transport = renderer.transport.resolved(noise(), limit=5)
    after = picture(renderer.transport, noise())
    copy = StoredRenderer(recorded.resolved(sun(4, 0)), refresh=4)  # with a column of its own, which goes
    copy.restore({key: np.array(value) for key, value in renderer.state().items()})
    np.testing.assert_array_equal(picture(copy.transport, noise()), after)
    np.testing.assert_array_equal(copy.transport.columns, renderer.transport.columns)
    np.testing.assert_array_equal(copy.render(image, 5).numpy(), renderer.render(image, 5).numpy())
    assert (drawn != StoredRenderer(recorded).render(image, 5).numpy()).any()


@pytest.mark.slow
def test_refreshed_transport_is_another_estimate_of_the_same(lamp_scene):
    renderer = StoredRenderer(build(lamp_scene, spp=32), refresh=1)
    # Seeds far apart and many: a refreshed run visits hundreds of epochs.
    ours = [renderer.render(mi.TensorXf(sun(7, 9)), step).numpy() for step in range(0, 80, 10)]
    assert renderer.transport.epoch == 70
    theirs = references(lamp_scene, sun(7, 9))
    assert disagreement(np.stack(ours), theirs) == ""
    assert (ours[0] != ours[1]).any()


def test_probes_are_the_columns_that_render(lamp_scene):
    t = build(lamp_scene, spp=32)
    texels = np.array([4 * WIDTH, 7 * WIDTH + 9, 3 * WIDTH + 31, 2])
    columns, probed = t.probe(texels), t.with_probed(texels)
    assert columns.shape == (4, 17 * 23, 3) and set(probed.columns) == set(texels)
    assert (probed.exact.paths == t.paths[0]).all()
    for texel, column in zip(texels, columns, strict=True):
        drawn = probed.linear(mi.TensorXf(one_hot(texel))).numpy()
        np.testing.assert_array_equal(column.reshape(drawn.shape), drawn)
        assert drawn.max() > 0
        assert (drawn != t.linear(mi.TensorXf(one_hot(texel))).numpy()).any()  # there it is coarse
    np.testing.assert_array_equal(t.probe(texels[::-1])[::-1], columns)


def test_probing_a_texel_that_has_a_better_column_takes_it(lamp_scene):
    t = build(lamp_scene, spp=32).resolved(sun(7, 9))
    texels = np.array([7 * WIDTH + 9, 7 * WIDTH + 10])
    better = t.linear(mi.TensorXf(one_hot(texels[0]))).numpy()
    np.testing.assert_array_equal(t.probe(texels)[0].reshape(better.shape), better)
    assert t.with_probed(texels).exact.paths.tolist() == [COLUMN_PATHS[-1], COLUMN_PATHS[0]]


@pytest.mark.slow
def test_few_paths_for_maps_of_few_parameters(lamp_scene, tmp_path):
    plain = build(lamp_scene, spp=32, folder=tmp_path)
    few = build(lamp_scene, spp=32, folder=tmp_path, few=True)
    assert few.cached  # the recording is the same
    assert (few.paths, few.tolerance) == (FEW_PATHS, FEW_TOLERANCE) != (plain.paths, plain.tolerance)
    for t in (plain, few):
        assert t.resolved(sun(7, 9)).exact.paths.tolist() == [t.paths[-1]]
    assert few.paths[-1] < plain.paths[-1]
    counts = [len(t.bright_texels(noise() ** 4)) for t in (plain, few)]
    assert counts[0] > counts[1]


@pytest.mark.slow
def test_overview_is_t_where_blocks_are_pixels_and_on_disk_has_the_same_bits(
    lamp_scene, rng, tmp_path, monkeypatch
):
    traced = build(lamp_scene, spp=32, folder=tmp_path)
    first, image = traced.overview(), rng.random((HEIGHT, WIDTH, 3), dtype=np.float32)
    seen = np.einsum("cpt,tc->pc", first.matrix, image.reshape(-1, 3))
    np.testing.assert_allclose(seen, traced.linear(mi.TensorXf(image)).numpy().reshape(-1, 3), rtol=1e-4)
    with monkeypatch.context() as patch:
        patch.setattr(Overview, "summed", lambda *_: 1 / 0)
        again = build(lamp_scene, spp=32, folder=tmp_path).overview()
        with pytest.raises(ZeroDivisionError):  # of another recording it is not
            build(lamp_scene, spp=32, seed=1, folder=tmp_path).overview()
    assert vars(first).keys() == vars(again).keys()
    assert (again.blocks, again.cells) == (first.blocks, first.cells)
    for name in ("matrix", "block_of", "cell_of", "directions", "omega"):
        value, loaded = getattr(first, name), getattr(again, name)
        assert loaded.dtype == value.dtype and loaded.shape == value.shape
        assert loaded.tobytes() == value.tobytes(), name
        assert loaded.flags.writeable


# ---- compiled once -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_another_seed_needs_no_other_kernel(lamp_scene):
    # Else every refresh, and every run of a series, would pay seconds of compilation.
    compiled(lambda: build(lamp_scene, spp=32, seed=11).resolved(sun(7, 9)).apply(sun(7, 9)))
    count, fresh = compiled(lambda: build(lamp_scene, spp=32, seed=12).resolved(sun(3, 20)).apply(sun(3, 20)))
    # Where no path of a batch is kept, what it left unevaluated may join a later kernel: one in a hundred.
    assert count > 50 and fresh <= 0.05 * count


# ---- refusals ----------------------------------------------------------------------------------------------


def test_wrong_shapes_are_refused(lit):
    for shape in ((HEIGHT, WIDTH + 2, 3), (WIDTH, HEIGHT, 3), (HEIGHT, WIDTH, 4), (HEIGHT * WIDTH, 3)):
        with pytest.raises(InputError, match=r"map must have shape \(16, 32, 3\), got \("):
            lit.apply(dr.ones(mi.TensorXf, shape))
        for takes_arrays in (lit.resolved, lit.coarse_error):
            with pytest.raises(InputError, match=r"map must have shape \(16, 32, 3\), got \("):
                takes_arrays(np.ones(shape))
    with pytest.raises(InputError, match=r"picture must have shape \(17, 23, 3\), got \(23, 17, 3\)"):
        lit.adjoint(dr.ones(mi.TensorXf, (23, 17, 3)))


@pytest.mark.parametrize("values", [None, "sky.exr", [[1.0], [1.0, 2.0]]])
def test_what_is_no_array_of_numbers_is_refused(lit, values):
    for takes_maps in (lit.apply, lit.resolved, lit.coarse_error):
        with pytest.raises(InputError, match="the map must be an array of numbers, got "):
            takes_maps(values)
    with pytest.raises(InputError, match="the picture must be an array of numbers, got "):
        lit.adjoint(values)


@pytest.mark.slow
def test_too_little_memory_is_told_with_what_to_do(lamp_scene):
    text = r"needs .* GB for 23x17 pixels at 4096 samples.*0.01.*memory_gb.*spp"
    with pytest.raises(InputError, match=text):
        build(lamp_scene, spp=4096, memory_gb=0.01)
    # Left to itself it takes fewer samples.
    t = build(lamp_scene, spp="auto", memory_gb=0.002)
    assert t.spp < 256 and t.memory_bytes < 0.003e9


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"max_depth": 1}, {"max_depth": 0}, {"spp": 0}, {"spp": -4}])
def test_depths_and_samples_that_light_nothing_are_refused(options):
    # The camera of the matte scene sees ground and ball only: a black picture would be the silent result.
    with pytest.raises(ValueError, match="depth|light|spp"):
        build(load("matte"), **options)
