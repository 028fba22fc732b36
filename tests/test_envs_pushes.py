"""Random pushes: what is drawn, what the simulation makes of it, what is kept of that, and learning from it."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.pushing import pushes as generator
from mechsearch_jax.envs.pushing.push_portions import portions
from mechsearch_jax.envs.pushing.pushes import Generation, Pushes, PushesConfig, draw_push, generate_pushes, push_tables
from mechsearch_jax.envs.simulators.native import NativeSimulator
from mechsearch_jax.envs.world.world import TARGET, World, bodies_of, from_scenario, superquadrics
from mechsearch_jax.geometry import transforms
from mechsearch_jax.networks.push import PushConfig
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes.primitives import BOX, CYLINDER
from mechsearch_jax.train.loop import TrainConfig, train
from mechsearch_jax.train.push import PushTask
from mechsearch_jax.train.push_scores import (
    average_precision,
    planar_turn,
)
from mechsearch_jax.train.scenes import SceneConfig, random_world
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf

SHELF = Shelf()
CONFIG = PushesConfig()
SCENES = SceneConfig(objects=(2, 5), lying=0.1, leaning=0.0, placements=8)
DRAW_WORLD = functools.partial(random_world, config=SCENES)


WORLDS = 8


def simulated(seed, rounds):
    # As many worlds everywhere, so that everything is compiled once.
    simulator = NativeSimulator(2, generator.push_simulation())
    return generate_pushes(jax.random.key(seed), WORLDS, rounds, simulator, DRAW_WORLD)


@pytest.fixture(scope="module")
def pushes():
    return simulated(0, 4)


@pytest.fixture(scope="module")
def drawn():
    """Many worlds and a push that was drawn in each; the tables too."""
    tables = push_tables(CONFIG)

    @jax.jit
    def draw(keys):
        def one(key):
            scene, push = jax.random.split(key)
            world = DRAW_WORLD(scene)
            # One world in eight is empty.
            world = world.replace(valid=world.valid & (jax.random.bits(scene) % 8 > 0))
            return world, *draw_push(push, world, tables, CONFIG, SHELF)

        return jax.lax.map(one, keys, batch_size=16)

    return jax.device_get(draw(jax.random.split(jax.random.key(5), 128))), tables


# --- what is drawn ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_pushes_of_all_directions_and_lengths_are_found(drawn):
    (world, action, possible), _ = drawn
    assert possible[world.valid.any(axis=1)].mean() > 0.6
    assert (action.kind == possible).all()
    assert world.valid[np.arange(128), action.object][possible].all()
    assert (action.object[possible] < TARGET).all()
    along = action.displacement[possible]
    length = np.linalg.norm(along, axis=1)
    assert length.min() < 0.06
    assert length.max() > 0.16
    assert ((length >= CONFIG.lengths[0] - 1e-6) & (length <= CONFIG.lengths[1] + 1e-6)).all()
    sideways = np.abs(along[:, 0]) < 1e-6
    assert min(np.sum(along[sideways, 1] > 0), np.sum(along[sideways, 1] < 0), np.sum(~sideways)) > 10
    assert (along[:, 0] > -1e-6).all()
    assert (along[:, 2] == 0).all()


def in_body(world, k, i, points, share=1.0):
    """Which points are inside a true box or cylinder, or inside such a share of it, in float64."""
    rotation, half = world.rotation[k, i].astype(float), share * world.half_size[k, i].astype(float)
    local = (points - world.position[k, i]) @ rotation
    flat = np.hypot(local[:, 0], local[:, 1]) < half[0]
    if world.kind[k, i] == BOX:
        flat = (np.abs(local[:, :2]) < half[:2]).all(axis=1)
    return flat & (np.abs(local[:, 2]) < half[2])


@pytest.mark.slow
def test_the_gripper_starts_beside_the_object_and_inside_of_nothing(drawn):
    (world, action, possible), tables = drawn
    pusher = np.asarray(tables.pusher, float)
    gaps = []
    for k in np.flatnonzero(possible)[:60]:
        T = action.T_world_gripper[k].astype(float)
        points = pusher @ T[:3, :3].T + T[:3, 3]
        # Superquadrics, against which pushes are tested, lack 7% at the corners.
        assert not any(in_body(world, k, i, points, 0.93).any() for i in np.flatnonzero(world.valid[k]))
        assert (points[points[:, 0] > SHELF.front, 2] > SHELF.board).all()
        # Moved on by little, it is in the object that it is to push.
        step = action.displacement[k] / np.linalg.norm(action.displacement[k])
        hits = [in_body(world, k, action.object[k], points + d * step).any() for d in np.arange(0, 0.03, 1e-3)]
        gaps.append(1e-3 * np.argmax(hits) if any(hits) else np.inf)
    # A lying cylinder is taken for its bounding box: its side is farther away than that.
    assert np.mean(np.array(gaps) < 0.021) > 0.85
    assert np.median(gaps) == pytest.approx(0.5 * sum(CONFIG.gap), abs=4e-3)


# --- what becomes of it ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_objects_are_displaced_along_the_push(pushes):
    count = len(pushes.object)
    assert count > 15
    rows = np.arange(count)
    shift = (pushes.after.position - pushes.before.position)[rows, pushes.object]
    length = np.linalg.norm(pushes.displacement, axis=1)
    along = np.sum(shift * pushes.displacement, axis=1) / length
    upright = ~pushes.toppled[rows, pushes.object]
    # Pushed objects do not outrun the gripper by much, hardly ever go back, and most are taken along.
    assert (along[upright] < length[upright] + 0.03).all()
    assert (along[upright] > -0.005).all()
    assert np.median((along / np.maximum(length - 0.01, 0.01))[upright]) == pytest.approx(1.0, abs=0.35)


def upright_world(kind, rotation):
    """A world of one body."""
    valid = np.zeros(9, bool)
    valid[0] = True
    rotation = np.broadcast_to(rotation, (9, 3, 3)).astype(np.float32)
    kinds, half = np.full(9, kind, np.int32), np.full((9, 3), 0.03, np.float32)
    return jax.tree.map(jnp.asarray, World(kinds, half, np.zeros((9, 3), np.float32), rotation, valid))


@pytest.mark.parametrize(
    ("kind", "before", "after", "expected"),
    [
        (BOX, "", ("z", 80), False),
        (BOX, "", ("x", 90), True),
        (BOX, "", ("x", 10), False),
        (BOX, "", ("y", 25), True),
        (CYLINDER, "", ("y", 90), True),
        (CYLINDER, "lying", ("x", 170), False),
        (CYLINDER, "lying", ("z", 100), False),
        (BOX, "lying", ("x", 90), True),
    ],
)
def test_what_has_toppled(kind, before, after, expected):
    first = Rotation.from_euler("x", 90 if before else 0, degrees=True)
    # Lying along y, a cylinder rolls about y.
    axis = {"x": "y", "y": "x"}.get(after[0], after[0]) if before and kind == CYLINDER else after[0]
    second = Rotation.from_euler(axis, after[1], degrees=True) * first
    toppled = generator.toppled(upright_world(kind, first.as_matrix()), upright_world(kind, second.as_matrix()))
    assert np.array_equal(toppled, np.arange(9) == 0) == expected
    assert toppled.any() == expected


def test_a_world_is_simulated_as_its_scenario_is():
    turn = (np.cos(0.4), 0.0, 0.0, np.sin(0.4))
    scenario = Scenario(
        "one",
        (Body("box", (0.054, 0.025, 0.054), (0.55, 0.1, SHELF.board + 0.054), turn),),
        Body("cylinder", (0.02, 0.02, 0.05), (0.65, 0.25, SHELF.board + 0.05), (1.0, 0.0, 0.0, 0.0)),
    )
    simulator = NativeSimulator(1)
    world = simulator.load(jax.tree.map(lambda a: a[None], from_scenario(scenario)))
    assert np.asarray(world.valid).sum() == 2
    bodies = bodies_of(from_scenario(scenario))
    assert [body is not None for body in bodies] == [True, *[False] * 7, True]
    assert bodies[0] is not None
    np.testing.assert_allclose(bodies[0].quaternion, turn, atol=1e-6)
    with pytest.raises(InputError, match="worlds"):
        simulator.load(jax.tree.map(lambda a: jnp.concatenate([a, a]), world), np.array([True, False]))


# --- what is kept ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_pushes_are_made_once_and_read_again(tmp_path):
    generation = Generation(seed=1, pushes=3, worlds=WORLDS, rounds=1)
    counts = []
    made = list(portions(generation, tmp_path, lambda: NativeSimulator(2), DRAW_WORLD, "here", CONFIG, counts.append))

    def simulate():
        raise AssertionError("all there is lies there already")

    where = tmp_path, simulate, DRAW_WORLD, "here", CONFIG
    read = list(portions(generation, *where))
    assert counts[-1] == sum(len(part.object) for part in made) >= 3
    for a, b in zip(jax.tree.leaves(made), jax.tree.leaves(read), strict=True):
        np.testing.assert_array_equal(a, b)
    # What only other actions depend on may have changed since.
    later = dataclasses.replace(CONFIG, actions=dataclasses.replace(CONFIG.actions, clearance=0.01))
    list(portions(generation, tmp_path, simulate, DRAW_WORLD, "here", later))
    # Another portion would be needed now: scenes of one seed are none of another's.
    with pytest.raises(InputError, match="made otherwise"):
        list(portions(dataclasses.replace(generation, seed=2), *where))
    with pytest.raises(InputError, match="made otherwise"):
        list(portions(generation, tmp_path, simulate, DRAW_WORLD, "elsewhere", CONFIG))
    (tmp_path / "pushes-000.npz").write_bytes(b"PK nothing of the kind")
    with pytest.raises(InputError, match="is damaged") as refused:
        list(portions(generation, *where))
    assert "\n" not in str(refused.value)


# --- what is learnt and how it is scored -----------------------------------------------------------------------------


def test_the_planar_turn_is_the_turn_about_the_vertical():
    rng = np.random.default_rng(0)
    first = Rotation.random(20, random_state=0).as_matrix()
    yaw = rng.uniform(-3, 3, 20)
    second = Rotation.from_euler("z", yaw[:, None]).as_matrix() @ first
    turn = planar_turn(jnp.float32(first), jnp.float32(second))
    np.testing.assert_allclose(turn, yaw, atol=1e-5)


def test_average_precision_is_the_area_by_hand():
    score = np.array([0.9, 0.8, 0.7, 0.6, 0.5])
    assert average_precision(score, np.array([1, 0, 1, 0, 0], bool)) == pytest.approx((1 / 1 + 2 / 3) / 2)
    assert average_precision(np.ones(4), np.array([1, 0, 0, 1], bool)) == pytest.approx(0.5)
    assert np.isnan(average_precision(score, np.zeros(5, bool)))


def task_of(pushes: Pushes) -> PushTask:
    held = pushes.lane % 2 == 0
    return PushTask(
        pushes=jax.tree.map(lambda a: jnp.asarray(a[~held]), pushes),
        held_out=jax.tree.map(lambda a: a[held], pushes),
        network=PushConfig(width=16, layers=1),
    )


@pytest.mark.slow
def test_training_makes_the_loss_smaller(pushes, tmp_path):
    losses = []
    train(
        task_of(pushes),
        TrainConfig(steps=90, batch=16, rate=5e-3, chunk=30),
        tmp_path,
        lambda progress, step, seconds, scalars: losses.append(scalars["loss"]),
    )
    assert losses[-1] < 0.8 * losses[0]


@pytest.mark.slow
def test_the_batch_simulator_pushes_as_the_native_one_does(pushes):
    batch = generate_pushes(jax.random.key(0), WORLDS, 1, generator.engine(True), DRAW_WORLD)
    lanes, native, mjx = np.intersect1d(
        pushes.lane[: np.argmax(np.diff(pushes.lane) < 0) + 1], batch.lane, return_indices=True
    )
    assert len(lanes) > 4
    np.testing.assert_allclose(pushes.T_world_gripper[native], batch.T_world_gripper[mjx], atol=1e-5)
    gap = np.abs(pushes.after.position[native] - batch.after.position[mjx]).max(axis=-1)
    assert np.median(gap[batch.before.valid[mjx]]) < 1e-3


@pytest.mark.slow
def test_the_command_simulates_trains_scores_and_writes_weights(tmp_path, capsys):
    from mechsearch_jax.commands import main as cli
    from mechsearch_jax.dynamics.learned import LearnedPush

    arguments = (
        f"train push --out {tmp_path} --pushes 30 --worlds 16 --rounds 2 --steps 4 --batch 8 --chunk 2 --width 16"
        " --decay 0.1"
    )
    cli.parse(arguments.split())()
    card = json.loads((tmp_path / "push.json").read_text())
    assert set(card["scores"]) == {"network", "quasi-static", "no motion"}
    assert card["training"]["decay"] == 0.1
    assert card["data"]["blur"] == PushTask.blur
    assert card["data"]["found"] >= 30
    assert card["config"]["width"] == 16
    model = LearnedPush(tmp_path / "push.npz")
    world = jax.jit(DRAW_WORLD)(jax.random.key(0))
    tables = push_tables(CONFIG)
    T = transforms.upright_pose(jnp.float32([0.6, 0.0, 0.0]), 0.45)
    outcome = jax.jit(model, static_argnums=0)(
        SHELF, superquadrics(world), tables.pusher, T, jnp.float32([0.0, 0.1, 0.0]), jnp.zeros(())
    )
    assert np.isfinite(outcome.scene.position).all()
