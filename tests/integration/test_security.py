"""SECURITY.md names a test for every finding, and each of them is there."""

import ast
import re

import pytest

from tests.oracles import ROOT


@pytest.mark.slow
def test_every_finding_has_a_test_that_exists():
    rows = [row for row in (ROOT / "SECURITY.md").read_text().splitlines() if row.startswith("| ")][1:]
    assert rows
    for row in rows:
        finding, named, result = row.strip("| ").split(" | ")
        assert finding and result
        tests = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", named)
        assert tests, row
        for file, name in tests:
            defined = ast.walk(ast.parse((ROOT / file).read_text()))
            assert any(isinstance(f, ast.FunctionDef) and f.name == name for f in defined), (file, name)
