"""What stands in the way of a gripper, and of what it holds, where they cross into the shelf along x."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.actions import approach, pick_and_place, push
from mechsearch_jax.actions.config import CLOSED, OPEN, ActionConfig, ActionSpace, action_tables
from mechsearch_jax.actions.nothing import no_action
from mechsearch_jax.dynamics import rigid
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.transforms import make, transform, translate, upright_pose, yaw_rotation
from mechsearch_jax.graspability import FoundGrasps, GraspConfig, grasp_hits, grasp_tables, gripper_rotation
from mechsearch_jax.planner import found_target
from mechsearch_jax.robot.entry import crossing_length
from mechsearch_jax.robot.gripper import Gripper, gripper_cloud
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

SHELF, GRIPPER = Shelf(), Gripper()
WRIST = 2


@pytest.fixture(scope="module")
def space():
    return ActionSpace(SHELF, GRIPPER, ActionConfig(), math.radians(45), 4, 3)


@pytest.fixture(scope="module")
def tables(space):
    return action_tables(GRIPPER, GraspConfig().wrists, space.config)


@pytest.fixture(scope="module")
def grasps():
    config = GraspConfig(yaws=3, tilts=(math.radians(30),), wrists=(math.radians(60),), points=512)
    return grasp_tables(SHELF, GRIPPER, Target(), config, candidates=False)


def pose(position, yaw=40.0, tilt=30.0):
    rotation = gripper_rotation(jnp.float32(math.radians(yaw)), jnp.float32(math.radians(tilt)))
    return make(rotation, jnp.float32(position))


def standing(*bodies, shape="box"):
    """Objects on the board from (half size, x, y), in two slots."""
    half, x, y = (np.float32(a) for a in zip(*bodies, strict=True))
    one = superquadric.Superquadrics(
        size=jnp.asarray(half),
        exponents=jnp.broadcast_to(jnp.float32(shape_of(shape).exponents), (len(x), 2)),
        position=jnp.stack([x, y, SHELF.board + half[:, 2]], axis=-1),
        rotation=yaw_rotation(jnp.zeros(len(x))),
        valid=jnp.ones(len(x), bool),
    )
    return superquadric.pad(one, 2)


# The hand is deep in the shelf where its approach begins, and this stands under its palm there: fingers that come
# along x run into it.
DEEP = (0.76, 0.1, 0.5)
BEFORE = 0.1


def in_the_way(T, top=-0.005):
    """A post under the palm where the approach to a pose begins, about as high as the finger tips are there."""
    T = np.asarray(T, np.float64)
    tips = T[:3, 3] - GRIPPER.approach * T[:3, 2]
    height = tips[2] + top - SHELF.board
    return standing(((0.012, 0.02, height / 2), tips[0] - BEFORE, tips[1]))


@functools.cache
def still_hand(opening, q7):
    return gripper_cloud(GRIPPER, opening, q7, 3000, seed=3).astype(np.float64)


def swept(T, opening, q7):
    """Points in all that the gripper sweeps on its crossing, in the world, float64."""
    T = np.asarray(T, np.float64)
    points = still_hand(opening, q7) @ T[:3, :3].T + T[:3, 3] - GRIPPER.approach * T[:3, 2]
    length = max(T[0, 3] - GRIPPER.approach * T[0, 2] - GRIPPER.nearest_outside, 0.0)
    return points[None] - np.linspace(0, length, 120)[:, None, None] * np.array([1.0, 0.0, 0.0])


def least_gauge(scene, points, grown=0.0):
    size = np.asarray(scene.size[0], np.float64) + grown
    e1, e2 = np.asarray(scene.exponents[0], np.float64)
    x, y, z = np.moveaxis(np.abs(points - np.asarray(scene.position[0], np.float64)) / size, -1, 0)
    return np.min((x ** (2 / e2) + y ** (2 / e2)) ** (e2 / e1) + z ** (2 / e1))


def test_the_gripper_hits_on_its_crossing_what_a_float64_reference_says(space, tables):
    rng = np.random.default_rng(0)
    hits = jax.jit(
        lambda T, scene: approach.crossing_hits(
            space, tables, OPEN, jnp.array([WRIST]), T[None], scene, scene.valid[None]
        )[0, 0]
    )
    seen = []
    for _ in range(60):
        T = pose((rng.uniform(0.6, 0.76), 0.1, 0.5), rng.uniform(-40, 40), rng.uniform(20, 30))
        tips = np.asarray(T)[:3, 3] - 0.3 * np.asarray(T)[:3, 2]
        half = (rng.uniform(0.015, 0.04), rng.uniform(0.015, 0.04), rng.uniform(0.08, 0.14))
        scene = standing(
            (half, tips[0] - rng.uniform(-0.06, 0.16), tips[1] + rng.uniform(-0.1, 0.1)),
            shape=str(rng.choice(["box", "cylinder"])),
        )
        points = swept(T, GRIPPER.max_opening, float(tables.q7[OPEN, WRIST]))
        found = bool(hits(T, scene))
        # Clouds have gaps: what is touched less than a centimetre deep may be missed.
        if least_gauge(scene, points) > 1.0 + 1e-3:
            assert not found
        elif float(crossing_length(T, 0.374, GRIPPER)) > 0.03 and least_gauge(scene, points, -0.01) < 1.0:
            assert found
        seen.append(found)
    assert 5 < sum(seen) < 50


def test_where_there_is_no_crossing_nothing_is_hit(space, tables):
    T = pose((0.56, 0.1, 0.5))
    scene = in_the_way(T, 0.1)
    mask = scene.valid[None]
    assert not approach.crossing_hits(space, tables, OPEN, jnp.array([WRIST]), T[None], scene, mask).any()


@pytest.mark.parametrize("ends", ["start", "end"])
def test_a_push_past_a_post_that_only_its_crossing_touches_is_impossible(space, tables, ends):
    way = jnp.float32([0.0, 0.25, 0.0])
    T = pose(DEEP)
    end = translate(T, way)
    scene = in_the_way(T if ends == "start" else end)
    action = no_action().replace(kind=jnp.int32(push.CODE), T_world_gripper=T, T_world_place=end, displacement=way)
    wrist, free = jnp.int32(WRIST), scene.replace(valid=jnp.zeros(2, bool))
    judge = jax.jit(lambda a, b: push.crossings_hit(space, tables, a, b, action, wrist, jnp.array(True)))
    approaches = jnp.stack([T, end])
    clear = approach.gripper_hits(tables, CLOSED, jnp.array([WRIST] * 2), approaches, scene, jnp.ones((2, 2), bool))
    assert not clear[:, 0].any()
    assert bool(judge(scene, scene))
    assert bool(judge(scene, free)) == (ends == "start")
    assert bool(judge(free, scene)) == (ends == "end")
    assert not bool(judge(free, free))


@pytest.mark.parametrize("ends", ["grasp", "place"])
def test_a_pick_past_a_post_that_only_its_crossing_touches_is_impossible(space, tables, ends):
    T, place = pose(DEEP), pose((DEEP[0], DEEP[1] + 0.15, DEEP[2]))
    post = in_the_way(T if ends == "grasp" else place)
    body = standing(((0.02, 0.02, 0.06), DEEP[0], DEEP[1]))
    scene = jax.tree.map(lambda a, b: jnp.stack([a[0], b[0]]), body, post)
    alone = scene.replace(valid=jnp.array([True, False]))
    action = no_action().replace(kind=jnp.int32(pick_and_place.CODE), T_world_gripper=T, T_world_place=place)

    @jax.jit
    def free(scene, outside):
        after = rigid.pick_and_place(scene, action.object, T, place)
        return pick_and_place.crossings_free(
            space, tables, scene, after, action, jnp.int32(WRIST), outside, jnp.array(True)
        )

    both = jnp.stack([T, place])
    clear = approach.gripper_hits(tables, OPEN, jnp.array([WRIST] * 2), both, scene, jnp.ones((2, 2), bool))
    assert not clear[:, 1].any()
    out = jnp.full(2, GRIPPER.outside[0])
    assert bool(free(alone, out))
    assert not bool(free(scene, out))


def test_what_is_held_must_get_past_too_and_out_of_the_shelf(space, tables):
    """Lower than the hand, but not than what hangs from it."""
    T, place = pose(DEEP), pose((DEEP[0], DEEP[1] + 0.15, DEEP[2]))
    post = in_the_way(T, -0.045)
    action = no_action().replace(kind=jnp.int32(pick_and_place.CODE), T_world_gripper=T, T_world_place=place)

    @jax.jit
    def free(half, post_there):
        body = standing(((0.02, 0.02, 0.06), DEEP[0], DEEP[1]))
        body = body.replace(size=body.size.at[0].set(half))
        scene = jax.tree.map(lambda a, b: jnp.stack([a[0], b[0]]), body, post)
        scene = scene.replace(valid=jnp.array([True, False]).at[1].set(post_there))
        after = rigid.pick_and_place(scene, action.object, T, place)
        out = jnp.full(2, GRIPPER.outside[0])
        return pick_and_place.crossings_free(
            space, tables, scene, after, action, jnp.int32(WRIST), out, jnp.array(True)
        )

    small = jnp.float32([0.02, 0.02, 0.06])
    hand = approach.crossing_hits(space, tables, OPEN, jnp.array([WRIST]), T[None], post, post.valid[None])
    assert not hand.any()
    assert bool(free(small, False))
    assert not bool(free(small, True))
    # Longer than there is room for between the gripper's place outside and the shelf.
    assert not bool(free(jnp.float32([0.2, 0.02, 0.06]), False))


def test_a_retrieval_past_a_post_that_only_its_crossing_touches_hits_it(grasps):
    T_world_target = upright_pose(jnp.float32([DEEP[0] - 0.02, DEEP[1], 0.0]), Target().height(SHELF))
    T = transform(T_world_target, grasps.T_target_gripper[:, :3, 3])
    turned = int(jnp.argmax(grasps.T_target_gripper[:, 1, 2]))
    grasp = make(grasps.T_target_gripper[turned, :3, :3], T[turned])
    feasible = jnp.arange(len(grasps.q7)) == turned
    for top, hit in ((-0.005, True), (-0.045, True), (-0.15, False)):
        scene = in_the_way(grasp, top)
        hits = found_target.crossing_hits(grasps, GRIPPER, scene, T_world_target, feasible)
        assert bool(hits[turned, 0]) == hit
        assert not hits[~np.asarray(feasible)].any()
        assert not hits[:, 1].any()
        found = FoundGrasps(T_world_target, feasible, jnp.zeros((len(grasps.q7), 1, 7)))
        z = grasp_hits(grasps, found, scene, jnp.ones(1, bool))
        assert not z.any()


def test_the_arm_is_followed_closely_to_just_before_the_fingers_close():
    poses, last = found_target.ARM_POSES, found_target.CROSSINGS + approach.CLOSE_WAYPOINTS - 1
    assert poses[-1] == last - 1
    # The longest way along x is 17 cm; the approach begins at row CROSSINGS.
    along = np.concatenate(
        [
            0.17 * np.arange(found_target.CROSSINGS) / found_target.CROSSINGS,
            0.17 + GRIPPER.approach * np.linspace(0.0, 1.0, approach.CLOSE_WAYPOINTS),
        ]
    )
    assert np.diff(along[poses]).max() <= 0.055
