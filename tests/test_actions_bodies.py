"""Actions on bodies of several parts: pushes, grasps, what the hand holds, and a whole decision about a mug."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import planner
from mechsearch_jax.actions import SAMPLED_KINDS, ActionKind, all_candidates, joint_trajectory
from mechsearch_jax.actions.kinds.object_grasps import ObjectGraspConfig, object_grasps
from mechsearch_jax.actions.kinds.placement import EDGE_SHARE, ObjectGrasp, placement
from mechsearch_jax.belief.belief import possible_space
from mechsearch_jax.belief.moved_target import nearest_candidate
from mechsearch_jax.belief.unseen_motion import reopened
from mechsearch_jax.dynamics import rigid
from mechsearch_jax.dynamics.learned import LearnedPush
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.geometry import bodies, superquadric
from mechsearch_jax.geometry.footprints import footprints
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.geometry.transforms import make, upright_pose, yaw_rotation
from mechsearch_jax.observation import Observation
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.workspace.shelf import Shelf

SHELF, GRIPPER, Q7 = Shelf(), Gripper(), jnp.zeros(())
BOX, CYLINDER = (0.2, 0.2), (0.2, 1.0)
SLOTS, PARTS = 4, 3


def body(place, yaw, *parts):
    """A body that stands on the board, of parts given by half-extents, exponents and places above its foot."""
    size, exponents, position = (np.float32(a) for a in zip(*parts, strict=True))
    count = len(parts)
    of_body = Superquadrics(
        size=jnp.asarray(size),
        exponents=jnp.asarray(exponents),
        position=jnp.asarray(position),
        rotation=jnp.broadcast_to(jnp.eye(3), (count, 3, 3)),
        valid=jnp.ones(count, bool),
    )
    foot = jnp.float32([*place, SHELF.board])
    return bodies.bodies_of(superquadric.pad(of_body, PARTS), foot, yaw_rotation(jnp.float32(yaw)))


def scene_of(*those):
    return superquadric.pad(jax.tree.map(lambda *a: jnp.stack(a), *those), SLOTS)


def mug(place, yaw=0.0, radius=0.034, tall=0.07, back=0.015, share=0.6):
    """A mug whose handle points along its first axis, and is as high as a share of it."""
    return body(
        place,
        yaw,
        ((radius, radius, tall), CYLINDER, (0.0, 0.0, tall)),
        ((back, 0.008, share * tall), BOX, (radius + back - 0.002, 0.0, tall)),
    )


def block(place, yaw=0.0, half=(0.03, 0.03, 0.06), exponents=BOX):
    return body(place, yaw, (half, exponents, (0.0, 0.0, half[2])))


def plain(scene):
    """A scene of one-part bodies without parts."""
    return scene.replace(parts=None)


def reordered(scene):
    return scene.replace(parts=jax.tree.map(lambda a: a[:, ::-1], scene.parts))


def filled(scene):
    """The first part of each body again wherever there is room for one."""
    there = scene.parts.valid

    def again(a):
        return jnp.where(there.reshape(*there.shape, *[1] * (a.ndim - 2)), a, a[:, :1])

    return scene.replace(parts=jax.tree.map(again, scene.parts))


def close(a, b, tolerance=2e-5):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=tolerance), a, b)


# --- pushes ----------------------------------------------------------------------------------------------------------


def finger_at(x, y):
    """A finger-sized pusher and its pose."""
    grid = np.stack(np.meshgrid([-0.01, 0, 0.01], np.linspace(-0.01, 0.01, 5), np.linspace(-0.02, 0.02, 5)), -1)
    return jnp.float32(grid.reshape(-1, 3)), upright_pose(jnp.float32([x, y, 0.0]), SHELF.board + 0.03)


QUASI_STATIC = jax.jit(QuasiStatic(), static_argnums=0)


@pytest.fixture(scope="module", params=["learned", pytest.param("quasi-static", marks=pytest.mark.slow)])
def model(request):
    if request.param == "quasi-static":
        return QUASI_STATIC
    learned = LearnedPush()
    return jax.jit(lambda *arguments: learned(*arguments), static_argnums=0)


WAY = jnp.float32([0.0, 0.1, 0.0])
SINGLE = scene_of(block((0.6, 0.1), 0.3), block((0.62, 0.2), 0.0, exponents=CYLINDER), block((0.5, 0.3)))


def test_pushes_of_one_part_bodies_do_not_change(model):
    pusher, T = finger_at(0.59, 0.04)
    before = model(SHELF, plain(SINGLE), pusher, T, WAY, Q7)
    after = model(SHELF, SINGLE, pusher, T, WAY, Q7)
    assert bool(before.moved[:2].all())
    close(before, after.replace(scene=plain(after.scene)))
    close(after.scene.parts, SINGLE.parts)


def test_the_order_and_the_number_of_equal_parts_do_not_count_in_a_push(model):
    pusher, T = finger_at(0.59, 0.04)
    scene = scene_of(mug((0.6, 0.1), 0.4), mug((0.6, 0.22), -2.0), block((0.5, 0.3)))
    once = model(SHELF, scene, pusher, T, WAY, Q7)
    assert bool(once.moved[0])
    for other in (reordered, filled):
        again = model(SHELF, other(scene), pusher, T, WAY, Q7)
        close(plain(once.scene), plain(again.scene))
        np.testing.assert_array_equal(once.moved, again.moved)


def test_between_parts_that_are_far_apart_nothing_is_touched():
    """Two posts of one body, 16 cm apart: the box that bounds them is pushed by none that moves between them."""
    post = (0.015, 0.015, 0.05)
    scene = scene_of(body((0.6, 0.1), 0.0, (post, BOX, (-0.08, 0.0, 0.05)), (post, BOX, (0.08, 0.0, 0.05))))
    pusher, T = finger_at(0.6, 0.04)
    through = QUASI_STATIC(SHELF, scene, pusher, T, WAY, Q7)
    assert not bool(through.moved.any())
    assert float(through.residual) == 0.0
    pusher, T = finger_at(0.68, 0.04)
    off = QUASI_STATIC(SHELF, scene, pusher, T, WAY, Q7)
    turned = off.scene.rotation[0]
    assert bool(off.moved[0])
    assert float(jnp.arctan2(turned[1, 0], turned[0, 0])) > 0.1


def test_a_handle_pushes_a_neighbour():
    """The round bodies are 11 cm apart, and the handle reaches the neighbour."""
    pusher, T = finger_at(0.6, 0.1 - 0.034 - 0.012)
    others = block((0.6, 0.21), half=(0.03, 0.03, 0.06))
    towards = scene_of(mug((0.6, 0.1), np.pi / 2), others)
    away = scene_of(mug((0.6, 0.1), np.pi), others)
    way = jnp.float32([0.0, 0.03, 0.0])
    assert bool(QUASI_STATIC(SHELF, towards, pusher, T, way, Q7).moved[1])
    assert not bool(QUASI_STATIC(SHELF, away, pusher, T, way, Q7).moved[1])


# --- grasps ----------------------------------------------------------------------------------------------------------

# From the front alone: from the side the box around a mug fits between the fingers, too.
CONFIG = ObjectGraspConfig(max_yaw=np.pi / 4)
GRASPS = jax.jit(lambda scene: object_grasps(SHELF, GRIPPER, footprints(scene), CONFIG, np.pi / 4, 3))


def test_grasps_of_one_part_bodies_do_not_change():
    (T, fits), (T_parts, fits_parts) = GRASPS(plain(SINGLE)), GRASPS(SINGLE)
    np.testing.assert_array_equal(fits, fits_parts)
    assert bool(fits[:3].any(axis=1).all())
    np.testing.assert_allclose(
        np.where(fits[..., None, None], T, 0), np.where(fits[..., None, None], T_parts, 0), atol=1e-5
    )


def test_a_mug_is_grasped_by_its_body_and_by_its_handle():
    scene = scene_of(mug((0.6, 0.1), np.pi / 2))
    assert not bool(GRASPS(plain(scene))[1][0].any())
    T, fits = GRASPS(scene)
    assert bool(fits[0].all())
    held = jax.vmap(lambda T: bodies.part_at(scene, jnp.int32(0), T[:3, 3]))(T[0])
    assert set(np.asarray(held).tolist()) == {0, 1}
    close(GRASPS(reordered(scene)), (T, fits))


def test_a_round_part_does_not_turn_in_the_hand_and_a_flat_one_takes_the_body_with_it():
    scene = scene_of(mug((0.6, 0.1), 0.3))
    index = jnp.int32(0)
    rotation = gripper_rotation(jnp.float32([0.1]), jnp.float32([0.35]))[0]
    by_body = make(rotation, bodies.placed_parts(scene).position[0, 0])
    close(rigid.in_hand(scene, index, by_body), scene.rotation[0])
    handle = bodies.placed_parts(scene).position[0, 1]
    by_handle = make(rotation, handle)
    held = rigid.in_hand(scene, index, by_handle)
    np.testing.assert_allclose(jnp.arctan2(held[1, 0], held[0, 0]), 0.1, atol=1e-3)
    # The handle stays between the fingers.
    after = rigid.pick_and_place(scene, index, by_handle, by_handle)
    np.testing.assert_allclose(bodies.placed_parts(after).position[0, 1], handle, atol=1e-5)
    close(after.parts, scene.parts)


def picks_of(problem):
    """A function from a scene to its candidates of picking, and the space that the target may fill: none."""
    belief = planner.initial_belief(problem)
    possible = possible_space(problem, belief, belief.exists & False)
    picks = [kind.surrounds_object for kind in SAMPLED_KINDS].index(True)
    return jax.jit(lambda scene: all_candidates(problem.space, scene, possible)[picks]), possible


@pytest.mark.slow
def test_no_grasp_passes_through_another_part_of_the_same_body(problem):
    candidates, _ = picks_of(problem)
    behind = scene_of(mug((0.55, 0.1), 0.0, back=0.03, share=0.95))
    towards = scene_of(mug((0.55, 0.1), np.pi, back=0.03, share=0.95))
    for scene, some in ((behind, True), (towards, False)):
        found = candidates(scene)
        held = jax.vmap(lambda T, scene=scene: bodies.part_at(scene, jnp.int32(0), T[:3, 3]))(found.T_world_gripper[0])
        head_on = np.abs(np.arctan2(*np.asarray(found.T_world_gripper[0, :, [1, 0], 2]))) < 0.1
        round_one = (np.asarray(held) == 0) & head_on
        assert bool(np.asarray(found.reached[0])[round_one].any()) == some


@pytest.mark.slow
def test_a_body_of_several_parts_is_put_away_from_the_edge(problem):
    candidates, possible = picks_of(problem)
    bottle = body(
        (0.6, 0.1),
        0.0,
        ((0.03, 0.03, 0.07), CYLINDER, (0.0, 0.0, 0.07)),
        ((0.03, 0.03, 0.03), CYLINDER, (0.0, 0.0, 0.17)),
    )

    @jax.jit
    def places(keys, scene, T_world_gripper, wrist):
        grasps = ObjectGrasp(jnp.zeros(len(wrist), jnp.int32), T_world_gripper, wrist, jnp.ones(len(wrist), bool))
        return jax.vmap(lambda key, grasp: placement(key, problem.space, scene, possible, grasp))(keys, grasps)

    def share_near_the_edge(scene):
        found = candidates(scene)
        reached = np.argwhere(np.asarray(found.reached[0]))
        which, wrist = reached[np.arange(128) % len(reached)].T
        keys = jax.random.split(jax.random.key(0), len(which))
        able, _, T_world_object = places(keys, scene, found.T_world_gripper[0, which], jnp.asarray(wrist))
        rim = np.asarray(T_world_object)[np.asarray(able), 0, 3] - 0.03 - problem.shelf.front
        assert len(rim) > 16
        return np.mean(rim < EDGE_SHARE * 0.2)

    assert share_near_the_edge(scene_of(bottle)) < 0.02
    assert share_near_the_edge(scene_of(block((0.6, 0.1), 0.0, (0.03, 0.03, 0.1), CYLINDER))) > 0.1


# --- a whole decision ------------------------------------------------------------------------------------------------

HIDDEN = (0.62, 0.10)
BEFORE = (0.545, 0.139)


def seen(scene):
    return Observation(scene, jnp.array(False), jnp.zeros(3))


def may_be(problem, scene, place):
    """Whether f allows the target at a place."""
    belief = planner.update_belief(problem, planner.initial_belief(problem), seen(scene))
    return belief, bool(belief.exists[nearest_candidate(problem.poses, jnp.float32([*place, 0.0]))])


@pytest.mark.slow
def test_a_mug_hides_the_target_and_is_moved(problem):
    hides = scene_of(mug(BEFORE, 2.0), block((0.6, 0.35)))
    _, elsewhere = may_be(problem, scene_of(mug((0.5, -0.15), 2.0), block((0.6, 0.35))), HIDDEN)
    belief, behind = may_be(problem, hides, HIDDEN)
    assert behind
    assert not elsewhere
    policy = planner.search_for_grasp(sequences=16, horizon=1)
    decision = policy(jax.random.key(0), problem, belief, seen(hides))
    assert int(decision.action.kind) != ActionKind.NONE
    assert int(decision.action.object) == 0
    assert float(decision.predicted_cost) < float(decision.cost)
    # A rigid motion: the body's pose changes and its parts, in its frame, do not.
    close(decision.predicted.parts, hides.parts, 0.0)
    assert float(jnp.linalg.norm(decision.predicted.position[0] - hides.position[0])) > 0.02
    trajectory = joint_trajectory(problem, decision.action, observation=seen(hides))
    assert bool(jnp.isfinite(trajectory.position).all())
    # What was moved may have taken the hidden target along.
    opened = reopened(problem, belief.exists, hides, decision.predicted, decision.action)
    assert opened.shape == belief.exists.shape
    after = planner.update_belief(problem, belief, seen(decision.predicted), seen(hides), decision.action)
    assert bool(after.exists.any())
