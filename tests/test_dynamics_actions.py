"""What actions do to objects as predicted, and which actions are offered."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax import actions, planner
from mechsearch_jax.actions import SAMPLED_KINDS, ActionConfig, ActionKind
from mechsearch_jax.actions.candidates import _shares
from mechsearch_jax.belief.belief import possible_space
from mechsearch_jax.dynamics import quasi_static, rigid
from mechsearch_jax.geometry import footprints, superquadric, transforms
from mechsearch_jax.observation import Observation
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace import scenario
from mechsearch_jax.workspace.shelf import Shelf

SHELF = Shelf()
MODEL = quasi_static.QuasiStatic()
PUSH = jax.jit(MODEL, static_argnums=0)
ALL_CANDIDATES = jax.jit(actions.all_candidates)
Q7 = jnp.zeros(())


def on_board(*bodies):
    """Objects that stand on the board from (half size, exponents, x, y, yaw), in eight slots."""
    size, exponents, x, y, yaw = zip(*bodies, strict=True)
    size = np.float32(size)
    position = np.stack([np.float32(x), np.float32(y), SHELF.board + size[:, 2]], axis=-1)
    return superquadric.pad(
        superquadric.Superquadrics(
            size=jnp.asarray(size),
            exponents=jnp.asarray(np.float32(exponents)),
            position=jnp.asarray(position),
            rotation=transforms.yaw_rotation(jnp.asarray(np.float32(yaw))),
            valid=jnp.ones(len(bodies), bool),
        ),
        8,
    )


def finger_at(x, y):
    """A finger-sized pusher and its pose."""
    grid = np.stack(np.meshgrid([-0.01, 0, 0.01], np.linspace(-0.01, 0.01, 5), np.linspace(-0.02, 0.02, 5)), -1)
    return jnp.float32(grid.reshape(-1, 3)), transforms.upright_pose(jnp.float32([x, y, 0.0]), SHELF.board + 0.03)


BOX = ((0.03, 0.03, 0.06), shape_of("box").exponents)
ROUND = ((0.03, 0.03, 0.06), shape_of("cylinder").exponents)


def yaw_of(rotation):
    return np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])


@pytest.mark.parametrize("shape", [BOX, ROUND])
def test_a_push_through_the_centre_moves_by_the_distance_less_the_gap(shape):
    scene = on_board((*shape, 0.6, 0.1, 0.0))
    pusher, T = finger_at(0.6, 0.1 - 0.03 - 0.01 - 0.01)
    after = PUSH(SHELF, scene, pusher, T, jnp.float32([0.0, 0.1, 0.0]), Q7)
    np.testing.assert_allclose(after.scene.position[0, :2], [0.6, 0.1 + 0.09], atol=2e-3)
    np.testing.assert_allclose(yaw_of(np.asarray(after.scene.rotation[0])), 0.0, atol=0.04)
    assert float(after.residual) < 1e-3


def test_a_push_off_the_centre_turns_a_box_the_right_way():
    scene = on_board((*BOX, 0.6, 0.1, 0.0))
    pusher, T = finger_at(0.58, 0.05)
    after = PUSH(SHELF, scene, pusher, T, jnp.float32([0.0, 0.08, 0.0]), Q7)
    assert yaw_of(np.asarray(after.scene.rotation[0])) < -0.05
    assert 0.01 < float(after.scene.position[0, 1]) - 0.1 < 0.07


def test_pushing_mirrored_scenes_gives_mirrored_results():
    middle = (SHELF.left + SHELF.right) / 2
    left = on_board((*BOX, 0.6, middle + 0.08, 0.3), (*ROUND, 0.62, middle + 0.16, 0.0))
    right = on_board((*BOX, 0.6, middle - 0.08, -0.3), (*ROUND, 0.62, middle - 0.16, 0.0))
    results = []
    for scene, side in ((left, 1.0), (right, -1.0)):
        pusher, T = finger_at(0.59, middle + side * 0.01)
        results.append(PUSH(SHELF, scene, pusher, T, jnp.float32([0.0, side * 0.1, 0.0]), Q7).scene)
    np.testing.assert_allclose(results[0].position[:2, 0], results[1].position[:2, 0], atol=2e-4)
    np.testing.assert_allclose(results[0].position[:2, 1] - middle, middle - results[1].position[:2, 1], atol=2e-4)


def test_a_pushed_object_pushes_its_neighbour_and_nothing_else_moves():
    scene = on_board((*BOX, 0.6, 0.1, 0.0), (*BOX, 0.6, 0.18, 0.0), (*BOX, 0.72, -0.2, 0.0))
    pusher, T = finger_at(0.6, 0.05)
    after = PUSH(SHELF, scene, pusher, T, jnp.float32([0.0, 0.1, 0.0]), Q7)
    assert after.moved.tolist() == [True, True] + [False] * 6
    np.testing.assert_array_equal(after.scene.position[2:], scene.position[2:])
    assert float(after.scene.position[1, 1] - after.scene.position[0, 1]) >= 0.06 - 2e-3


def test_an_object_against_the_wall_is_jammed():
    scene = on_board((*BOX, 0.6, SHELF.left - 0.03, 0.0))
    pusher, T = finger_at(0.6, SHELF.left - 0.08)
    after = PUSH(SHELF, scene, pusher, T, jnp.float32([0.0, 0.1, 0.0]), Q7)
    assert float(after.residual) > MODEL.max_penetration
    assert not after.resolved
    # One number is the whole limit.
    lenient = dataclasses.replace(MODEL, max_penetration=float(after.residual) + 1e-4)
    assert jax.jit(lenient, static_argnums=0)(SHELF, scene, pusher, T, jnp.float32([0.0, 0.1, 0.0]), Q7).resolved


def test_a_push_that_misses_moves_nothing():
    scene = on_board((*BOX, 0.6, 0.1, 0.0))
    pusher, T = finger_at(0.5, 0.05)
    after = PUSH(SHELF, scene, pusher, T, jnp.float32([0.0, 0.1, 0.0]), Q7)
    assert not after.moved.any()
    assert after.resolved


def side_grasp(x, y, yaw):
    """A horizontal grasp whose approach turns by `yaw` from +x."""
    rotation = gripper_rotation(jnp.float32(yaw), jnp.float32(0.0))
    return transforms.make(rotation, jnp.float32([x, y, 0.45]))


@pytest.mark.parametrize(("body", "expected"), [(ROUND, 0.2 + 0.5), (BOX, 0.1 + 0.5), (BOX, 0.1 + 0.5 - np.pi / 2)])
def test_pick_and_place_turns_flat_sides_into_the_hand_and_then_moves_rigidly(body, expected):
    yaw = expected - 0.5 + 0.1 * (body == BOX)
    scene = on_board((*body, 0.6, 0.1, yaw), (*ROUND, 0.55, -0.1, 0.0))
    grasp, place = side_grasp(0.6, 0.1, 0.1), side_grasp(0.7, -0.05, 0.6)
    after = jax.jit(rigid.pick_and_place)(scene, jnp.int32(0), grasp, place)
    np.testing.assert_allclose(after.position[0], [0.7, -0.05, scene.position[0, 2]], atol=1e-6)
    np.testing.assert_allclose(yaw_of(np.asarray(after.rotation[0])), expected, atol=1e-5)
    np.testing.assert_array_equal(after.position[1:], scene.position[1:])


def test_footprints_of_objects_on_their_side():
    scene = on_board((*ROUND, 0.6, 0.1, 0.0))
    lying = scene.replace(rotation=scene.rotation.at[0].set(jnp.float32([[1, 0, 0], [0, 0, -1], [0, 1, 0]])))
    prints = footprints.footprints(lying)
    assert not bool(prints.round[0])
    np.testing.assert_allclose(np.sort(prints.half[0]), [0.03, 0.06], rtol=1e-5)
    np.testing.assert_allclose(prints.high[0] - prints.low[0], 0.06, rtol=1e-5)


def of_kind(candidates, name):
    """The candidates of one kind among those of all."""
    return candidates[[kind.name for kind in SAMPLED_KINDS].index(name)]


@pytest.fixture(scope="module")
def draw(problem):
    """Samples many actions by the objects' weights in a shipped scene whose target is still hidden."""
    loaded = scenario.load_scenario(scenario.example_scenarios()["first-light"])
    objects = scenario.superquadrics(loaded.objects)
    observation = Observation(objects, jnp.array(False), jnp.zeros(3))
    belief = planner.update_belief(problem, planner.initial_belief(problem), observation)

    possible = possible_space(problem, belief, belief.exists)
    candidates = ALL_CANDIDATES(problem.space, objects, possible)

    @jax.jit
    def drawn(problem, possible, objects, candidates, weights, keys):
        sample = lambda key: actions.sample_action(  # noqa: E731
            key, problem.space, objects, possible, candidates, objects.valid, weights
        )
        return candidates, jax.vmap(sample)(keys)

    keys = jax.random.split(jax.random.key(0), 200)
    draw = lambda weights: jax.tree.map(  # noqa: E731
        np.asarray, drawn(problem, possible, objects, candidates, weights, keys)
    )
    draw.objects = objects
    return draw


@pytest.mark.parametrize(("deep", "locked"), [(-0.0005, False), (0.002, False), (0.004, True)])
def test_neighbours_that_are_recognised_as_overlapping_do_not_lock_each_other_in(problem, deep, locked):
    body = ((0.032, 0.032, 0.06), ROUND[1])
    pair = on_board((*body, 0.6, 0.05, 0.0), (*body, 0.6, 0.114 - deep, 0.0))
    belief = planner.initial_belief(problem)
    nowhere = possible_space(problem, belief, jnp.zeros_like(belief.exists))
    candidates = ALL_CANDIDATES(problem.space, pair, nowhere)
    grasps = of_kind(candidates, "pick-and-place")
    assert grasps.reached[0].any()
    assert actions.free_candidates(grasps)[0].any() != locked


@pytest.fixture(scope="module")
def sampled(draw):
    """Many actions, every object with the same weight."""
    return draw.objects, *draw(jnp.ones(draw.objects.capacity))


def test_objects_are_drawn_by_their_weights(sampled, draw):
    objects, _, even = sampled
    first = np.arange(objects.capacity) == 0
    weights = np.where(first, 4.0, 1.0)
    _, samples = draw(jnp.float32(weights))
    share, even_share = (np.mean(s.action.object == 0) for s in (samples, even))
    assert 0.2 < even_share < 0.8
    expected = 4 * even_share / (4 * even_share + 1 - even_share)
    assert share == pytest.approx(expected, abs=4 * np.sqrt(0.25 / len(samples.action.object)))
    assert share > even_share + 0.1


def test_candidates_of_an_object_are_drawn_by_their_weights_the_clean_ones_first():
    clean = jnp.array([[True, True, False], [False, False, False], [False, False, False]])
    usable = jnp.array([[True, True, True], [True, False, True], [False, False, False]])
    weight = jnp.float32([[1.0, 0.25, 1.0], [0.25, 1.0, 0.25], [1.0, 1.0, 1.0]])
    shares = np.asarray(_shares(clean, usable, weight))
    np.testing.assert_allclose(shares, [[0.8, 0.2, 0.0], [0.5, 0.0, 0.5], [0.0, 0.0, 0.0]])


def test_both_kinds_of_action_are_offered(sampled):
    kinds = sampled[2].action.kind
    assert np.mean(kinds == ActionKind.PUSH) > 0.05
    assert np.mean(kinds == ActionKind.PICK_AND_PLACE) > 0.05


def test_only_present_objects_are_moved(sampled):
    objects, _, samples = sampled
    moved = samples.action.object[samples.action.kind != ActionKind.NONE]
    assert np.all(np.asarray(objects.valid)[moved])


def test_pushes_go_in_the_given_directions_by_the_given_distances(sampled, problem):
    _, _, samples = sampled
    d = samples.action.displacement[samples.action.kind == ActionKind.PUSH]
    np.testing.assert_array_equal(d[:, 2], 0.0)
    assert set(np.rint(np.linalg.norm(d, axis=1) * 1000)) <= {50, 100, 150}
    config = problem.config.actions
    angles = np.arctan2(d[:, 1], d[:, 0])
    apart = np.abs(angles[:, None] - np.asarray(config.push_directions)[None])
    assert apart.min(axis=1).max() < 1e-5
    assert len(np.unique(apart.argmin(axis=1))) > 2


def test_placed_objects_stand_clear_of_each_other_on_the_board(sampled, problem):
    objects, _, samples = sampled
    action = samples.action
    place = jax.jit(rigid.pick_and_place)
    for i in np.flatnonzero(action.kind == ActionKind.PICK_AND_PLACE)[:25]:
        k = int(action.object[i])
        after = place(
            objects, jnp.int32(k), jnp.asarray(action.T_world_gripper[i]), jnp.asarray(action.T_world_place[i])
        )
        np.testing.assert_allclose(after.position[k, 2], objects.position[k, 2], atol=1e-5)
        cloud = superquadric.sample_surface(after.size[k], after.exponents[k], 400)
        world = transforms.transform(transforms.make(after.rotation[k], after.position[k]), cloud)
        others = after.replace(valid=after.valid.at[k].set(False))
        local = superquadric.to_object_frame(others, world)
        gauge = superquadric.gauge(others.size, others.exponents, local)
        assert float(jnp.min(jnp.where(others.valid[None], gauge, jnp.inf))) > 1.0
        assert float(jnp.min(world[:, 0])) > problem.shelf.front


def test_grasped_objects_fit_between_the_fingers(sampled, problem):
    objects, candidates, _ = sampled
    prints = footprints.footprints(objects)
    narrow = 2 * np.min(np.asarray(prints.half), axis=1)
    graspable = np.asarray(of_kind(candidates, "pick-and-place").reached).any(axis=(1, 2))
    assert np.all(narrow[graspable] <= problem.gripper.usable_opening + 1e-5)


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="a tuple of one or more kinds"):
        ActionConfig(actions="push")
    with pytest.raises(InputError, match='"throw" is unknown; use one or more of pick-and-place, push'):
        planner.build_problem(config=planner.standard(actions=("throw",)).problem)
    with pytest.raises(InputError, match="push_distances"):
        ActionConfig(push_distances=())
    for directions in ((), (0.0, 0.0), (3.2,), (float("nan"),)):
        with pytest.raises(InputError, match=r"push_directions .* different angles from -180 to 180 degrees"):
            ActionConfig(push_directions=directions)
    with pytest.raises(InputError, match=r"push_offsets .* shares from -1 to 1"):
        ActionConfig(push_offsets=(1.1,))
    for postures in ((), ((0.0, 3),)):
        with pytest.raises(InputError, match=r"push_postures .* pairs of a yaw and an index"):
            ActionConfig(push_postures=postures)
    with pytest.raises(InputError, match="contact_tolerance"):
        ActionConfig(contact_tolerance=-0.001)
    with pytest.raises(InputError, match="give as many each"):
        actions.action_tables(Gripper(), (0.0,), dataclasses.replace(ActionConfig()))
