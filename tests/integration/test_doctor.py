from pathlib import Path

import pytest

from envedit.cli import doctor
from envedit.core.errors import MachineError

LIBRARIES = Path("/usr/lib/x86_64-linux-gnu")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "envedit"


@pytest.fixture(scope="module")
def healthy():
    return doctor.check()


def test_this_machine_is_well(healthy):
    assert healthy.ok and healthy.lines == ()
    assert healthy.versions["radiance"] == pytest.approx(0.5, abs=1e-3)
    assert int(healthy.versions["llvm"].split(".")[0]) >= 17 and healthy.versions["gflops"] > 0


def test_a_library_that_is_not_there(monkeypatch, capsys):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nonexistent/libLLVM.so")
    assert doctor.main([]) == 4
    out, err = capsys.readouterr()
    cause, remedy = err.splitlines()
    assert "mitsuba" in out and "numpy" in out
    assert "DRJIT_LIBLLVM_PATH=/nonexistent/libLLVM.so" in cause and "libllvm19" in remedy


@pytest.mark.slow
@pytest.mark.parametrize(
    "version, says", [(14, "LLVM 14 .* is too old"), (15, r"LLVM 15\.\S+ \(.*\) stops the process")]
)
def test_a_library_that_cannot_run_it(version, says, monkeypatch, cache):
    library = LIBRARIES / f"libLLVM-{version}.so.1"
    if not library.exists():
        pytest.skip(f"LLVM {version} is not installed")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(library))
    with pytest.raises(MachineError, match=says) as caught:
        doctor.ensure()
    lines = str(caught.value).splitlines()
    assert len(lines) == 2 and "libllvm19" in lines[1] and max(map(len, lines)) < 200
    assert not cache.exists()  # a failure is never remembered


@pytest.mark.parametrize("variant", ["cuda_ad_rgb", "metal_ad_rgb", "scalar_rgb"])
def test_a_variant_that_does_not_run_here(variant):
    found = doctor.check(variant)
    if found.ok:
        pytest.skip("this machine has such a GPU")
    assert len(found.lines) == 2 and variant in found.lines[0] and "llvm_ad_rgb" in found.lines[1]


def test_main_reports_a_healthy_machine(monkeypatch, capsys, healthy):
    monkeypatch.setattr(doctor, "check", lambda variant: healthy)
    assert doctor.main([]) == 0 and "llvm_ad_rgb" in capsys.readouterr().out


# ---- the memory of a success -------------------------------------------------------------------------------


def counting(monkeypatch, diagnosis):
    calls = []
    monkeypatch.setattr(doctor, "check", lambda variant: calls.append(variant) or diagnosis)
    return calls


def test_a_success_is_remembered_until_something_changes(monkeypatch, cache, tmp_path):
    library = tmp_path / "libLLVM.so"
    library.write_text("one")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    calls = counting(monkeypatch, doctor.Diagnosis(True, (), {"llvm_path": str(library)}))
    doctor.ensure()
    doctor.ensure()
    assert len(calls) == 1
    library.write_text("another")  # the library is replaced
    doctor.ensure()
    assert len(calls) == 2
    doctor.ensure("cuda_ad_rgb")  # another variant
    assert len(calls) == 3
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/elsewhere")
    doctor.ensure()
    assert len(calls) == 4
    monkeypatch.setattr(doctor.machine, "version", lambda package: "99.0")
    doctor.ensure()
    assert len(calls) == 5


@pytest.mark.parametrize("where", ["a file in the place of the folder", "a library of elsewhere"])
def test_what_cannot_be_remembered_is_probed_again(where, monkeypatch, cache, tmp_path):
    library = tmp_path / "libLLVM.so"
    library.write_text("one")
    if "file" in where:
        cache.write_text("")
        monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    calls = counting(monkeypatch, doctor.Diagnosis(True, (), {"llvm_path": str(library)}))
    doctor.ensure()
    doctor.ensure()
    assert len(calls) == 2


@pytest.mark.parametrize(
    "code, said, says",
    [
        (-6, "LLVM ERROR: Cannot select", "SIGABRT: LLVM ERROR"),
        (-99, "", "exit code -99"),
        (None, "", "did not end in"),
        (1, "ImportError: ... because the LLVM shared library", "no LLVM library was found"),
        (1, "Traceback\nValueError: odd", "ValueError: odd"),
        (1, "", "it said nothing"),
    ],
)
def test_how_the_child_ended_is_told_on_one_line_and_what_to_do_on_another(code, said, says, monkeypatch):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    cause, remedy = doctor._explain("llvm_ad_rgb", code, said, {})
    assert says in cause and remedy and "\n" not in cause + remedy


def test_a_wrong_picture_is_not_ready(monkeypatch):
    class Child:
        returncode = 0
        stdout = b'{"radiance": 0.25}\n{"done": true}\n'
        stderr = b""

    monkeypatch.setattr(doctor.subprocess, "run", lambda *a, **k: Child)
    found = doctor.check()
    assert not found.ok and "computed 0.25, not 0.5" in found.lines[0]
