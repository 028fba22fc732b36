"""Problems are kept on disk, and a file is believed only if it is whole and of this very problem."""

import jax
import numpy as np
import pytest

from mechsearch_jax.config.presets import paper
from mechsearch_jax.problem import cache
from mechsearch_jax.problem import problem as problems
from mechsearch_jax.runtime import kept_arrays
from mechsearch_jax.workspace.target import Target


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(kept_arrays.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def refuse(**parts):
    raise AssertionError("the problem was built anew")


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        # A camera's numbers are plain ones.
        assert np.asarray(x).dtype == np.asarray(y).dtype
        np.testing.assert_array_equal(x, y)


@pytest.mark.slow
@pytest.mark.always
def test_a_problem_read_from_disk_is_the_one_that_was_built(folder, problem, monkeypatch):
    assert_same(cache.cached_problem(), problem)
    (file,) = folder.glob("problem-*.npz")
    monkeypatch.setattr(problems, "build_problem", refuse)
    assert_same(cache.cached_problem(), problem)
    with pytest.raises(AssertionError):
        cache.cached_problem(Target.box())
    with pytest.raises(AssertionError):
        cache.cached_problem(config=paper().problem)
    # Another version of the source makes another file.
    monkeypatch.setattr(cache, "_source", lambda: "another")
    with pytest.raises(AssertionError):
        cache.cached_problem()
    assert list(folder.glob("problem-*.npz")) == [file]


@pytest.mark.parametrize("damage", ["cut", "garbage", "empty", "altered", "renamed"])
def test_a_damaged_file_is_built_anew(folder, problem, monkeypatch, damage):
    monkeypatch.setattr(problems, "build_problem", lambda **parts: problem)
    cache.cached_problem()
    (file,) = folder.glob("problem-*.npz")
    whole = file.read_bytes()
    if damage == "altered":
        with np.load(file) as saved:
            arrays = dict(saved)
        np.savez(file, **arrays | {"poses": arrays["poses"] + 0.01})
    elif damage == "renamed":
        with np.load(file) as saved:
            np.savez(file, **{name.replace("poses", "places"): array for name, array in saved.items()})
    else:
        file.write_bytes({"cut": whole[: len(whole) // 2], "garbage": b"no archive", "empty": b""}[damage])
    assert cache.cached_problem() is problem
    monkeypatch.setattr(problems, "build_problem", refuse)
    assert_same(cache.cached_problem(), problem)


def test_a_file_that_another_process_deletes_meanwhile_is_no_error(tmp_path):
    for name in ("first", "second"):
        (tmp_path / f"problem-{name}.npz").write_bytes(b"")
    # It is listed, and gone when it is looked at.
    (tmp_path / "problem-gone.npz").symlink_to(tmp_path / "nowhere")
    kept_arrays.forget_old(tmp_path, "problem", 1)
    assert len([file for file in tmp_path.glob("problem-*") if file.exists()]) == 1
