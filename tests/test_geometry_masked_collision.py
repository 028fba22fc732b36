"""Masked evaluation against plain `vmap`, and collision tests against equation 5 in float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.geometry import collision, collision_kernel, masked, transforms
from mechsearch_jax.geometry.collision import Dense, clouds_of
from mechsearch_jax.geometry.masked import masked_vmap
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.workspace.shelf import Shelf, hits_shelf, spheres_hit_shelf


def function(shared, own, row):
    return shared * row["a"], {"b": own["b"] + row["i"]}


@functools.cache
def evaluator(block, *traced_for):
    """Compiled: what runs operation by operation is compiled for each of them."""
    return jax.jit(
        lambda mask, shared, a, b: masked_vmap(
            function, mask, shared, {"b": b}, {"a": a, "i": jnp.arange(len(a))}, block
        )
    )


def evaluate(mask, shared, a, b, block=256):
    """`function` where a mask is true."""
    return evaluator(block, masked.on_cpu(), masked.GPU_BLOCKS, masked.LARGEST_INDEX)(mask, shared, a, b)


@pytest.fixture(params=["cpu", "gpu"])
def platform(request, monkeypatch):
    """What is traced is meant for one or the other, wherever it runs."""
    monkeypatch.setattr(masked, "on_cpu", lambda: request.param == "cpu")
    monkeypatch.setattr(masked, "GPU_BLOCKS", 2)


def test_a_default_device_says_what_is_traced_for(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not masked.on_cpu()
    for device in ("cpu", jax.devices("cpu")[0]):
        with jax.default_device(device):
            assert masked.on_cpu()


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("rows", "block"), [(1, 1), (1, 64), (23, 1), (23, 4), (150, 64)])
def test_masked_entries_are_those_of_vmap_and_the_others_zero(rows, block):
    mask = jnp.arange(rows) % 3 == 0
    a, b = jnp.arange(float(rows)), jnp.int32(5)
    got = evaluate(mask, jnp.float32(2.0), a, b, block)
    np.testing.assert_array_equal(got[0], jnp.where(mask, 2.0 * a, 0))
    np.testing.assert_array_equal(got[1]["b"], jnp.where(mask, 5 + jnp.arange(rows), 0))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("block", [1, 256])
def test_a_batch_is_what_its_rows_are_alone(block):
    masks = jax.random.bernoulli(jax.random.key(0), 0.3, (6, 40))
    a, b = jax.random.normal(jax.random.key(1), (6, 40)), jnp.arange(6)
    run = functools.partial(evaluate, block=block)
    together = jax.jit(jax.vmap(run, in_axes=(0, None, 0, 0)))(masks, jnp.float32(3.0), a, b)
    for i in range(6):
        alone = run(masks[i], jnp.float32(3.0), a[i], b[i])
        np.testing.assert_array_equal(together[0][i], alone[0])
        np.testing.assert_array_equal(together[1]["b"][i], alone[1]["b"])


@pytest.mark.parametrize("most", [10, 160, 200])
def test_a_batch_with_too_many_indices_runs_in_pieces(monkeypatch, most):
    masks = jax.random.bernoulli(jax.random.key(0), 0.5, (3, 4, 40))
    a, b = jax.random.normal(jax.random.key(1), (3, 4, 40)), jnp.arange(4)
    run = lambda m, a, b: evaluate(m, jnp.float32(1.0), a, b)  # noqa: E731
    batched = jax.vmap(jax.vmap(run), in_axes=(0, 0, None))
    whole = batched(masks, a, b)
    monkeypatch.setattr(masked, "LARGEST_INDEX", most)
    jax.tree.map(np.testing.assert_array_equal, batched(masks, a, b), whole)


@pytest.mark.usefixtures("platform")
def test_batches_nest_and_shared_values_may_be_batched_too():
    masks = jax.random.bernoulli(jax.random.key(0), 0.5, (2, 3, 10))
    a, b = jax.random.normal(jax.random.key(1), (2, 3, 10)), jnp.zeros((2, 3), jnp.int32)
    scale = jnp.array([1.0, 10.0])
    got = jax.vmap(jax.vmap(evaluate, in_axes=(0, None, 0, 0)))(masks, scale, a, b)[0]
    np.testing.assert_allclose(got, jnp.where(masks, a * scale[:, None, None], 0.0))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("block", [4, 256])
def test_rows_and_what_they_share_may_vary_along_part_of_the_axes_of_a_batch(block):
    masks = jax.random.bernoulli(jax.random.key(2), 0.7, (2, 3, 10))
    outer, inner = jax.random.normal(jax.random.key(0), (2, 10)), jnp.arange(3)
    run = lambda m, a, b: evaluate(m, jnp.float32(1.0), a, b, block)  # noqa: E731
    got = jax.jit(jax.vmap(jax.vmap(run, in_axes=(0, None, 0)), in_axes=(0, 0, None)))(masks, outer, inner)
    np.testing.assert_array_equal(got[0], jnp.where(masks, outer[:, None], 0.0))
    whole = inner[None, :, None] + jnp.arange(10)[None, None]
    np.testing.assert_array_equal(got[1]["b"], jnp.where(masks, whole, 0))


@pytest.mark.usefixtures("platform")
def test_nothing_is_evaluated_for_an_empty_mask():
    poison = lambda shared, own, row: row * jnp.nan  # noqa: E731
    assert not np.any(np.isnan(masked_vmap(poison, jnp.zeros(9, bool), None, None, jnp.ones(9))))


@pytest.mark.usefixtures("platform")
def test_one_bad_entry_does_not_touch_the_others():
    a = jnp.where(jnp.arange(8) == 3, jnp.nan, 1.0)
    got = evaluate(jnp.ones(8, bool), jnp.float32(1.0), a, jnp.int32(0))[0]
    assert np.isnan(got).tolist() == [i == 3 for i in range(8)]


# The ways in which a collision is decided: a CPU's loops with gauges at once and with bounds first, the same on a GPU
# that has no kernel, and the kernel.
WAYS = ("gauges", "bounds", "loops of a gpu", "kernel")
# Points that the kernel tests at once.
STEP = 32
# The two that differ most.
TWO_WAYS = ("bounds", pytest.param("kernel", marks=pytest.mark.slow))


def compiled(way, *axes, own=False):
    """`collisions` of (points, dense, cloud, poses, scene, mask) as one of the ways decides it, compiled.

    Args:
      way: one of `WAYS`.
      axes: `in_axes` of the batches that it is mapped over, from the inside.
      own: whether the clouds differ along a batch.
    """

    def run(*arguments):
        with pytest.MonkeyPatch.context() as patch:
            if way == "kernel":
                patch.setattr(collision, "uses_kernel", lambda: True)
                patch.setattr(collision, "collide", functools.partial(collision_kernel.collide, interpret=True))
                # So few points at once, and so few programs, that there are several of both for each other.
                patch.setattr(collision_kernel, "POINTS", STEP)
                patch.setattr(collision_kernel, "PROGRAMS", 4)
            else:
                # So few at once that there are several blocks.
                for name, size in (("BOXES", 16), ("CLOUDS", 8), ("GROUPS", 16), ("GAUGES", 4)):
                    patch.setattr(collision, name, size)
                patch.setattr(collision, "FEW", 1 << 30 if way == "gauges" else 0)
            if way == "loops of a gpu":
                patch.setattr(masked, "on_cpu", lambda: False)
                patch.setattr(masked, "GPU_BLOCKS", 2)

            def decide(points, dense, cloud, T, scene, mask):
                clouds = clouds_of(points).replace(dense=dense)
                return collision.collisions(clouds, cloud, T, scene, mask, own)

            for along in axes:
                decide = jax.vmap(decide, along)
            return decide(*arguments)

    return jax.jit(run)


@functools.cache
def decides(way, *axes, own=False):
    """`compiled`, once."""
    return compiled(way, *axes, own=own)


def rotations(rng, *shape):
    q = np.linalg.qr(rng.normal(size=(*shape, 3, 3)))[0]
    return np.float32(q * np.sign(np.linalg.det(q))[..., None, None])


def random_clouds(rng, *batch, clouds=4, points=96):
    """Points in boxes of several sizes, part of them away from their frame's origin."""
    centre, reach = rng.uniform(-0.06, 0.06, (*batch, clouds, 3, 1)), rng.uniform(0.02, 0.1, (*batch, clouds, 1, 1))
    return np.float32(centre + reach * rng.uniform(-1, 1, (*batch, clouds, 3, points)))


def random_poses(rng, *batch, placed=6):
    T = np.tile(np.eye(4, dtype=np.float32), (*batch, placed, 1, 1))
    T[..., :3, :3], T[..., :3, 3] = rotations(rng, *batch, placed), rng.uniform(-0.12, 0.12, (*batch, placed, 3))
    return T


def random_scene(rng, *batch, objects=4):
    e = [rng.choice(among, (*batch, objects)) for among in ([0.2, 0.7, 1.0, 1.8], [0.2, 1.0, 1.5, 1.9])]
    return Superquadrics(
        size=np.float32(rng.uniform(0.01, 0.08, (*batch, objects, 3))),
        exponents=np.float32(np.stack(e, axis=-1)),
        position=np.float32(rng.uniform(-0.05, 0.05, (*batch, objects, 3))),
        rotation=rotations(rng, *batch, objects),
        valid=np.ones((*batch, objects), bool),
    )


def least_of_equation_5(points, cloud, T, scene):
    """The least of equation 5 for every pair, float64; a batch is in front of all arguments but `cloud`."""
    points, T, size, exponents, position, R = (
        np.asarray(a, np.float64) for a in (points, T, scene.size, scene.exponents, scene.position, scene.rotation)
    )
    world = np.einsum("...mij,...mjp->...mip", T[..., :3, :3], points[..., cloud, :, :]) + T[..., :3, 3:]
    offset = world[..., :, None, :, :] - position[..., None, :, :, None]
    local = np.einsum("...nji,...mnjp->...mnip", R, offset) / size[..., None, :, :, None]
    x, y, z = np.moveaxis(np.abs(local), -2, 0)
    e1, e2 = np.moveaxis(exponents, -1, 0)[..., None, :, None]
    return np.min((x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1), axis=-1)


def check(got, least, mask):
    """What is found is what the least of equation 5 says, where float32 can tell."""
    decided = np.abs(least - 1) > 1e-3
    assert got.shape == mask.shape
    np.testing.assert_array_equal(np.asarray(got)[decided], (mask & (least < 1))[decided])


@pytest.mark.parametrize("way", WAYS)
@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10**6))
def test_a_cloud_collides_where_the_minimum_of_equation_5_is_below_1(way, seed):
    rng = np.random.default_rng(seed)
    points, T, scene = random_clouds(rng), random_poses(rng), random_scene(rng)
    cloud, mask = np.int32(rng.integers(0, 4, 6)), rng.random((6, 4)) < 0.8
    check(decides(way)(points, None, cloud, T, scene, mask), least_of_equation_5(points, cloud, T, scene), mask)


@pytest.mark.parametrize("way", TWO_WAYS)
@pytest.mark.parametrize("points", [1, 31, 300])
def test_no_number_of_points_changes_what_is_found(way, points):
    rng = np.random.default_rng(points)
    clouds, T, scene = random_clouds(rng, points=points), random_poses(rng, placed=40), random_scene(rng)
    cloud, mask = np.int32(rng.integers(0, 4, 40)), np.ones((40, 4), bool)
    least = least_of_equation_5(clouds, cloud, T, scene)
    assert 0 < np.sum(least < 1) < least.size
    check(compiled(way)(clouds, None, cloud, T, scene, mask), least, mask)


@pytest.mark.parametrize("way", WAYS)
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_dense_clouds_are_tested_coarsely_and_in_groups_with_the_same_result(way, seed):
    rng = np.random.default_rng(seed)
    points, T, scene = random_clouds(rng), random_poses(rng), random_scene(rng)
    cloud, mask = np.int32(rng.integers(0, 4, 6)), rng.random((6, 4)) < 0.8
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collision, "GROUP", 8)
        patch.setattr(collision, "STEP", STEP)
        clouds = collision.dense_clouds(points.transpose(0, 2, 1), 24)
    got = decides(way)(clouds.points, clouds.dense, cloud, T, scene, mask)
    check(got, least_of_equation_5(points, cloud, T, scene), mask)


def test_groups_of_points_are_near_each_other_and_hold_all_of_them():
    points = np.random.default_rng(0).uniform(-1, 1, (2, 1000, 3))
    clouds = jax.device_get(collision.dense_clouds(points, 100))
    assert (clouds.points.shape, clouds.dense.groups.shape) == ((2, 3, 1024), (2, 16, 2, 3))
    for cloud, ordered, boxes in zip(points, clouds.points, clouds.dense.groups, strict=True):
        assert {tuple(p) for p in np.float32(cloud)} == {tuple(p) for p in ordered.T}
        groups = ordered.T.reshape(16, 64, 3)
        np.testing.assert_array_equal(boxes, np.stack([groups.min(axis=1), groups.max(axis=1)], axis=1))
        # Sixteen boxes fill the cube: each has a sixteenth of it.
        assert np.prod(np.diff(boxes, axis=1), axis=-1).mean() < 1.2 * 8 / 16
    nearest = scipy.spatial.KDTree(points[1, :100]).query(points[1])[0].max()
    assert clouds.dense.gap[1] == np.float32(nearest)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("e", [0.2, 1.0, 1.9])
def test_a_point_within_the_gap_of_the_coarse_ones_may_collide_and_none_beyond_it(way, e):
    scene = random_scene(np.random.default_rng(0), objects=1)
    scene = scene.replace(size=np.full((1, 3), 0.01, np.float32), exponents=np.full((1, 2), e, np.float32))
    scene = scene.replace(position=np.zeros((1, 3), np.float32), rotation=np.eye(3, dtype=np.float32)[None])
    # The coarse point is outside, along the diagonal, where the p-norms differ most.
    points = np.zeros((1, 3, 2), np.float32)
    points[0, :, 0] = 0.03
    boxes = np.float32([[[points[0].min(axis=1), points[0].max(axis=1)]]])
    dense = lambda gap: Dense(points[..., :1], np.float32([gap]), boxes)  # noqa: E731
    arguments = np.zeros(1, np.int32), np.eye(4, dtype=np.float32)[None], scene, np.ones((1, 1), bool)
    assert decides(way)(points, dense(0.03 * 3**0.5), *arguments).all()
    # Not that it were true: what is said to be near the coarse point is not looked at.
    assert not decides(way)(points, dense(0.0), *arguments).any()


@pytest.mark.parametrize("way", TWO_WAYS)
def test_a_batch_and_batches_of_batches_find_what_is_found_alone(way):
    rng = np.random.default_rng(1)
    points, T, scene = random_clouds(rng), random_poses(rng, 2, 3), random_scene(rng, 2, 3)
    cloud, mask = np.int32(rng.integers(0, 4, 6)), rng.random((2, 3, 6, 4)) < 0.8
    least = least_of_equation_5(points, cloud, T, scene)
    assert 0.1 < np.mean(least < 1) < 0.9
    axes = (None, None, None, 0, 0, 0)
    check(decides(way, axes, axes)(points, None, cloud, T, scene, mask), least, mask)
    part = jax.tree.map(lambda a: a[0], (T, scene, mask))
    check(decides(way, axes)(points, None, cloud, *part), least[0], mask[0])
    part = jax.tree.map(lambda a: a[1, 2], (T, scene, mask))
    check(decides(way)(points, None, cloud, *part), least[1, 2], mask[1, 2])


@pytest.mark.parametrize("way", TWO_WAYS)
@pytest.mark.parametrize("own", [True, False])
def test_clouds_may_differ_along_a_batch(way, own):
    """They may if this is not said, too, but then the batch runs one by one."""
    rng = np.random.default_rng(2)
    points, T, scene = random_clouds(rng, 3), random_poses(rng, 3), random_scene(rng, 3)
    cloud, mask = np.int32(rng.integers(0, 4, 6)), rng.random((3, 6, 4)) < 0.8
    least = least_of_equation_5(points, cloud, T, scene)
    axes = (0, None, None, 0, 0, 0)
    check(decides(way, axes, own=own)(points, None, cloud, T, scene, mask), least, mask)
    alone = decides(way, own=own)(points[1], None, cloud, T[1], jax.tree.map(lambda a: a[1], scene), mask[1])
    check(alone, least[1], mask[1])


# Which of clouds, poses, scene and mask vary along the outer and the inner axis of a batch.
VARY = {
    "clouds and poses outside, scene and mask inside": ("cp", "sm"),
    "scene outside, clouds inside": ("sm", "cm"),
    "mask alone": ("m", "m"),
    "poses alone": ("", "p"),
}


@pytest.mark.parametrize("way", TWO_WAYS)
@pytest.mark.parametrize("vary", VARY)
def test_what_does_not_vary_along_an_axis_of_a_batch_is_the_same_along_it(way, vary):
    rng = np.random.default_rng(3)
    outer, inner = VARY[vary]

    def batch(name):
        return [n for n, names in ((2, outer), (3, inner)) if name in names]

    def whole(name, a):
        """With both axes in front."""
        lead = len(batch(name))
        shape = [n if name in names else 1 for n, names in ((2, outer), (3, inner))]
        return np.broadcast_to(a.reshape(*shape, *a.shape[lead:]), (2, 3, *a.shape[lead:]))

    points, T = random_clouds(rng, *batch("c")), random_poses(rng, *batch("p"))
    scene, mask = random_scene(rng, *batch("s")), rng.random((*batch("m"), 6, 4)) < 0.8
    cloud = np.int32(rng.integers(0, 4, 6))
    within, around = (
        tuple(0 if name in names else None for name in ("c", "-", "-", "p", "s", "m")) for names in (inner, outer)
    )
    axes = [along for along in (within, around) if any(k is not None for k in along)]
    got = decides(way, *axes, own=True)(points, None, cloud, T, scene, mask)
    whole_scene = jax.tree.map(lambda a: whole("s", a), scene)
    least = least_of_equation_5(whole("c", points), cloud, whole("p", T), whole_scene)
    wanted = whole("m", mask)
    check(got if len(axes) == 2 else jnp.broadcast_to(got, wanted.shape), least, wanted)


@pytest.mark.parametrize("way", WAYS)
def test_masked_pairs_are_free_and_nothing_else_decides_where_all_are_inside(way):
    rng = np.random.default_rng(4)
    scene = random_scene(rng)
    scene = scene.replace(size=np.full((4, 3), 1.0, np.float32))
    points, T, cloud = random_clouds(rng), random_poses(rng), np.int32(rng.integers(0, 4, 6))
    for mask in (rng.random((6, 4)) < 0.5, np.zeros((6, 4), bool), np.ones((6, 4), bool)):
        np.testing.assert_array_equal(decides(way)(points, None, cloud, T, scene, mask), mask)


@pytest.mark.parametrize("way", TWO_WAYS)
@pytest.mark.parametrize("far", [0.5, 30.0])
def test_what_is_far_apart_does_not_collide_and_overflows_nothing(way, far):
    rng = np.random.default_rng(5)
    scene, T = random_scene(rng), random_poses(rng)
    T[:, 0, 3] += far
    scene = scene.replace(exponents=np.full((4, 2), 0.1, np.float32))
    arguments = random_clouds(rng), None, np.int32(rng.integers(0, 4, 6)), T, scene, np.ones((6, 4), bool)
    assert not decides(way)(*arguments).any()


@pytest.mark.parametrize("way", TWO_WAYS)
@pytest.mark.parametrize(("placed", "objects"), [(0, 4), (6, 0)])
def test_where_there_is_nothing_nothing_collides(way, placed, objects):
    rng = np.random.default_rng(6)
    cloud = np.zeros(placed, np.int32)
    arguments = random_clouds(rng), None, cloud, random_poses(rng, placed=placed), random_scene(rng, objects=objects)
    assert compiled(way)(*arguments, np.ones((placed, objects), bool)).shape == (placed, objects)


@pytest.mark.parametrize("way", WAYS)
def test_moving_clouds_and_objects_together_changes_nothing(way):
    rng = np.random.default_rng(7)
    points, T, scene = random_clouds(rng), random_poses(rng), random_scene(rng)
    cloud, mask = np.int32(rng.integers(0, 4, 6)), np.ones((6, 4), bool)
    world = np.asarray(transforms.upright_pose(jnp.float32([1.0, -2.0, 1.1]), 0.4))
    moved = scene.replace(
        position=scene.position @ world[:3, :3].T + world[:3, 3], rotation=world[:3, :3] @ scene.rotation
    )
    there = decides(way)(points, None, cloud, np.float32(world @ T), moved, mask)
    least = least_of_equation_5(points, cloud, T, scene)
    # A metre away, coordinates are known to a tenth of a micrometre.
    check(there, least, mask)
    assert 0 < np.sum(there) < mask.size


@pytest.mark.parametrize("way", TWO_WAYS)
def test_all_other_clouds_are_where_they_are_whatever_one_number_is(way):
    rng = np.random.default_rng(8)
    points, T, scene = random_clouds(rng), random_poses(rng), random_scene(rng)
    cloud, mask = np.int32(rng.integers(0, 4, 6)), np.ones((6, 4), bool)
    lost = T.copy()
    lost[2] = np.nan
    got, expected = (np.asarray(decides(way)(points, None, cloud, pose, scene, mask)) for pose in (lost, T))
    np.testing.assert_array_equal(np.delete(got, 2, axis=0), np.delete(expected, 2, axis=0))


@pytest.mark.parametrize("few", [0, 1 << 30])
def test_bounds_are_looked_at_where_there_are_many_pairs(monkeypatch, few):
    """They decide nothing else, but it is they that make many pairs fast."""
    counted = []
    bounds = collision._bounds
    monkeypatch.setattr(collision, "_bounds", lambda *a: counted.append(1) or bounds(*a))
    monkeypatch.setattr(collision, "FEW", few)
    rng = np.random.default_rng(9)
    clouds, cloud = clouds_of(jnp.asarray(random_clouds(rng))), np.zeros(6, np.int32)
    mask = jnp.ones((6, 4), bool)
    jax.eval_shape(lambda T, s: collision.collisions(clouds, cloud, T, s, mask), random_poses(rng), random_scene(rng))
    assert bool(counted) == (few == 0)


def test_the_kernel_lowers_for_a_gpu():
    # JAX needs no GPU for that before 0.11; afterwards it has to know of one.
    if tuple(int(v) for v in jax.__version__.split(".")[:2]) >= (0, 11) or not collision_kernel.kernel_available():
        pytest.skip("this version of JAX lowers the kernel only where there is a GPU")
    rng = np.random.default_rng(10)
    clouds = clouds_of(jnp.asarray(random_clouds(rng)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collision, "uses_kernel", lambda: True)
        run = jax.jit(lambda cloud, T, scene, mask: collision.collisions(clouds, cloud, T, scene, mask))
        traced = run.trace(np.zeros(6, np.int32), random_poses(rng), random_scene(rng), np.ones((6, 4), bool))
    assert "triton" in traced.lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.gpu
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_on_a_gpu_the_kernel_finds_what_equation_5_says(seed):
    rng = np.random.default_rng(seed)
    points, T, scene = random_clouds(rng, points=2500), random_poses(rng, 3, placed=20), random_scene(rng, 3, objects=7)
    cloud, mask = np.int32(rng.integers(0, 4, 20)), rng.random((3, 20, 7)) < 0.8
    clouds = clouds_of(jnp.asarray(points))
    run = jax.jit(jax.vmap(lambda T, scene, mask: collision.collisions(clouds, cloud, T, scene, mask)))
    check(run(T, scene, mask), least_of_equation_5(points, cloud, T, scene), mask)


@pytest.mark.parametrize(
    ("point", "hit"),
    [
        ((0.6, 0.1, 0.5), False),
        ((0.3, 0.1, 0.1), False),
        ((0.6, 0.1, 0.40), True),
        ((0.6, 0.1, 0.77), True),
        ((0.79, 0.1, 0.5), True),
        ((0.6, 0.4835 - 0.005, 0.5), True),
        ((0.6, -0.2835 + 0.005, 0.5), True),
        ((0.6, -0.2835 + 0.012, 0.5), False),
    ],
)
def test_the_shelf_is_what_surrounds_its_free_box(point, hit):
    assert bool(hits_shelf(Shelf(), jnp.float32(point))) == hit


def test_a_sphere_touches_the_board_a_radius_above_it():
    shelf = Shelf()
    radius = jnp.array([0.05])

    def hits(x, y, z):
        return bool(spheres_hit_shelf(shelf, jnp.float32([[x, y, z]]), radius)[0])

    assert hits(0.6, 0.1, shelf.board + 0.04)
    assert not hits(0.6, 0.1, shelf.board + 0.06)
    # In front of the board's edge, and diagonally in front of and above it.
    assert hits(shelf.front - 0.04, 0.1, shelf.board - 0.1)
    assert not hits(shelf.front - 0.06, 0.1, shelf.board - 0.1)
    assert not hits(shelf.front - 0.04, 0.1, shelf.board + 0.04)
