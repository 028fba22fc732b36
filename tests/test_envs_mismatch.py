"""Worlds that are not as the planner assumes: what the simulator and the camera make of a `Mismatch`."""

import dataclasses

import jax
import mujoco
import numpy as np
import pytest
from stage import HIDDEN, OPEN, grab

from mechsearch_jax.actions import KINDS, ActionKind
from mechsearch_jax.envs.camera.recognisers import recogniser
from mechsearch_jax.envs.camera.sensing import sensing_of, true_camera
from mechsearch_jax.envs.camera.snapshot import Snapshot, informed, oracle
from mechsearch_jax.envs.episode.closed_loop import Listeners, RunSettings, Start
from mechsearch_jax.envs.episode.episodes import run_episode, run_episodes, target_of
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.simulators.native import COARSE_STEP, FINE_STEP, PHYSICS, NativeSimulator, NativeWorld
from mechsearch_jax.envs.simulators.simulator import SimulatorConfig
from mechsearch_jax.envs.world.mismatch import ASSUMED, ASSUMED_CELL, Mismatch
from mechsearch_jax.envs.world.model import body_geometries
from mechsearch_jax.envs.world.world import BODIES, TARGET, from_scenario
from mechsearch_jax.images.noise import no_noise
from mechsearch_jax.perception.recogniser import labelled
from mechsearch_jax.robot.motion import MotionConfig, Reference
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import in_order
from mechsearch_jax.workspace import scenario
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf

CAMERA, SHELF = Camera(), Shelf()
SCENE = scenario.load_scenario(scenario.example_scenarios()["first-light"])
MIDDLE = np.array([(SHELF.front + SHELF.back) / 2, (SHELF.right + SHELF.left) / 2, SHELF.board])


def cell_of(mismatch, scene=SCENE, seed=0):
    return mismatch.drawn(scene, seed, CAMERA, SHELF)


def sensed(mismatch, seed=0):
    return sensing_of(mismatch, cell_of(mismatch, seed=seed))


def snapshot(mismatch=ASSUMED):
    return Snapshot(CAMERA, SHELF, from_scenario(SCENE), sensing=sensed(mismatch))


def degrees(rotation):
    return np.degrees(np.arccos(np.clip((np.trace(np.asarray(rotation, float)) - 1) / 2, -1, 1)))


def model_of(cell, scene=SCENE):
    world = NativeWorld()
    world.reset(scene, cell)
    return world._model, world._data


def test_by_default_nothing_differs():
    cell = cell_of(ASSUMED)
    np.testing.assert_array_equal(cell.T_world_base, np.eye(4))
    np.testing.assert_array_equal(cell.T_base_moved, np.eye(4))
    assert sensing_of(ASSUMED, cell) is None
    assert true_camera(CAMERA, None) is CAMERA
    usual, neutral = (model_of(c)[0] for c in (ASSUMED_CELL, cell))
    buffers = [np.empty(mujoco.mj_sizeModel(usual), np.uint8) for _ in range(2)]
    for compiled, buffer in zip((usual, neutral), buffers, strict=True):
        mujoco.mj_saveModel(compiled, None, buffer)
    np.testing.assert_array_equal(*buffers)


def test_friction_and_mass_are_what_mujoco_sees():
    usual, _ = model_of(ASSUMED_CELL)
    other, _ = model_of(cell_of(Mismatch(friction=2.0, mass=0.5)))
    np.testing.assert_allclose(other.geom_friction[:, 0], 2.0 * usual.geom_friction[:, 0])
    np.testing.assert_array_equal(other.geom_friction[:, 1:], usual.geom_friction[:, 1:])
    used = [usual.body(f"body{i}").id for i in (0, TARGET)]
    np.testing.assert_allclose(other.body_mass[used], 0.5 * usual.body_mass[used])
    np.testing.assert_allclose(other.body_inertia[used], 0.5 * usual.body_inertia[used])
    links = [usual.body(f"link{i}").id for i in range(1, 8)]
    np.testing.assert_array_equal(other.body_mass[links], usual.body_mass[links])


def test_each_body_has_a_friction_and_a_mass_of_its_own():
    scene = HIDDEN
    one, two, mass = (
        cell_of(Mismatch(**spread), scene)
        for spread in ({"friction_spread": 1.5}, {"friction_spread": 2.0}, {"mass_spread": 2.0})
    )
    for cell in (one, two):
        np.testing.assert_array_equal(cell.body_mass, 1.0)
    # The same share of every spread.
    np.testing.assert_allclose(np.log(one.body_friction) / np.log(1.5), np.log2(two.body_friction))
    assert len(set(two.body_friction)) == BODIES
    assert 0.5 <= two.body_friction.min() < 0.9
    assert 1.1 < two.body_friction.max() <= 2.0
    usual, other, heavier = (model_of(cell, scene)[0] for cell in (ASSUMED_CELL, two, mass))
    geometries = body_geometries(usual)
    ratio = other.geom_friction[:, 0] / np.where(usual.geom_friction[:, 0] > 0, usual.geom_friction[:, 0], 1.0)
    np.testing.assert_allclose(ratio[geometries], np.broadcast_to(two.body_friction[:, None], geometries.shape))
    rest = np.setdiff1d(np.arange(usual.ngeom), geometries)
    np.testing.assert_array_equal(other.geom_friction[rest], usual.geom_friction[rest])
    slots = [usual.body(f"body{i}").id for i in range(BODIES)]
    np.testing.assert_allclose(heavier.body_mass[slots] / usual.body_mass[slots], mass.body_mass)
    np.testing.assert_allclose(heavier.body_inertia[slots], mass.body_mass[:, None] * usual.body_inertia[slots])


def test_directions_belong_to_scene_and_seed_not_to_lengths():
    near, far = (cell_of(Mismatch(shelf_shift=d, camera_shift=2 * d)) for d in (0.01, 0.02))
    np.testing.assert_allclose(2 * near.T_world_base[:3, 3], far.T_world_base[:3, 3], atol=1e-12)
    np.testing.assert_allclose(2 * near.T_base_moved[:3, 3], far.T_base_moved[:3, 3], atol=1e-12)
    assert np.linalg.norm(far.T_base_moved[:3, 3]) == pytest.approx(0.04)
    same = cell_of(Mismatch(shelf_shift=0.01), dataclasses.replace(SCENE, name="renamed"))
    np.testing.assert_array_equal(same.T_world_base, near.T_world_base)
    for other in (cell_of(Mismatch(shelf_shift=0.01), seed=1), cell_of(Mismatch(shelf_shift=0.01), HIDDEN)):
        assert np.abs(other.T_world_base - near.T_world_base).max() > 1e-4


def test_a_base_that_is_turned_moves_the_hand_against_the_shelf():
    _, usual = model_of(ASSUMED_CELL)
    mismatch = Mismatch(shelf_shift=0.02, shelf_turn=3.0)
    cell = cell_of(mismatch)
    _, other = model_of(cell)
    before, after = (data.site("gripper") for data in (usual, other))
    expected = cell.T_world_base @ np.append(before.xpos, 1.0)
    np.testing.assert_allclose(after.xpos, expected[:3], atol=1e-12)
    turn = after.xmat.reshape(3, 3) @ before.xmat.reshape(3, 3).T
    np.testing.assert_allclose(turn, cell.T_world_base[:3, :3], atol=1e-12)
    assert degrees(turn) == pytest.approx(3.0)
    # What stands on the board stays, and so does the board's middle but for the shift.
    np.testing.assert_array_equal(other.joint("body0").qpos, usual.joint("body0").qpos)
    moved = cell.T_world_base[:3, :3] @ MIDDLE + cell.T_world_base[:3, 3] - MIDDLE
    assert np.linalg.norm(moved) == pytest.approx(0.02)


@pytest.mark.parametrize("eyes", [oracle, informed])
@pytest.mark.parametrize("name", ["camera_shift", "shelf_shift"])
def test_a_shift_moves_what_the_oracle_sees_by_as_much(eyes, name):
    seen, truth = (eyes(jax.random.key(0), snapshot(m)) for m in (Mismatch(**{name: 0.03}), ASSUMED))
    shift = np.asarray(seen.objects.position - truth.objects.position)[np.asarray(truth.objects.valid)]
    np.testing.assert_allclose(np.linalg.norm(shift, axis=1), 0.03, atol=1e-6)
    np.testing.assert_allclose(seen.target_pose[:2] - truth.target_pose[:2], shift[0, :2], atol=1e-6)
    np.testing.assert_array_equal(seen.objects.valid, truth.objects.valid)
    cell = cell_of(Mismatch(**{name: 0.03}))
    way = -(cell.T_base_moved if name == "camera_shift" else cell.T_world_base)[:3, 3]
    np.testing.assert_allclose(shift, np.broadcast_to(way, shift.shape), atol=1e-6)


@pytest.mark.parametrize("eyes", [oracle, informed])
def test_objects_are_recognised_as_large_as_their_spread_says_and_stand_where_they_did(eyes):
    mismatch = Mismatch(size_spread=1.05)
    seen, truth = (eyes(jax.random.key(0), snapshot(m)) for m in (mismatch, ASSUMED))
    there = np.asarray(truth.objects.valid)
    factors = np.asarray(seen.objects.size / truth.objects.size)[there]
    np.testing.assert_allclose(factors, cell_of(mismatch).seen_size[:TARGET][there], rtol=1e-5)
    assert 1 / 1.05 <= factors.min() < 0.99
    assert 1.01 < factors.max() <= 1.05
    for name in ("rotation", "exponents", "valid"):
        np.testing.assert_array_equal(getattr(seen.objects, name), getattr(truth.objects, name))
    np.testing.assert_array_equal(seen.target_pose, truth.target_pose)
    # They stand upright here.
    moved = np.asarray(seen.objects.position - truth.objects.position)[there]
    np.testing.assert_allclose(moved[:, :2], 0.0, atol=1e-7)
    higher = np.asarray(seen.objects.size - truth.objects.size)[there, 2]
    np.testing.assert_allclose(moved[:, 2], higher, atol=1e-6)
    # The same share of every spread, and none of the others' draws.
    other = Mismatch(size_spread=1.1, friction_spread=2.0)
    shares = [np.log(cell_of(m).seen_size) / np.log(m.size_spread) for m in (mismatch, other)]
    np.testing.assert_allclose(*shares)
    np.testing.assert_array_equal(cell_of(other).body_friction, cell_of(Mismatch(friction_spread=2.0)).body_friction)


@pytest.mark.parametrize("mismatch", [Mismatch(camera_turn=2.0, camera_shift=0.02), Mismatch(shelf_turn=2.0)])
def test_an_image_shows_bodies_where_the_oracle_sees_them(mismatch):
    masks = dataclasses.replace(recogniser("masks", target_of(SCENE)), noise=no_noise)
    shot, key = snapshot(mismatch), jax.random.key(0)
    image, _ = labelled(masks.core, key, CAMERA, shot.view, SHELF, masks.images(key, shot))
    points, labels = np.asarray(image.points), np.asarray(image.labels)
    seen, there = oracle(jax.random.key(0), shot).objects, snapshot().world
    for slot in np.flatnonzero(seen.valid):
        inside = points[labels == slot]
        assert len(inside) > 100
        outside = np.array(
            [beyond(at.rotation[slot], at.position[slot], shot.world, slot, inside) for at in (seen, there)]
        )
        assert np.abs(outside[0]).max() < 1e-4
        assert np.abs(outside[1]).max() > 1e-3


def beyond(rotation, position, world, slot, points):
    """How far points lie outside of a body's faces at a pose [m]."""
    local = (points - np.asarray(position)) @ np.asarray(rotation)
    half = np.asarray(world.half_size[slot])
    if in_order()[int(world.kind[slot])].name == "cylinder":
        return np.maximum(np.linalg.norm(local[:, :2], axis=1) - half[0], np.abs(local[:, 2]) - half[2])
    return (np.abs(local) - half).max(axis=1)


def test_depth_noise_and_missing_depth_are_as_given():
    masks = recogniser("masks", target_of(SCENE))

    def depth(mismatch):
        return np.asarray(masks.images(jax.random.key(0), snapshot(mismatch)).depth)

    usual, exact, noisy = depth(ASSUMED), depth(Mismatch(depth_noise=0.0)), depth(Mismatch(depth_noise=0.005))
    lost = depth(Mismatch(missing_depth=0.2))
    there = np.isfinite(exact)
    for measured, deviation in ((usual, 0.001), (noisy, 0.005)):
        # Of a distance in a random direction, a third of the variance is along the camera's axis.
        error = measured[there] - exact[there]
        assert np.sqrt(np.mean(error**2)) == pytest.approx(deviation / np.sqrt(3), rel=0.03)
    missing = ~np.isfinite(lost)
    assert missing[there].mean() == pytest.approx(0.2, abs=0.01)
    # The other pixels measure what they do without.
    np.testing.assert_allclose(lost[there & ~missing], usual[there & ~missing], atol=1e-6)


def test_what_cannot_be_simulated_is_refused():
    with pytest.raises(InputError, match="friction"):
        Mismatch(friction=0.0)
    with pytest.raises(InputError, match="camera_turn"):
        Mismatch(camera_turn=90.0)
    with pytest.raises(InputError, match='"jelly" is unknown; use usual'):
        Mismatch(physics="jelly")
    for mismatch in (Mismatch(depth_noise=0.002), Mismatch(missing_depth=0.1)):
        for recognition in ("oracle", "informed"):
            with pytest.raises(InputError, match="--recognition masks or full"):
                Method(recognition=recognition, mismatch=mismatch).check()
        Method(recognition="masks", mismatch=mismatch).check()
    for recognition in ("masks", "full"):
        with pytest.raises(InputError, match=r"size_spread: .* take --recognition oracle or informed"):
            Method(recognition=recognition, mismatch=Mismatch(size_spread=1.05)).check()
    Method(mismatch=Mismatch(size_spread=1.05)).check()
    with pytest.raises(InputError, match="size_spread"):
        Mismatch(size_spread=0.9)
    with pytest.raises(InputError, match="add --simulator native"):
        Method(engine="MjxSimulator", mismatch=Mismatch(physics="fine-step")).check()
    Method(mismatch=Mismatch(physics="fine-step")).check()
    with pytest.raises(InputError, match=r"arm_stop: .* add --simulator native"):
        Method(engine="MjxSimulator", mismatch=Mismatch(arm_stop=0.04)).check()
    Method(mismatch=Mismatch(arm_stop=0.04)).check()
    numbers = Mismatch(friction=2.0, mass=2.0, shelf_shift=0.01, shelf_turn=1.0, camera_shift=0.01)
    Method(engine="MjxSimulator", mismatch=numbers).check()
    for colours in (
        Mismatch(colour_noise=0.0),
        Mismatch(exposure=0.5),
        Mismatch(white_balance=0.1),
        Mismatch(hue_gap=0),
    ):
        for recognition in ("oracle", "informed", "masks"):
            with pytest.raises(InputError, match="add --recognition full"):
                Method(recognition=recognition, mismatch=colours).check()
        Method(recognition="full", mismatch=colours).check()
    with pytest.raises(InputError, match="exposure"):
        Mismatch(exposure=0.0)


@pytest.mark.parametrize("eyes", [oracle, informed])
def test_recognisers_without_an_image_refuse_other_depth(eyes):
    for mismatch in (Mismatch(depth_noise=0.002), Mismatch(missing_depth=0.1, camera_shift=0.01), Mismatch(exposure=2)):
        with pytest.raises(InputError, match="need an image"):
            eyes(jax.random.key(0), snapshot(mismatch))


def test_what_is_data_compiles_nothing():
    def compile_key(**mismatch):
        return Method(recognition="masks", mismatch=Mismatch(**mismatch)).compile_key()

    assert compile_key(friction=0.5) == compile_key(friction=2.0, mass=2.0, physics="fine-step") == compile_key()
    assert compile_key(camera_shift=0.01) == compile_key(camera_turn=2.0, friction=2.0) == compile_key(shelf_shift=0.01)
    assert compile_key(depth_noise=0.002) == compile_key(missing_depth=0.1)
    assert compile_key(exposure=0.5) == compile_key(colour_noise=0.0, hue_gap=0.0, white_balance=0.1)
    assert (
        len({compile_key(), compile_key(camera_shift=0.01), compile_key(depth_noise=0.002), compile_key(exposure=0.5)})
        == 4
    )


def test_every_world_of_a_simulator_has_its_own_cell():
    simulator = NativeSimulator()
    simulator.set_cells({0: cell_of(Mismatch(friction=2.0))})
    world = simulator.reset([SCENE, SCENE])
    frictions = [w._model.geom_friction[:, 0] for w in simulator._worlds]
    np.testing.assert_allclose(frictions[0], 2.0 * frictions[1])
    # An action that is undone is undone in the same cell.
    simulator.load(world, np.array([True, True]))
    np.testing.assert_allclose(simulator._worlds[0]._model.geom_friction[:, 0], frictions[0])
    # The next episode has its own cell, the usual one if none is set.
    simulator.replace({0: SCENE})
    np.testing.assert_array_equal(simulator._worlds[0]._model.geom_friction[:, 0], frictions[1])


def waving():
    """A motion of 0.4 s in steps of 4 ms, in which every joint's angle is the sine of the time."""
    t = 0.004 * np.arange(1, 101)
    q = np.sin(t)[:, None] * np.ones(7)
    return Reference(
        q=np.concatenate([q, q[-1:]]),
        velocity=np.concatenate([np.cos(t)[:, None] * np.ones(7), np.zeros((1, 7))]),
        fingers=np.linspace(0.04, 0.0, 101),
        start=np.append(np.zeros(7), 0.04),
        length=np.int32(100),
        closed=np.int32(50),
        opens=np.int32(100),
    )


def test_with_the_usual_physics_no_reference_is_resampled(monkeypatch):
    # The model is compiled with fewer digits than this time step has.
    world = NativeWorld(config=SimulatorConfig(motion=MotionConfig(timestep=0.01 / 3)))
    world.reset(SCENE)
    followed, reference = [], waving()

    def follow(given):
        followed.append(given)
        raise StopIteration

    monkeypatch.setattr(world, "_follow", follow)
    with pytest.raises(StopIteration):
        world._perform(KINDS[ActionKind.PUSH], reference, 0)
    assert followed[0] is reference


def test_physics_change_the_model():
    usual, _ = model_of(ASSUMED_CELL)
    changed = {name: model_of(cell_of(Mismatch(physics=name)))[0] for name in PHYSICS}
    assert changed["fine-step"].opt.timestep == FINE_STEP
    assert changed["coarse-step"].opt.timestep == COARSE_STEP
    assert changed["pyramidal-cone"].opt.cone != usual.opt.cone
    assert changed["soft-friction"].opt.impratio == 1.0
    assert (changed["soft-contacts"].geom_solref[:, 0] > usual.geom_solref[:, 0]).all()
    assert usual.opt.timestep == changed["usual"].opt.timestep == 0.004


@pytest.mark.slow
def test_episodes_with_a_mismatch_are_the_same_alone_and_in_a_batch(problem):
    others = [Mismatch(friction=2.0), ASSUMED, Mismatch(physics="fine-step"), Mismatch(shelf_shift=0.004)]
    mismatches = [dataclasses.replace(mismatch, camera_shift=0.001) for mismatch in others]
    starts = [Start(OPEN, 0, mismatch=mismatch) for mismatch in mismatches]
    settings, episodes = RunSettings(max_steps=2, at_once=2), []
    simulator = NativeSimulator(threads=1)
    run_episodes(starts, problem, grab, simulator, 2, Listeners(episodes.extend), settings)
    for place, episode in episodes:
        again = run_episode(starts[place], problem, grab, NativeSimulator(), settings)
        assert episode.retrieved == again.retrieved
        assert [step.tracking_error for step in episode.steps] == [step.tracking_error for step in again.steps]
    errors = {place: episode.steps[-1].tracking_error for place, episode in episodes}
    assert len({errors[i] for i in (1, 2, 3)}) == 3
