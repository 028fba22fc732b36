"""Dense least gauges: XLA's version and the kernel against equation 5 in float64, odd sizes, edges and empty inputs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.benchmarks.parts import dense
from mechsearch_jax.benchmarks.parts.dense import Tiling
from mechsearch_jax.geometry import superquadric, transforms
from mechsearch_jax.runtime.errors import InputError

# A float32 coordinate 20 half-extents from a centre is known to about 5e-6 half-extents.
CLOSE = {"rtol": 1e-5, "atol": 2e-5}
seeds = st.integers(0, 2**31 - 1)


def rotations(rng, count):
    R = np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(count)])
    return R * np.sign(np.linalg.det(R))[:, None, None]


def random_case(rng, clouds=3, points=50, placed=4, objects=5):
    scene = superquadric.Superquadrics(
        size=jnp.float32(rng.uniform(0.02, 0.1, (objects, 3))),
        exponents=jnp.float32(rng.uniform(0.1, 1.9, (objects, 2))),
        position=jnp.float32(rng.uniform(-0.2, 0.2, (objects, 3))),
        rotation=jnp.float32(rotations(rng, objects)),
        valid=jnp.ones(objects, bool),
    )
    T = np.tile(np.eye(4), (placed, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rotations(rng, placed), rng.uniform(-0.1, 0.1, (placed, 3))
    cloud = jnp.int32(rng.integers(0, clouds, placed))
    return scene, jnp.float32(rng.uniform(-0.1, 0.1, (clouds, 3, points))), cloud, jnp.float32(T)


def reference(scene, clouds, cloud, T_world_cloud):
    """The gauge as a root of equation 5, point by point in float64."""
    size, exponents, position, R = (
        np.asarray(a, np.float64) for a in (scene.size, scene.exponents, scene.position, scene.rotation)
    )
    least = np.empty((len(cloud), len(size)))
    for m, T in enumerate(np.asarray(T_world_cloud, np.float64)):
        world = T[:3, :3] @ np.asarray(clouds, np.float64)[cloud[m]] + T[:3, 3:]
        for n, (e1, e2) in enumerate(exponents):
            x, y, z = np.abs(R[n].T @ (world - position[n][:, None])) / size[n][:, None]
            least[m, n] = np.min(((x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1)) ** (e1 / 2))
    return least


@functools.partial(jax.jit, static_argnums=4)
def by_the_kernel(scene, clouds, cloud, T_world_cloud, tiling):
    numbers = dense._numbers(scene, T_world_cloud)
    return dense.least_kernel(clouds, cloud, numbers, tiling, interpret=True)


@settings(deadline=None, max_examples=30)
@given(seeds, st.sampled_from([(1, 1, 1, 1), (3, 50, 4, 5), (2, 7, 3, 8)]))
def test_xlas_version_is_the_papers_function(seed, shape):
    case = random_case(np.random.default_rng(seed), *shape)
    np.testing.assert_allclose(dense.least_gauges(*case, method="xla"), reference(*case), **CLOSE)


@settings(deadline=None, max_examples=20)
@given(seeds, st.sampled_from([(1, 1, 1, 1), (3, 50, 4, 5), (2, 7, 3, 8)]))
def test_the_kernel_is_the_papers_function_and_xlas(seed, shape):
    case = random_case(np.random.default_rng(seed), *shape)
    got = by_the_kernel(*case, Tiling(points=16))
    np.testing.assert_allclose(got, reference(*case), **CLOSE)
    np.testing.assert_allclose(got, dense.least_gauges(*case, method="xla"), rtol=1e-5)


@pytest.mark.parametrize("tiling", [Tiling(1, 1), Tiling(4, 3, 2), Tiling(32, 4), Tiling(64, 8), Tiling(1024, 2)])
@pytest.mark.parametrize("points", [1, 31, 32, 33])
def test_no_tiling_changes_a_result(tiling, points):
    case = random_case(np.random.default_rng(points), points=points, objects=6)
    np.testing.assert_allclose(by_the_kernel(*case, tiling), dense.least_gauges(*case, method="xla"), rtol=1e-5)


@pytest.mark.parametrize("how", ["xla", "kernel"])
@pytest.mark.parametrize("e", [(0.1, 0.1), (0.2, 0.2), (0.2, 1.0), (1.0, 1.0), (1.9, 1.9), (1.9, 0.1)])
def test_values_are_right_at_the_centre_on_the_axes_and_far_away(how, e):
    points = np.float32([(0, 0, 0), (0.1, 0, 0), (0, 0.05, 0), (0, 0, -0.2), (0.05, 0.025, 0), (900, -700, 800)])
    scene = superquadric.Superquadrics(
        size=jnp.float32([[0.1, 0.05, 0.2]]),
        exponents=jnp.float32([e]),
        position=jnp.zeros((1, 3)),
        rotation=jnp.eye(3)[None],
        valid=jnp.ones(1, bool),
    )
    # Every point is a cloud of its own.
    clouds, cloud = jnp.asarray(points)[..., None], jnp.arange(len(points))
    case = scene, clouds, cloud, jnp.tile(jnp.eye(4), (len(points), 1, 1))
    got = dense.least_gauges(*case, method="xla") if how == "xla" else by_the_kernel(*case, Tiling())
    expected = superquadric.gauge(scene.size, scene.exponents, jnp.asarray(points))
    np.testing.assert_allclose(got[:, 0], expected, rtol=1e-5, atol=1e-20)


def test_it_is_what_collisions_are_made_of():
    case = random_case(np.random.default_rng(5), placed=40)
    scene, clouds, cloud, T = case
    world = transforms.transform(T[:, None], jnp.swapaxes(clouds, 1, 2)[cloud])
    local = superquadric.to_object_frame(scene, world)
    expected = jnp.any(superquadric.gauge(scene.size, scene.exponents, local) < 1.0, axis=1)
    assert 0 < expected.sum() < expected.size
    for method in ("auto", "xla"):
        np.testing.assert_array_equal(dense.any_inside(*case, method=method), expected)


def test_nothing_is_inside_an_absent_object():
    scene, *rest = random_case(np.random.default_rng(6))
    got = dense.least_gauges(scene.replace(valid=jnp.arange(5) != 2), *rest)
    assert np.isinf(got).all(axis=0).tolist() == [False, False, True, False, False]
    assert np.isfinite(got[:, [0, 1, 3, 4]]).all()


@pytest.mark.parametrize("shape", [(3, 0, 4, 5), (3, 10, 0, 5), (3, 10, 4, 0), (0, 10, 0, 5)])
def test_nothing_is_inside_where_there_is_nothing(shape):
    scene, clouds, cloud, T = random_case(np.random.default_rng(7), 3, 10, 4, 5)
    c, p, m, n = shape
    scene = jax.tree.map(lambda a: a[:n], scene)
    got = dense.least_gauges(scene, clouds[:c, :, :p], cloud[:m], T[:m])
    assert got.shape == (m, n)
    assert np.isinf(got).all()


def test_many_placed_clouds_are_what_each_is_alone(monkeypatch):
    case = random_case(np.random.default_rng(8), placed=11)
    together = dense.least_gauges(*case, method="xla")
    # Not as many at once as there are, and not a divisor of their number.
    monkeypatch.setattr(dense, "BLOCK", 3 * 50 * 5)
    in_parts = jax.jit(dense.least_gauges.__wrapped__, static_argnames="method")(*case, method="xla")
    np.testing.assert_allclose(in_parts, together, rtol=1e-6)


def test_batches_of_scenes_work():
    cases = [random_case(np.random.default_rng(seed)) for seed in range(3)]
    together = jax.vmap(dense.least_gauges)(*jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases))
    for case, got in zip(cases, together, strict=True):
        np.testing.assert_allclose(got, dense.least_gauges(*case), rtol=1e-6)


def test_without_pallas_for_triton_there_is_xlas_version(monkeypatch):
    monkeypatch.setattr(dense, "kernel_available", lambda: False)
    case = random_case(np.random.default_rng(9), placed=2, objects=3)
    np.testing.assert_allclose(dense.least_gauges(*case), reference(*case), **CLOSE)
    with pytest.raises(InputError, match="use the method 'xla'"):
        dense.least_gauges(*case, method="kernel")


def test_the_kernel_lowers_for_a_gpu():
    # JAX needs no GPU for that before 0.11; afterwards it has to be told of one.
    if tuple(int(v) for v in jax.__version__.split(".")[:2]) >= (0, 11) or not dense.kernel_available():
        pytest.skip("this version of JAX lowers the kernel only where there is a GPU")
    scene, clouds, cloud, T = random_case(np.random.default_rng(10))
    traced = jax.jit(dense.least_kernel).trace(clouds, cloud, dense._numbers(scene, T))
    assert "triton" in traced.lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.gpu
@settings(deadline=None, max_examples=20)
@given(seeds)
def test_on_a_gpu_the_kernel_is_xlas_version(seed):
    case = random_case(np.random.default_rng(seed), points=2500, placed=20, objects=7)
    kernel, xla = (dense.least_gauges(*case, method=method) for method in ("kernel", "xla"))
    np.testing.assert_allclose(kernel, xla, rtol=1e-5, atol=1e-5)
