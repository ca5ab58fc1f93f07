"""Columns from kept path vertices: those of every path traced anew for every texel, and always the same."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.scene import camera_paths, scene
from envedit.transport import exact_columns, path_vertices
from envedit.transport.exact_columns import Columns, ColumnStore
from envedit.transport.texel_sampling import Grid
from tests.oracles import column_tracer
from tests.oracles.kernels import compiled
from tests.oracles.scenes import HEIGHT, METAL, WIDTH, ball, load, stage

BOUNCES, COUNT, SEED = 3, 8, 3
ROOM = 10**9
# Both poles, both sides of the seam, above and below the horizon.
TEXELS = np.array([5, 4 * WIDTH + 9, 6 * WIDTH + 31, 9 * WIDTH, 10 * WIDTH + 20, 15 * WIDTH + 3])


def columns_of(s, paths_bytes=ROOM, capacity=8, bounces=BOUNCES, seed=SEED):
    grid = Grid(HEIGHT, WIDTH, s.to_world, latlong.solid_angles(HEIGHT, WIDTH))
    return ColumnStore(s, grid, bounces, capacity, seed, paths_bytes)


def traced(columns, texels=TEXELS, count=COUNT):
    return columns.read(Columns(texels, np.full(len(texels), count)))


def expected(columns, texels=TEXELS, count=COUNT):
    return column_tracer.columns(columns.scene, columns.grid, texels, count, columns.bounces, columns.seed)


@pytest.fixture(scope="module")
def air():
    return load("in the air")


# ---- against columns traced one by one ---------------------------------------------------------------------

SCENES = ["mirror", "pair", "glass", "mitchell filter", "red wall and a lamp"]
CUT_SHORT = [("in the air", 0), ("in the air", 1)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bounces"), [*((name, BOUNCES) for name in SCENES), *CUT_SHORT])
def test_columns_are_those_traced_one_by_one(name, bounces):
    columns = columns_of(load(name), bounces=bounces)
    got, (slow, lost) = traced(columns), expected(columns)
    # Values of some 30 terms, rounded to float32 as a product of six factors: 1e-6 relative.
    np.testing.assert_allclose(got, slow, rtol=1e-6, atol=0)
    assert columns.lost == lost == 0
    assert (slow.max(axis=(1, 2)) > 0).sum() >= (3 if bounces else 1)  # the ground hides others
    other, _ = expected(columns, TEXELS + np.array([1, 1, -1, 1, 1, 1]))
    assert np.abs(got - other).max() > 1e-3 * got.max()  # negative control: one texel further


@pytest.mark.slow
@pytest.mark.parametrize("width", [1, 3])
def test_few_paths(width):
    """Arrays of one element are scalars to Dr.Jit: a single vertex or escape must not count twice."""
    columns = columns_of(scene.load(stage(ball(METAL), film={"width": width, "height": 1})))
    for texels in (TEXELS, TEXELS[1:2]):
        slow, _ = expected(columns, texels, 1)
        np.testing.assert_allclose(traced(columns, texels, 1), slow, rtol=1e-6, atol=0)
    assert slow.any()


def test_a_single_escape():
    """Half of two pixels sees the sky and half the ground: one escape in a picture of 2 x 1."""
    s = load("in the air")
    grid = columns_of(s).grid
    for pixel in range(0, s.width * s.height):
        events = list(camera_paths.trace(s.mi, np.array([pixel]), 1, 0, SEED))
        if dr.any(events[0].active)[0]:
            break
    assert dr.count(events[0].active)[0] == 1
    texels, shares, light, at = path_vertices._escapes(events[0], grid, 1, pixel)
    assert len(texels) == len(shares) == 4 and at.numpy().tolist() == [pixel] * 2
    np.testing.assert_allclose(np.stack([c.numpy() for c in light]), [[1, 0]] * 3, rtol=1e-6)
    assert sum(share.numpy()[0] for share in shares) == pytest.approx(1, rel=1e-6)


# ---- the same bits -----------------------------------------------------------------------------------------


def test_without_memory_for_paths_the_bits_are_the_same(air):
    kept, fresh = columns_of(air), columns_of(air, paths_bytes=0)
    first = traced(kept, TEXELS[:4])
    assert traced(fresh, TEXELS[:4]).tobytes() == first.tobytes()
    assert kept._kept and not fresh._kept and kept.kept_bytes > fresh.kept_bytes == 0
    assert kept.bytes == fresh.bytes == 4 * len(fresh._store)
    assert traced(kept).tobytes() == traced(fresh).tobytes()
    assert traced(kept)[:4].tobytes() == first.tobytes()


def test_a_column_does_not_depend_on_those_beside_it(air, monkeypatch):
    columns = columns_of(air)
    whole = traced(columns).copy()
    alone = columns_of(air)
    for i in (4, 0, 2, 5, 1, 3):
        np.testing.assert_array_equal(traced(alone, TEXELS[i : i + 1])[0], whole[i])
    monkeypatch.setattr(exact_columns, "MOST_VALUES", 1)  # one texel at a time
    assert traced(columns_of(air)).tobytes() == whole.tobytes()
    monkeypatch.setattr(path_vertices, "LANES", 64 * COUNT)  # nine blocks of pixels in place of one
    blocks = columns_of(air)
    assert traced(blocks).tobytes() == whole.tobytes()
    assert len(blocks._kept[COUNT]) == 9


@pytest.mark.slow
def test_a_column_is_that_of_its_paths_and_seed(air):
    columns = columns_of(air)
    first = traced(columns)
    other = traced(columns_of(air, seed=SEED + 1))
    assert (first != other).mean() > 0.1
    np.testing.assert_allclose(first.sum(), other.sum(), rtol=0.2)
    few = traced(columns, count=2)
    assert (few != first).mean() > 0.1
    np.testing.assert_allclose(few.sum(), first.sum(), rtol=0.3)
    assert traced(columns).tobytes() == first.tobytes()


@pytest.mark.slow
def test_columns_that_made_room_come_back_with_the_same_bits(air, monkeypatch):
    columns, wide = columns_of(air, capacity=4), columns_of(air)
    texels, paths = TEXELS, np.array([COUNT, COUNT, COUNT, 2, 2, 2])
    wanted = wide.read(Columns(texels, paths)).tobytes()
    bound = columns.bind(Columns(texels[:3], paths[:3]))
    assert columns.bind(Columns(texels[:3], paths[:3]), bound) is bound
    assert columns.read(Columns(texels, paths)).tobytes() == wanted  # more than there is room for
    again = columns.bind(Columns(texels[:3], paths[:3]), bound)
    assert again is not bound and len(set(again.slots)) == 3
    assert columns.read(Columns(texels, paths)).tobytes() == wanted

    # Those used least lately make room: the first three were, the one beside them was not.
    columns.read(Columns(texels[3:4], paths[3:4]))
    columns.bind(Columns(texels[:3], paths[:3]), again)
    columns.read(Columns(texels[4:5], paths[4:5]))
    with monkeypatch.context() as patch:
        patch.setattr(path_vertices, "column_values", lambda *_: 1 / 0)
        columns.read(Columns(texels[:3], paths[:3]))
        with pytest.raises(ZeroDivisionError):
            columns.read(Columns(texels[3:4], paths[3:4]))


# ---- memory ------------------------------------------------------------------------------------------------


def size_of(value):
    """Return the bytes of arrays on the device, of structures and lists of them too."""
    kind = type(value)
    if dr.is_array_v(kind) and dr.depth_v(kind) == 1:
        return dr.itemsize_v(value) * len(value)
    if members := getattr(kind, "DRJIT_STRUCT", None):
        return sum(size_of(getattr(value, name)) for name in members)
    return sum(size_of(part) for part in value)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pair", "in the air"])
def test_memory_of_kept_paths_is_what_is_stated(name):
    columns = columns_of(load(name))
    traced(columns)
    blocks = columns._kept[COUNT]
    real = sum(size_of([b.hits, b.throughput, b.bounce, b.path, b.pixel]) for b in blocks)
    real += sum(size_of([b.texels, b.shares, b.light, b.at]) for b in blocks)
    assert real <= sum(b.bytes for b in blocks) <= 1.25 * real
    assert columns.kept_bytes == sum(b.bytes for b in blocks)


@pytest.mark.slow
def test_kept_paths_stay_within_their_memory(air, monkeypatch):
    monkeypatch.setattr(path_vertices, "LANES", 64 * COUNT)
    needed = columns_of(air)
    first = traced(needed).tobytes()
    need = needed.kept_bytes
    for room, keeps in ((need, True), (need - 1, False), (need // 2, False)):
        columns = columns_of(air, paths_bytes=room)
        assert traced(columns).tobytes() == first
        assert (COUNT in columns._kept) is keeps
        assert columns.kept_bytes <= room
    # Paths of another number share the memory.
    columns = columns_of(air, paths_bytes=int(1.5 * need))
    for count, kept in ((COUNT, [COUNT]), (2, [COUNT, 2]), (COUNT + 1, [COUNT, 2])):
        traced(columns, count=count)
        assert list(columns._kept) == kept
        assert columns.kept_bytes <= int(1.5 * need)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["in the air", "pair"])
def test_no_number_of_vertices_needs_its_own_kernels(name, monkeypatch):
    monkeypatch.setattr(path_vertices, "LANES", 200 * COUNT)  # two blocks of 200 pixels and one of 176
    columns, other = columns_of(load(name)), columns_of(load(name), seed=SEED + 1)
    compiled(lambda: columns.warm_up(TEXELS[1], (COUNT,)))
    for store, texels in ((columns, TEXELS[1:2]), (other, TEXELS), (columns, TEXELS[3:5])):
        launched, fresh = compiled(lambda s=store, t=texels: s.bind(Columns(t, np.full(len(t), COUNT))))
        assert launched > 10 and fresh == 0
    assert len(other._kept[COUNT]) == 3


# ---- what is not finite ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_contributions_that_are_not_finite_are_left_out_and_counted(air, monkeypatch):
    columns = columns_of(air)
    clean, real = traced(columns).copy(), path_vertices.connect
    (block,) = columns._kept[COUNT]
    bad = block.vertices // 2

    def connect(*arguments):
        value = real(*arguments)
        return dr.select(dr.arange(mi.UInt32, block.vertices) == bad, dr.nan, value)

    monkeypatch.setattr(path_vertices, "connect", connect)
    columns = columns_of(air)
    got = traced(columns)
    assert columns.lost == len(TEXELS)  # one vertex, every texel
    pixel = int(np.array(block.pixel)[bad])
    others = np.arange(clean.shape[1]) != pixel
    np.testing.assert_array_equal(got[:, others], clean[:, others])
    assert np.isfinite(got).all() and (got[:, pixel] <= clean[:, pixel]).all()


@pytest.mark.slow
def test_escapes_that_are_not_finite_are_left_out_and_counted(monkeypatch):
    s, real = load("in the air"), path_vertices.bsdf_weight
    columns = columns_of(s)
    clean = traced(columns).copy()

    def spoiled(pdf, sampled):
        value = real(pdf, sampled)
        return dr.select(dr.arange(mi.UInt32, dr.width(value)) % 2 == 0, dr.nan, value)

    monkeypatch.setattr(path_vertices, "bsdf_weight", spoiled)
    columns = columns_of(s)
    got = traced(columns)
    (block,) = columns._kept[COUNT]
    bad = ~np.isfinite([c.numpy() for c in block.light]).all(axis=0)
    around, shares = (np.stack([v.numpy() for v in tap]) for tap in (block.texels, block.shares))
    hits = (np.isin(around, TEXELS) & (shares > 0) & bad).sum()
    assert columns.lost == hits > 0
    assert np.isfinite(got).all() and got.sum() < clean.sum()
