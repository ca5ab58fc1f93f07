"""One variant for all tests, and the way to real data.

The variant is ``llvm_ad_rgb``, or what ``ENVEDIT_VARIANT`` names. Real maps, meshes and weights are found
through ``ENVEDIT_DATA``; a test that needs them asks for the ``data`` fixture and is skipped by name where
the variable is not set.
"""

import os
import threading
from pathlib import Path

import pytest

import envedit  # noqa: F401 -- before numpy, whose threads it limits

pytest.register_assert_rewrite("tests.oracles")


def pytest_configure(config):
    import mitsuba as mi

    mi.set_variant(os.environ.get("ENVEDIT_VARIANT", "llvm_ad_rgb"))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """Two processes for a folder; files and single tests stay in this one, where they are easy to debug."""
    return 2 if any(os.path.isdir(argument) for argument in config.args) else 0


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Leave two cases of a parametrised test in the quick tier: the first and the last."""
    quick = {}
    for item in items:
        if item.get_closest_marker("slow") is None:
            quick.setdefault((item.path, item.originalname), []).append(item)
    for cases in quick.values():
        for case in cases[1:-1]:
            case.add_marker("slow")


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder with puresky/, hdri/, meshes/ and weights/."""
    root = os.environ.get("ENVEDIT_DATA")
    if not root:
        pytest.skip("ENVEDIT_DATA is not set: no real maps on this machine")
    return Path(root)


@pytest.fixture
def rng():
    """A numpy generator with a fixed seed."""
    import numpy as np

    return np.random.default_rng(0)


@pytest.fixture(autouse=True)
def threads_stay():
    """Refuse a test that leaves another number of threads: on one, Mitsuba waits for ever for an EXR file."""
    import drjit as dr

    before = dr.thread_count()
    yield
    # The thread of `envedit paint` has another number while it loads a scene.
    if not any(thread.name == "envedit-paint" for thread in threading.enumerate()):
        assert dr.thread_count() == before


@pytest.fixture(scope="session", autouse=True)
def shared_cache(tmp_path_factory):
    """Keep the user's caches, recent paintings and trained weights out of all tests, which share a cache."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in the temporary folder, which is returned."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """Keep what is cached on disk to this test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def isolated(tmp_path_factory):
    """Keep caches to this test, and do not probe a machine that runs these very tests."""
    from tests.oracles.runs import small_world

    with small_world(tmp_path_factory.mktemp("cache")):
        yield


@pytest.fixture(scope="module")
def own_core():
    """Have no more threads than this process has cores: more wait for those of other tests in loops.

    Not for tests in which Mitsuba itself reads an EXR file.
    """
    import drjit as dr

    before, processes = dr.thread_count(), int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    dr.set_thread_count(max(1, before // processes))
    yield
    dr.sync_thread()
    dr.set_thread_count(before)


@pytest.fixture
def threads():
    """Set the number of threads; it is as before at the end."""
    import drjit as dr

    before = dr.thread_count()

    def use(count):
        dr.sync_thread()
        dr.set_thread_count(count)

    yield use
    use(before)
