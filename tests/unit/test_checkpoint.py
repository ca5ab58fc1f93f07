"""Checkpoints: every bit comes back, and nothing else is taken for one."""

import dataclasses
import json
import math
import os
import zipfile

import numpy as np
import pytest

from envedit import config
from envedit.core.errors import InputError
from envedit.solve import checkpoint, gauss_newton
from envedit.solve.adam_loop import State
from tests.oracles.matrix_renderer import same_bits

PICTURE = np.arange(24, dtype=np.float32).reshape(2, 4, 3)


def example(rng):
    state = State(17, 3, 1, 0.125, [
        {"iteration": 0, "loss": 1 / 3, "ssim": 1e-300, "lr": 5e-5, "step_ms": 1.25},
        {"iteration": 1, "loss": 2.5e38, "ssim": -0.0, "lr": 0.0, "step_ms": 0.001},
    ])  # fmt: skip
    optimiser = {"step": np.int64(17), "params/a/b": rng.random((3, 4)).astype(np.float32)}
    optimiser["v/x"] = np.float32([0, 1e-45, 3e38, -0.0])
    renderer = {"columns": np.arange(5, dtype=np.uint32), "values": rng.random((2, 5)).astype(np.float16)}
    return state, optimiser, renderer


def test_everything_comes_back_exactly_also_without_a_renderer_and_with_bad_steps(tmp_path, rng):
    state, optimiser, renderer = example(rng)
    checkpoint.save(tmp_path, "what", state, optimiser, renderer, PICTURE)
    found = checkpoint.load(tmp_path, "what")
    assert found[0] == state and json.dumps(found[0].history) == json.dumps(state.history)
    assert same_bits(optimiser, found[1]) and same_bits(renderer, found[2])
    assert np.array_equal(found[3], PICTURE)
    assert [path.name for path in tmp_path.iterdir()] == [checkpoint.NAME]
    _, optimiser, _ = example(rng)
    state = State(1, 1, 1, 0.5, [{"iteration": 0, "loss": math.nan}, {"iteration": 1, "loss": math.inf}])
    checkpoint.save(tmp_path, "what", state, optimiser, {}, PICTURE)
    found, _, renderer, _ = checkpoint.load(tmp_path, "what")
    assert renderer == {} and math.isnan(found.history[0]["loss"]) and found.history[1]["loss"] == math.inf


def test_no_checkpoint_is_none_and_one_of_another_run_is_refused(tmp_path, rng):
    checkpoint.save(tmp_path, "what", *example(rng), PICTURE)
    for _ in range(2):
        checkpoint.remove(tmp_path)
    assert checkpoint.load(tmp_path, "what") is None and not list(tmp_path.iterdir())
    assert checkpoint.load(tmp_path / "nowhere", "what") is None
    checkpoint.save(tmp_path, "what", *example(rng), PICTURE)
    with pytest.raises(InputError, match=r"checkpoint\.npz.*another configuration.*without --resume") as info:
        checkpoint.load(tmp_path, "other")
    assert info.value.exit_code == 3 and len(str(info.value).splitlines()) == 1


@pytest.mark.parametrize("share", [0, 0.01, 0.5, 0.9, 0.999, 1])
def test_a_truncated_file_or_a_changed_byte_is_refused(tmp_path, share, rng):
    state, optimiser, renderer = example(rng)
    checkpoint.save(tmp_path, "what", state, optimiser, renderer, PICTURE)
    path = tmp_path / checkpoint.NAME
    data = bytearray(path.read_bytes())
    data[data.index(optimiser["params/a/b"].tobytes())] ^= share == 1
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match=r"checkpoint\.npz: .*cannot be read.*delete it"):
        checkpoint.load(tmp_path, "what")


def test_other_files_of_that_name_are_refused(tmp_path):
    path = tmp_path / checkpoint.NAME
    meta = {"digest": "what", "state": {"step": 1, "no such field": 2}}
    for content in (
        lambda file: file.write(b"a text\n"),
        lambda file: np.save(file, np.arange(3)),
        lambda file: np.savez(file, something=np.arange(3)),
        lambda file: np.savez(file, meta=np.frombuffer(b"[1, 2", np.uint8)),
        lambda file: np.savez(file, meta=np.frombuffer(b"[1, 2]", np.uint8)),
        lambda file: np.savez(file, meta=np.frombuffer(b"{}", np.uint8)),
        lambda file: np.savez(file, meta=np.frombuffer(b'{"state": {}}', np.uint8)),
        lambda file: np.savez(file, meta=np.frombuffer(json.dumps(meta).encode(), np.uint8)),
    ):
        with open(path, "wb") as file:
            content(file)
        with pytest.raises(InputError, match=r"checkpoint\.npz"):
            checkpoint.load(tmp_path, "what")


def test_digest_knows_what_decides_the_result(rng):
    settings, pixels = config.Config(), rng.random((4, 8, 3)).astype(np.float32)
    changed = pixels.copy()
    changed[2, 3, 1] = np.nextafter(changed[2, 3, 1], np.float32(2))
    base = checkpoint.digest(settings, "scene", [pixels])
    others = [
        checkpoint.digest(settings, "scene", [changed]),
        checkpoint.digest(settings, "another", [pixels]),
        checkpoint.digest(settings, "scene", [pixels, pixels]),
        checkpoint.digest(dataclasses.replace(settings, seed=1), "scene", [pixels]),
        checkpoint.digest(config.loads("[optimizer]\niterations = 7"), "scene", [pixels]),
        checkpoint.digest(config.loads("[loss]\nssim = [1.0, 2.0]"), "scene", [pixels]),
        checkpoint.digest(config.loads("[fit]\nawp_gamma = 0.02"), "scene", [pixels]),
    ]
    assert len({base, *others}) == 1 + len(others)
    elsewhere = config.loads("", "/elsewhere")
    assert elsewhere.output.dir != settings.output.dir
    assert checkpoint.digest(elsewhere, "scene", [pixels.copy()]) == base


def test_an_entry_that_is_no_array_is_told(tmp_path):
    checkpoint.save(tmp_path, "what", State(), {}, {}, np.zeros((2, 4, 3), np.float32))
    path = tmp_path / checkpoint.NAME
    with zipfile.ZipFile(path) as archive:
        meta = archive.read("meta.npy")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("meta.npy", meta)
        archive.writestr("target.npy", b"")
    with pytest.raises(InputError, match="cannot be read .an entry is no array"):
        checkpoint.load(tmp_path, "what")


@pytest.mark.parametrize(("offset", "value"), [(4, 255), (6, 1), (6, 32), (8, 99), (8, 8), (8, 14)])
def test_every_kind_of_damage_to_the_archive_is_told(tmp_path, offset, value):
    checkpoint.save(tmp_path, "what", State(), {}, {}, np.zeros((2, 4, 3), np.float32))
    path = tmp_path / checkpoint.NAME
    raw = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        assert archive.infolist()[0].header_offset == 0
    raw[offset] = value
    raw[raw.index(b"PK\x01\x02") + offset + 2] = value
    path.write_bytes(raw)
    with pytest.raises(InputError, match="checkpoint.npz: the checkpoint cannot be read") as info:
        checkpoint.load(tmp_path, "what")
    assert len(str(info.value)) - len(str(path)) < 300


@pytest.mark.parametrize(("state", "picture", "parameter"), [
    (State(step=-1), 0.0, 0.0), (State(step="2"), 0.0, 0.0), (State(slowdown=0), 0.0, 0.0),
    (State(history=[5]), 0.0, 0.0), (State(), np.nan, 0.0), (State(), 0.0, np.inf),
])  # fmt: skip
def test_a_right_digest_with_a_wrong_state_is_told(tmp_path, state, picture, parameter):
    kept = np.full((2, 4, 3), picture, np.float32)
    checkpoint.save(tmp_path, "what", state, {"a": np.array([parameter])}, {}, kept)
    with pytest.raises(InputError, match="what it holds is no state of a run"):
        checkpoint.load(tmp_path, "what")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_in_place_of_the_checkpoint_does_not_wait(tmp_path):
    os.mkfifo(tmp_path / checkpoint.NAME)
    with pytest.raises(InputError, match="the checkpoint cannot be read .*no regular file"):
        checkpoint.load(tmp_path, "what")


def test_a_solution_comes_back_as_a_run_without_steps_and_only_to_its_own_map(tmp_path):
    state = {"gain": np.ones((5, 3)), "turn": np.zeros((2, 3))}
    start = {"gain": np.zeros((5, 3)), "turn": np.ones((2, 3))}
    run = gauss_newton.Run(state, start, finished=True, history=[{"loss": 1.0}], hold=21.0)
    path = tmp_path / "painted.npz"
    checkpoint.save_solution(path, run)
    found = checkpoint.load_solution(path, like=state)
    assert not found.finished and not found.history and found.hold == 21.0
    for name, array in state.items():
        assert np.array_equal(found.state[name], array) and np.array_equal(found.start[name], start[name])
    with pytest.raises(InputError, match="painted.npz: is the solution of another map"):
        checkpoint.load_solution(path, like=state | {"gain": np.ones((6, 3))})
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match="painted.npz: the solution cannot be read"):
        checkpoint.load_solution(path, like=state)
