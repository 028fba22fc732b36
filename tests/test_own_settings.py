"""Programs with other settings of JAX for their own functions get what all others get."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mechsearch_jax as ms
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.runtime.compiled import CachedJit
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.runtime.own_settings import OWN, in_own_settings, own_settings
from mechsearch_jax.workspace.render import render_depth


@pytest.fixture
def others():
    """The settings of somebody else."""
    with jax.enable_x64(True), jax.debug_nans(True), jax.debug_infs(True), jax.numpy_dtype_promotion("strict"):
        yield


def dtypes(tree):
    return {
        np.dtype(leaf.dtype) for leaf in jax.tree.leaves(tree) if not jnp.issubdtype(leaf.dtype, jax.dtypes.extended)
    }


def test_the_settings_hold_inside_and_others_outside(others):
    with own_settings():
        assert {name: getattr(jax.config, name) for name in OWN} == OWN
    assert jax.config.jax_enable_x64
    assert in_own_settings(lambda: jnp.zeros(3).dtype)() == np.float32
    assert jnp.zeros(3).dtype == np.float64


def marked(x):
    return jnp.where(x > 0, x, jnp.nan), jnp.arange(3), jnp.inf * x


def test_a_kept_function_computes_in_32_bits_and_marks_with_nan(others):
    kept = CachedJit(marked, on_disk=False)
    for prepare in (False, True):
        if prepare:
            kept.prepare(jnp.zeros(2))
        results = kept(jnp.zeros(2))
        assert dtypes(results) == {np.dtype(np.float32), np.dtype(np.int32)}
        assert np.isnan(results[0]).all()


def test_a_search_is_the_same_under_other_settings(problem, others):
    images = ms.example_images()
    given = ms.Superquadrics(
        size=jnp.array([[0.03, 0.03, 0.06]]),
        exponents=jnp.array([[0.2, 0.2]]),
        position=jnp.array([[0.58, 0.1, 0.4645]]),
        rotation=jnp.eye(3)[None],
        valid=jnp.ones(1, bool),
    )
    assert given.size.dtype == np.float64
    objects = superquadric.pad(given, 8)
    observation = ms.Observation(objects, jnp.array(False), jnp.zeros(3))
    belief = ms.update_belief(problem, ms.initial_belief(problem), observation)
    decision = ms.search_for_grasp()(jax.random.key(0), problem, belief, observation)
    for result in (belief, decision):
        assert np.dtype(np.float64) not in dtypes(result)
    motion = ms.joint_trajectory(problem, decision.action, observation=observation)
    assert motion.position.dtype == np.float32
    render_depth(images.camera, objects)
    # As without them.
    with own_settings():
        plain = ms.Observation(
            jax.tree.map(lambda a: jnp.asarray(np.asarray(a)), objects), jnp.array(False), jnp.zeros(3)
        )
        same = ms.search_for_grasp()(jax.random.key(0), problem, belief, plain)
    np.testing.assert_array_equal(decision.action.T_world_gripper, same.action.T_world_gripper)


def test_a_flag_with_which_xla_computes_wrong_numbers_is_refused(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false --xla_backend_optimization_level=0")
    with pytest.raises(InputError, match=r"^XLA_FLAGS: --xla_backend_optimization_level=0 [^\n]*$"):
        in_own_settings(lambda: None)()
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=1")
    in_own_settings(lambda: None)()
