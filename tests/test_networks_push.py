"""The push network: its symmetries, its input features, and the push model around it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mechsearch_jax.actions import ActionConfig, action_tables
from mechsearch_jax.dynamics import learned
from mechsearch_jax.dynamics.learned import LearnedPush, predicted
from mechsearch_jax.envs.scenes.generator import separation
from mechsearch_jax.geometry import footprints, superquadric, transforms
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.networks import push
from mechsearch_jax.networks import push_contacts as contacts
from mechsearch_jax.networks.push import PushConfig, PushNetwork
from mechsearch_jax.networks.push_contacts import REACH
from mechsearch_jax.networks.push_geometry import POINTS, push_geometry, push_start
from mechsearch_jax.networks.weights import read_card, save_weights
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf

SHELF = Shelf()
# Nothing is within reach of these walls.
OPEN = Shelf(front=-10.0, back=10.0, right=-10.0, left=10.0)
CONFIG = PushConfig(width=16, layers=2)
BOX, ROUND = shape_of("box").exponents, shape_of("cylinder").exponents


@functools.cache
def pusher():
    config = ActionConfig()
    return action_tables(Gripper(), config.push_wrists, config).pusher


def standing(*bodies, shelf=SHELF):
    """Objects on the board from (half size, exponents, x, y, yaw)."""
    size, exponents, x, y, yaw = zip(*bodies, strict=True)
    size = np.float32(size)
    return Superquadrics(
        size=jnp.asarray(size),
        exponents=jnp.asarray(np.float32(exponents)),
        position=jnp.asarray(np.stack([np.float32(x), np.float32(y), shelf.board + size[:, 2]], axis=-1)),
        rotation=transforms.yaw_rotation(jnp.asarray(np.float32(yaw))),
        valid=jnp.ones(len(bodies), bool),
    )


def gripper_at(x, y, z=0.04, yaw=0.0):
    rotation = gripper_rotation(jnp.float32(yaw), jnp.float32(np.radians(30)))
    return transforms.make(rotation, jnp.float32([x, y, SHELF.board + z]))


def cluttered(seed, count=5):
    """A crowd around an object that is pushed to the left, the gripper beside it, and how it moves."""
    rng = np.random.default_rng(seed)
    bodies = []
    for i in range(count):
        round_one = (i + seed) % 2 == 1
        half = rng.uniform((0.015, 0.015, 0.03), (0.06, 0.06, 0.1))
        half[1] = half[0] if round_one else half[1]
        x, y = (0.6, 0.0) if i == 0 else (rng.uniform(0.5, 0.75), rng.uniform(-0.05, 0.3))
        bodies.append((tuple(half), ROUND if round_one else BOX, x, y, rng.uniform(-3, 3)))
    T = gripper_at(rng.uniform(0.56, 0.6), -0.16, yaw=rng.uniform(-0.4, 0.4))
    angle, length = np.pi / 2 + rng.uniform(-0.5, 0.5), rng.uniform(0.05, 0.2)
    return standing(*bodies), T, jnp.float32([length * np.cos(angle), length * np.sin(angle), 0.0])


@functools.cache
def parameters(config=CONFIG):
    """Of a network that has much to say."""
    scene, T, displacement = cluttered(0)
    start = push_start(SHELF, scene, pusher(), T, displacement)
    fresh = jax.jit(PushNetwork(config).init)(jax.random.key(3), start)["params"]
    for name in ("even", "odd"):
        fresh["trunk"][name]["kernel"] = fresh["trunk"][name]["kernel"] * 500.0
    return fresh


@functools.partial(jax.jit, static_argnames="config")
def answer(weights, points, scene, T, displacement, shelf, config):
    return push.apply_network(PushNetwork(config), weights, push_start(shelf, scene, points, T, displacement))


def prediction(scene, T, displacement, shelf=OPEN, config=CONFIG, points=None):
    # All have the same shape, so that they share a program.
    points = pusher()[:POINTS] if points is None else points
    return answer(parameters(config), points, scene, T, displacement, shelf, config)


def symmetric_points():
    """Points of a gripper that is its own mirror image; the real one's are spread without regard to that."""
    half = pusher()[: POINTS // 2]
    return jnp.concatenate([half, half * jnp.float32([1.0, -1.0, 1.0])[None]])


def moved(yaw, x, y, scene, T, displacement):
    """All of a push turned about the origin and moved."""
    rotation = transforms.yaw_rotation(jnp.float32(yaw))
    motion = transforms.make(rotation, jnp.float32([x, y, 0.0]))
    turned = scene.replace(
        position=transforms.transform(motion, scene.position), rotation=transforms.matmul(rotation, scene.rotation)
    )
    return turned, transforms.compose(motion, T), transforms.rotate(rotation, displacement)


def turned_back(yaw, shift):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(shift) @ np.array([[c, -s], [s, c]])


def assert_same(a, b, valid=slice(None), shift=2e-5, other=2e-3):
    np.testing.assert_allclose(np.asarray(a.shift)[valid], np.asarray(b.shift)[valid], atol=shift)
    np.testing.assert_allclose(np.asarray(a.turn)[valid], np.asarray(b.turn)[valid], atol=other)
    np.testing.assert_allclose(np.asarray(a.moves)[valid], np.asarray(b.moves)[valid], atol=other)
    np.testing.assert_allclose(np.asarray(a.topples)[valid], np.asarray(b.topples)[valid], atol=other)
    np.testing.assert_allclose(np.asarray(a.log_scale)[valid], np.asarray(b.log_scale)[valid], atol=other)


# --- symmetries ------------------------------------------------------------------------------------------------------


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 200), st.floats(-np.pi, np.pi), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_turning_and_moving_everything_turns_and_moves_the_answer(seed, yaw, x, y):
    case = cluttered(seed)
    before, after = prediction(*case), prediction(*moved(yaw, x, y, *case))
    assert np.abs(before.moves).max() > 0.1
    assert_same(before, after.replace(shift=turned_back(yaw, after.shift)))


def mirror_image(scene, T, displacement, middle=0.0):
    """The push seen in a mirror along x: y is the other way round. The hand is its own mirror image."""
    flip = jnp.float32([1.0, -1.0, 1.0])
    position = scene.position * flip[None] + jnp.float32([0.0, 2 * middle, 0.0])[None]
    # Every shape has the plane of its own first and third axes as a mirror.
    rotation = scene.rotation * flip[None, :, None] * flip[None, None, :]
    mirrored = T.at[:3, :3].set(T[:3, :3] * flip[:, None] * flip[None]).at[1, 3].set(2 * middle - T[1, 3])
    return scene.replace(position=position, rotation=rotation), mirrored, displacement * flip


@pytest.mark.parametrize("seed", range(4))
def test_a_mirrored_push_has_the_mirrored_outcome(seed):
    case, middle = cluttered(seed), (SHELF.left + SHELF.right) / 2
    a = prediction(*case, shelf=SHELF, points=symmetric_points())
    b = prediction(*mirror_image(*case, middle), shelf=SHELF, points=symmetric_points())
    assert_same(a, b.replace(shift=b.shift * jnp.float32([1.0, -1.0])[None], turn=-b.turn))


def test_a_box_after_half_a_turn_and_a_cylinder_after_any_are_the_same():
    scene, T, displacement = cluttered(3)
    is_round = np.asarray(scene.exponents[:, 1]) > 0.5
    assert is_round.any()
    assert not is_round.all()
    yaw = jnp.where(jnp.asarray(is_round), 1.234, np.pi)
    again = scene.replace(rotation=transforms.matmul(scene.rotation, transforms.yaw_rotation(yaw)))
    assert_same(prediction(scene, T, displacement), prediction(again, T, displacement))


def test_a_box_described_with_its_axes_swapped_is_the_same():
    scene, T, displacement = cluttered(3)
    boxes = jnp.asarray(np.asarray(scene.exponents[:, 1]) < 0.5)
    quarter = transforms.matmul(scene.rotation, transforms.yaw_rotation(jnp.full(5, np.pi / 2)))
    swapped = scene.replace(
        size=jnp.where(boxes[:, None], scene.size[:, jnp.array([1, 0, 2])], scene.size),
        rotation=jnp.where(boxes[:, None, None], quarter, scene.rotation),
    )
    assert_same(prediction(scene, T, displacement), prediction(swapped, T, displacement))


def test_the_order_of_the_objects_does_not_matter():
    scene, T, displacement = cluttered(4)
    order = np.array([3, 0, 4, 2, 1])
    shuffled = prediction(jax.tree.map(lambda a: a[order], scene), T, displacement)
    assert_same(jax.tree.map(lambda a: a[order], prediction(scene, T, displacement)), shuffled, shift=1e-6, other=1e-5)


def test_absent_objects_change_nothing():
    scene, T, displacement = cluttered(5)
    padded = superquadric.pad(scene, 8)
    # What an empty slot holds is nobody's business.
    padded = padded.replace(
        position=padded.position.at[5:].set(scene.position[0] + 0.01), size=padded.size.at[5:].set(0.05)
    )
    present, absent = prediction(scene, T, displacement), prediction(padded, T, displacement)
    assert_same(present, absent, slice(5), shift=1e-6, other=1e-5)
    assert np.isfinite(absent.shift).all()


def test_neighbours_and_walls_matter_where_they_are_near():
    scene, T, displacement = cluttered(6)
    alone = prediction(scene.replace(valid=jnp.arange(5) == 0), T, displacement)
    assert np.abs(alone.shift[0] - prediction(scene, T, displacement).shift[0]).max() > 1e-4
    wall = dataclasses.replace(OPEN, back=0.8)
    near, nearer, far, farther = (
        prediction(*moved(0.0, x, 0.0, scene, T, displacement), shelf=wall).shift for x in (0.0, 0.05, -0.5, -0.6)
    )
    assert np.abs(near - nearer).max() > 1e-4
    np.testing.assert_allclose(far, farther, atol=2e-5)
    np.testing.assert_allclose(far, prediction(scene, T, displacement).shift, atol=2e-5)


# --- the network's input features ------------------------------------------------------------------------------------


def travelled(inside, longest):
    """The first of small steps after which something is inside."""
    steps = np.arange(0.0, longest, 2e-4)
    hits = inside(steps)
    return np.where(hits.any(axis=-1), steps[np.argmax(hits, axis=-1)], longest)


def test_the_distance_to_contact_is_that_of_small_steps():
    scene, T, displacement = cluttered(7)
    prints = footprints.footprints(scene)
    heading = displacement[:2] / jnp.linalg.norm(displacement[:2])
    points = transforms.transform(T, pusher())
    distance, level = jax.jit(contacts.pusher_distance)(prints, points, heading)
    half, yaw, centre = (np.asarray(a, float) for a in (prints.half, prints.yaw, prints.position))
    for i in range(5):
        axes = np.array([[np.cos(yaw[i]), np.sin(yaw[i])], [-np.sin(yaw[i]), np.cos(yaw[i])]])
        start, speed = (np.asarray(points)[:, :2] - centre[i]) @ axes.T, axes @ np.asarray(heading, float)

        def inside(steps, i=i, start=start, speed=speed):
            local = np.abs(start[:, None] + steps[None, :, None] * speed) / half[i]
            return (local**2).sum(-1) < 1 if prints.round[i] else (local < 1).all(-1)

        expected = travelled(inside, REACH)
        across = np.abs((np.asarray(points)[:, :2] - centre[i]) @ [-float(heading[1]), float(heading[0])])
        side = jnp.broadcast_to(contacts.perpendicular(heading)[None], (5, 2))
        clear = np.abs(across - float(contacts.reach(prints, side)[i])) > 3e-3
        ahead = expected > 0
        np.testing.assert_allclose(np.maximum(distance[i], 0.0)[clear & ahead], expected[clear & ahead], atol=5e-4)
    assert level.any()


def outline_of(prints, i, corners=180):
    """A footprint's outline as a convex polygon in the world, in float64."""
    angle = np.arange(corners) * 2 * np.pi / corners
    unit = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1) if prints.round[i] else unit
    c, s = np.cos(float(prints.yaw[i])), np.sin(float(prints.yaw[i]))
    return (unit * np.asarray(prints.half[i], float)) @ np.array([[c, s], [-s, c]]) + np.asarray(prints.position[i])


def test_the_distance_between_objects_is_that_of_small_steps():
    scene, _, displacement = cluttered(9)
    prints = footprints.footprints(scene)
    heading = np.asarray(displacement[:2], float) / np.linalg.norm(displacement[:2])
    met = jax.jit(contacts.meetings)(prints, jnp.float32(heading))
    distance, gap = met.distance, met.gap
    count = 0
    for i in range(5):
        for j in set(range(5)) - {i}:
            a, b = outline_of(prints, i), outline_of(prints, j)
            apart = separation(a, b)
            if prints.round[i] or prints.round[j]:
                # `separation` is of polygons here, too.
                assert gap[i, j] == pytest.approx(apart, abs=2e-4)
            else:
                assert apart - 0.02 * np.linalg.norm(a.mean(axis=0) - b.mean(axis=0)) - 1e-4 < gap[i, j] < apart + 1e-4
            hits = np.array([separation(a + d * heading, b) < 0 for d in np.arange(0.0, REACH, 1e-3)])
            # Where they only graze each other it is a matter of fractions of a millimetre.
            if apart > 0 and hits.sum() > 20:
                count += 1
                assert distance[i, j] == pytest.approx(1e-3 * np.argmax(hits), abs=1.5e-3)
            elif apart > 0 and not hits.any():
                side = np.array([-heading[1], heading[0]])
                if max((b @ side).min() - (a @ side).max(), (a @ side).min() - (b @ side).max()) > 1e-3:
                    assert distance[i, j] == pytest.approx(REACH)
    assert count >= 2


def test_cylinders_that_touch_are_not_met_on_the_way_apart():
    # The second is half a millimetre behind the first and to its left.
    away = 0.0805 * np.array([-np.cos(0.5), np.sin(0.5)])
    scene = standing(
        ((0.03, 0.03, 0.05), ROUND, 0.6, 0.0, 0.0), ((0.05, 0.05, 0.05), ROUND, 0.6 + away[0], away[1], 0.0)
    )
    met = jax.jit(contacts.meetings)(footprints.footprints(scene), jnp.float32([1.0, 0.0]))
    assert float(met.gap[0, 1]) == pytest.approx(5e-4, abs=1e-6)
    assert float(met.distance[0, 1]) == pytest.approx(REACH)
    assert float(met.distance[1, 0]) == pytest.approx(5e-4 / np.cos(0.5), abs=2e-4)


def test_an_object_is_reached_through_another():
    shape = ((0.02, 0.02, 0.05), BOX)
    scene = standing(
        (*shape, 0.6, 0.0, 0.0), (*shape, 0.6, 0.07, 0.0), (*shape, 0.7, 0.07, 0.0), (*shape, 0.6, -0.3, 0.0)
    )
    # One point, 4 cm before the first: which is 3 cm before the second; the third is beside and the fourth behind.
    start = push_start(OPEN, scene, jnp.zeros((1, 3)), gripper_at(0.6, -0.06), jnp.float32([0.0, 0.1, 0.0]))
    geometry = jax.jit(push_geometry)(start)
    np.testing.assert_allclose(geometry.carry, [0.06, 0.03, 0.0, 0.0], atol=1e-6)


def test_jit_and_vmap_agree():
    cases = [cluttered(seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *cases)
    batch = jax.vmap(functools.partial(answer, parameters(), pusher(), shelf=OPEN, config=CONFIG))(*stacked)
    for i, case in enumerate(cases):
        assert_same(prediction(*case), jax.tree.map(lambda a, i=i: a[i], batch), shift=1e-6, other=1e-4)


@pytest.mark.slow
def test_eager_and_jit_agree():
    case = cluttered(0)
    with jax.disable_jit():
        eager = prediction(*case)
    assert_same(prediction(*case), eager, shift=1e-6, other=1e-4)


@pytest.mark.slow
def test_gradients_are_finite_also_where_things_touch_or_nothing_moves():
    aligned = standing(
        ((0.03, 0.03, 0.05), BOX, 0.6, 0.1, 0.0),
        ((0.03, 0.03, 0.05), BOX, 0.6, 0.16, 0.0),
        ((0.03, 0.03, 0.05), ROUND, 0.66, 0.1, 0.0),
    )

    points = pusher()

    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 1, 2, 3))
    def gradient(position, T, displacement, weights):
        start = push_start(SHELF, aligned.replace(position=position), points, T, displacement)
        motion = push.apply_network(PushNetwork(CONFIG), weights, start)
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(motion))

    # High above, nothing of the gripper is level with the objects, though it is deep inside their footprints.
    for y, z, length in ((0.0, 0.04, 0.1), (0.1, 0.04, 0.1), (0.0, 0.04, 0.0), (0.1, 0.2, 0.1)):
        gradients = gradient(aligned.position, gripper_at(0.6, y, z), jnp.float32([0.0, length, 0.0]), parameters())
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    assert any(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradients[3]))


# --- the push model --------------------------------------------------------------------------------------------------


@pytest.fixture
def weights(tmp_path):
    """The path of weights."""
    save_weights(tmp_path / "push.npz", "push", CONFIG, parameters(), {})
    return tmp_path / "push.npz"


def test_what_does_not_move_stays_exactly_where_it_is(weights):
    scene, T, displacement = cluttered(2)
    expected = prediction(scene, T, displacement, shelf=SHELF)
    probability = np.sort(jax.nn.sigmoid(expected.moves))
    model = LearnedPush(weights, likely=float(probability[1:3].mean()))
    outcome = jax.jit(model, static_argnums=0)(SHELF, scene, pusher(), T, displacement, jnp.zeros(()))
    same = np.asarray(~outcome.moved)
    assert same.sum() == 2
    for a, b in zip(jax.tree.leaves(scene), jax.tree.leaves(outcome.scene), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[same], np.asarray(b)[same])
    np.testing.assert_allclose(
        (outcome.scene.position - scene.position)[~same, :2], np.asarray(expected.shift)[~same], atol=2e-4
    )
    assert ((outcome.topples >= 0) & (outcome.topples <= 1)).all()
    assert float(outcome.residual) >= 0


@functools.cache
def everything_moves(limit):
    """The push model for which every object moves."""
    return jax.jit(functools.partial(predicted, PushNetwork(CONFIG), parameters(), 0.0, limit), static_argnums=0)


def test_a_pushed_object_turns_by_the_predicted_angle():
    scene, T, displacement = cluttered(3)
    expected = prediction(scene, T, displacement, shelf=SHELF)
    outcome = everything_moves(0.0)(SHELF, scene, pusher(), T, displacement, jnp.zeros(()))
    change = transforms.matmul(outcome.scene.rotation, jnp.swapaxes(scene.rotation, -1, -2))
    np.testing.assert_allclose(np.arctan2(change[:, 1, 0], change[:, 0, 0]), expected.turn, atol=1e-5)
    np.testing.assert_allclose(outcome.scene.position[:, 2], scene.position[:, 2], atol=1e-7)


def test_a_push_is_resolved_up_to_the_overlap_that_is_allowed():
    scene, T, _ = cluttered(2)
    # Weights that nobody trained leave the objects where the gripper goes.
    displacement = jnp.float32([0.0, 0.12, 0.0])
    left = []
    for limit, resolved in ((0.0, False), (0.01, False), (1.0, True)):
        outcome = everything_moves(limit)(SHELF, scene, pusher(), T, displacement, jnp.zeros(()))
        left.append(float(outcome.residual))
        assert bool(outcome.resolved) == resolved == (left[0] <= limit)
    # What is left over is what there is, whatever is allowed.
    assert left[0] == left[1] == left[2] > 0.01


def test_the_weights_that_ship_push_as_one_expects():
    model = LearnedPush()
    body = (0.03, 0.04, 0.06), BOX
    scene = standing((*body, 0.6, 0.0, 0.0), (*body, 0.6, 0.08, 0.0), (*body, 0.6, 0.4, 0.0))
    T = gripper_at(0.63, -0.16)
    push = jax.jit(model, static_argnums=0)
    outcome = push(SHELF, scene, pusher(), T, jnp.float32([0.0, 0.1, 0.0]), jnp.zeros(()))
    shift = np.asarray(outcome.scene.position - scene.position)
    # The second is met by the first, which is where it was to begin with; nothing comes near the third.
    assert 0.06 < shift[0, 1] < 0.11
    assert 0.05 < shift[1, 1] < 0.11
    assert (shift[2] == 0).all()
    assert np.abs(shift[:, 0]).max() < 0.02
    assert (outcome.topples < 0.5).all()
    # At its upper edge, a slender object falls over instead.
    slender = superquadric.pad(standing(((0.02, 0.02, 0.11), BOX, 0.6, 0.0, 0.0)), 3)
    high = push(SHELF, slender, pusher(), gripper_at(0.62, -0.14, z=0.18), jnp.float32([0.0, 0.1, 0.0]), jnp.zeros(()))
    assert float(high.topples[0]) > 0.5


def test_the_network_that_ships_is_not_traced_before_it_is_needed(monkeypatch):
    monkeypatch.setattr(learned, "load_weights", None)
    assert LearnedPush().digest == read_card(LearnedPush().path, "push")["sha256"]
