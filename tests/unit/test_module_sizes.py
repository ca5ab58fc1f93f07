"""Modules of one job: none is longer than 400 lines without a reason in its docstring."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "envedit"
MOST = 400


def test_no_module_is_long_without_a_reason():
    files = list(PACKAGE.rglob("*.py"))
    assert len(files) > 100
    sources = {str(file.relative_to(PACKAGE)): file.read_text() for file in files}
    reason = "Longer than 400 lines:"
    said = {name: reason in (ast.get_docstring(ast.parse(s)) or "") for name, s in sources.items()}
    long = {name for name, source in sources.items() if len(source.splitlines()) > MOST}
    assert {name for name in long if not said[name]} == set()
    assert {name for name, given in said.items() if given} == long  # a reason goes when the module shrinks
