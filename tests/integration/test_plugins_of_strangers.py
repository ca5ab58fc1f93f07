"""A shared object beside a scene, or in the working folder, does not run: plugins are Mitsuba's own."""

import ctypes
import os
import shutil
import subprocess
import sys

import mitsuba as mi
import pytest

from envedit.core import installed_plugins
from envedit.core.errors import InputError
from envedit.scene import scene
from tests.oracles import ROOT
from tests.oracles.builders import BALL, LIGHT, SENSOR, write_scene

# Names of what a rendering of the shipped scene builds, and one that Mitsuba does not have.
OVERRIDDEN = ["sphere", "rectangle", "ply", "diffuse", "envmap", "path", "multijitter", "hdrfilm"]
OVERRIDDEN += ["perspective", "evil"]
SOURCE = """
#include <stdio.h>
#include <stdlib.h>
__attribute__((constructor)) static void run(void) {
    FILE *file = fopen(getenv("MARK"), "a");
    if (file) { fputs("ran\\n", file); fclose(file); }
}
"""
# The children have no package but what the tests' interpreter has, and no working folder on their path.
CHILD = """
import sys
sys.path.append({root!r})
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import numpy as np
from envedit.images import analytic_sky
from envedit.scene import scene
sky = analytic_sky.sunsky(8, 30.0, 40.0, 3.0)
for file in sys.argv[1:]:
    lit = scene.load(file, 8, 8)
    assert lit.render(sky, 1).max() > 0
print("rendered")
"""


@pytest.fixture(scope="module")
def shared_object(tmp_path_factory):
    """A shared object whose constructor writes into the file that $MARK names."""
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if compiler is None:
        pytest.skip("no C compiler: a shared object cannot be made")
    folder = tmp_path_factory.mktemp("evil")
    (folder / "evil.c").write_text(SOURCE)
    built = folder / "evil.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", built, folder / "evil.c"], check=True)
    return built


@pytest.fixture
def mark(tmp_path, monkeypatch):
    monkeypatch.setenv("MARK", str(tmp_path / "mark"))
    return tmp_path / "mark"


def provide(shared_object, folder):
    (folder / "plugins").mkdir()
    for name in OVERRIDDEN:
        shutil.copy(shared_object, folder / "plugins" / f"{name}.so")


@pytest.mark.slow
def test_no_plugin_of_a_scenes_or_the_working_folder_runs(shared_object, mark, tmp_path):
    provide(shared_object, tmp_path)
    shutil.copy(ROOT / "scenes" / "statue.ply", tmp_path)  # read by another process first, with these folders
    mesh = '<shape type="ply"><string name="filename" value="statue.ply"/></shape>'
    parts = '<path value="."/>', SENSOR, BALL, mesh, LIGHT
    named = write_scene(tmp_path, *parts)
    child = [sys.executable, "-P", "-c", CHILD.format(root=str(ROOT)), "sphere", str(named)]
    done = subprocess.run(child, cwd=tmp_path, capture_output=True, text=True, timeout=250)
    assert done.stdout == "rendered\n", done.stderr
    assert not mark.exists()
    # The same object does run where something loads it.
    ctypes.CDLL(os.fspath(tmp_path / "plugins" / "evil.so"))
    assert mark.read_text() == "ran\n"


@pytest.mark.parametrize("kind", ["evil", "$kind", "./evil", "../plugins/evil", "evil.x"])
@pytest.mark.parametrize("where", ["scene", "working folder"])
def test_a_name_that_only_a_foreign_file_provides_is_refused(
    shared_object, mark, tmp_path, monkeypatch, kind, where
):
    (tmp_path / "there").mkdir()
    provide(shared_object, tmp_path if where == "scene" else tmp_path / "there")
    monkeypatch.chdir(tmp_path / "there")
    default = '<default name="kind" value="evil"/>'
    path = '<path value="."/>' if where == "scene" else ""
    shape = f'<shape type="{kind}"/>'
    file = write_scene(tmp_path, path, default, SENSOR, LIGHT, shape)
    before = list(map(str, mi.file_resolver()))
    expected = "no plugin evil, and .*not loaded|expected the name of a Mitsuba plugin"
    if where == "scene" and kind in ("evil", "$kind"):
        expected = 'Plugin "evil" not found'  # the scene's folder is not looked at
    with pytest.raises(InputError, match=expected):
        scene.load(file)
    assert not mark.exists()
    assert set(map(str, mi.file_resolver())) <= {*before, str(installed_plugins.installation())}


def test_a_dict_names_installed_plugins_only(shared_object, mark, tmp_path, here):
    provide(shared_object, tmp_path)
    with pytest.raises(InputError, match=r"no plugin evil, and plugins/evil\.so is not loaded"):
        scene.load({"type": "scene", "inner": {"type": "twosided", "shape": {"type": "evil"}}})
    assert not mark.exists()
