"""Signatures: every public one is annotated, and mypy finds nothing at the level of ``pyproject.toml``."""

import ast
import importlib.util
import subprocess
import sys

import pytest

from tests.oracles import ROOT

pytestmark = pytest.mark.slow


def unannotated(source):
    """List the parameters and returns of public functions without a type, as "line name"."""
    found = []

    def visit(node, public):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef):
                visit(child, public and not child.name.startswith("_"))
            elif isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
                name = child.name
                if public and (not name.startswith("_") or name.startswith("__")):
                    a = child.args
                    every = [*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg]
                    taken = [one for one in every if one and one.arg not in ("self", "cls")]
                    found.extend(f"{child.lineno} {one.arg}" for one in taken if one.annotation is None)
                    if child.returns is None and name != "__init__":
                        found.append(f"{child.lineno} {name} ->")
                visit(child, False)  # a function in a function is not public
            else:
                visit(child, public)

    visit(ast.parse(source), True)
    return found


def test_no_public_parameter_or_return_is_unannotated():
    files = sorted((ROOT / "envedit").rglob("*.py"))
    assert len(files) > 100
    found = [f"{file.relative_to(ROOT)}:{one}" for file in files for one in unannotated(file.read_text())]
    assert found == []


@pytest.mark.skipif(importlib.util.find_spec("mypy") is None, reason="mypy is not installed: envedit[dev]")
def test_mypy_finds_nothing():
    """With the cache of the checkout, which a run of mypy from the command line uses too."""
    mypy = [sys.executable, "-m", "mypy"]
    done = subprocess.run(mypy, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
