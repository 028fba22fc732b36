"""The searcher: what it hands out, what it remembers, and what it tells of what does not fit."""

import dataclasses
import functools
import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import HIDDEN, OPEN, grab, idle

from mechsearch_jax.actions import Action, ActionKind
from mechsearch_jax.belief.impasse import impasse
from mechsearch_jax.calibration.limits import CalibrationLimits
from mechsearch_jax.config.presets import standard
from mechsearch_jax.dynamics.named import own_push_model
from mechsearch_jax.dynamics.quasi_static import QuasiStatic
from mechsearch_jax.envs.camera.simulated_camera import observe
from mechsearch_jax.envs.camera.snapshot import Snapshot, oracle
from mechsearch_jax.envs.cell.loading import load_searcher
from mechsearch_jax.envs.episode.compile_clock import CompileClock
from mechsearch_jax.envs.episode.method import Method
from mechsearch_jax.envs.pushing.physics_push import NativePhysics
from mechsearch_jax.envs.trials.native import NativeTrials
from mechsearch_jax.envs.world.world import from_scenario
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.geometry.transforms import compose
from mechsearch_jax.images.checks import Look
from mechsearch_jax.images.examples import example_images
from mechsearch_jax.images.measured import share_step
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception.doubt import DoubtConfig
from mechsearch_jax.perception.plausibility import image_faults
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.planner import Decision, initial_belief, search_for_grasp, update_belief
from mechsearch_jax.planner.rollout import no_sequences
from mechsearch_jax.planner.step import DRAWS, SearchState
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.arm_config import ArmConfig
from mechsearch_jax.robot.hand import HandConfig
from mechsearch_jax.robot.kinematics import FINGER_TIPS
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.session import faults
from mechsearch_jax.session import searcher as searcher_module
from mechsearch_jax.session.faults import check_image, recognition_warnings
from mechsearch_jax.session.images import converted
from mechsearch_jax.session.searcher import Searcher
from mechsearch_jax.session.step import Motion
from mechsearch_jax.session.whole_trajectory import TrajectoryConfig
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.sight import camera_faults
from mechsearch_jax.workspace.target import Target

IMAGES = example_images()
CAMERA, SHELF = IMAGES.camera, Shelf()
# The images are of another scene than what is recognised here.
TRUSTING = TrajectoryConfig(doubt=DoubtConfig(missing=1.0, unexplained=1.0, passed=1.0))


@functools.cache
def seen(scenario):
    return oracle(jax.random.key(0), Snapshot(Camera(), SHELF, from_scenario(scenario)))


def searcher_of(problem, scenario, policy=grab, **arguments):
    """A searcher that sees what stands in a scenario, whatever the images show."""
    observation = seen(scenario) if isinstance(scenario, type(HIDDEN)) else scenario
    given = {"trajectories": TRUSTING, **arguments}
    searcher = Searcher(policy=policy, **{"recogniser": lambda problem: lambda *images: observation, **given})
    searcher.problem = problem
    return searcher


def now(searcher):
    """What a searcher knows."""
    return SearchState(searcher.belief, searcher._now.observation, searcher._now.action)


def moved(camera, by):
    return dataclasses.replace(camera, position=tuple(np.add(camera.position, by).tolist()))


@pytest.mark.slow
def test_a_target_in_the_open_is_taken_out_and_the_search_is_over(problem, tmp_path):
    searcher = searcher_of(problem, OPEN)
    step = searcher.next(IMAGES.depth, IMAGES.colour)
    assert (step.kind, step.index, step.warnings) == ("retrieve", 0, ())
    assert "found" in step.reason
    assert step.trajectory.position.shape == (len(step.trajectory.time), 7)
    picture = tmp_path / "step.png"
    step.picture.savefig(picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    searcher.acted()
    assert searcher.finished
    with pytest.raises(InputError, match="finished"):
        searcher.next(IMAGES.depth)


def test_no_motion_is_handed_out_where_recognition_is_doubtful(problem):
    searcher = searcher_of(problem, OPEN, trajectories=None)
    step = searcher.next(IMAGES.depth)
    assert (step.kind, step.trajectory) == ("none", None)
    assert "is on no recognised object" in step.reason


def test_a_retrieval_that_failed_goes_on(problem):
    searcher = searcher_of(problem, OPEN)
    searcher.next(IMAGES.depth)
    searcher.acted(ok=False)
    assert not searcher.finished


def test_nothing_is_over_before_it_was_handed_out(problem):
    searcher = searcher_of(problem, OPEN)
    with pytest.raises(InputError, match="call next first"):
        searcher.acted()
    searcher.next(IMAGES.depth)
    searcher.acted(ok=False)
    with pytest.raises(InputError, match="call next first"):
        searcher.acted(ok=False)


def test_a_motion_out_of_reach_is_none_and_says_so(problem):
    searcher = searcher_of(problem, HIDDEN)
    step = searcher.next(IMAGES.depth)
    assert (step.kind, step.trajectory) == ("none", None)
    assert "does not reach" in step.reason
    with pytest.raises(InputError, match="call next first"):
        searcher.acted()


def test_without_an_action_it_says_why(problem):
    nothing = seen(HIDDEN).replace(objects=empty(8))
    step = searcher_of(problem, nothing, policy=idle).next(IMAGES.depth)
    assert step.kind == "none"
    assert "something stands on the shelf, but no object and no target is recognised" in step.reason
    assert any("open again" in warning for warning in step.warnings)


def test_that_all_slots_are_taken_is_said_only_where_something_is_on_none_of_them(problem, monkeypatch):
    hidden = seen(HIDDEN)
    full = hidden.replace(objects=hidden.objects.replace(valid=jnp.ones(8, bool), size=jnp.full((8, 3), 0.01)))
    look = Look(CAMERA, SHELF, IMAGES.depth)
    for lost in ((), ("recognition: what shows 300 pixels does not lie on anything that is recognised",)):
        monkeypatch.setattr(faults, "lost_faults", lambda *_, lost=lost: lost)
        said = recognition_warnings(problem, look, full, object.__new__(Recogniser))
        assert any("all 8 slots are taken" in line for line in said) == bool(lost)


def test_what_does_not_tell_the_target_is_a_warning():
    searcher = Searcher()
    searcher.problem = types.SimpleNamespace(camera=CAMERA, shelf=SHELF, target=Target())
    unseen = Observation(empty(8), jnp.array(False), jnp.zeros(3))

    def warnings(colour, mask=None, target_id=None):
        images = converted(IMAGES.depth, colour, mask, target_id)
        look, found = check_image(searcher.problem, searcher.workcell.calibration, images, searcher.recogniser)
        return [*found, *recognition_warnings(searcher.problem, look, unseen)]

    assert warnings(IMAGES.colour) == []
    red = np.where((IMAGES.mask == 0)[..., None], np.uint8([[[200, 10, 10]]]), IMAGES.colour)
    (fault,) = warnings(red)
    assert "pixels have the target's colour, but nothing that shows them has its shape and size" in fault
    assert warnings(red, IMAGES.mask) == []
    (fault,) = warnings(None)
    assert fault.startswith("images: the target cannot be told from the objects")
    (fault,) = warnings(None, IMAGES.mask, 8)
    assert fault.startswith("mask: no pixel holds the target's number 8")


def test_an_empty_shelf_is_said_to_be_empty(problem):
    """And not that something moved, or a shape is wrong."""
    nothing = seen(HIDDEN).replace(objects=empty(8))
    bare = observe(Camera(), from_scenario(HIDDEN).replace(valid=jnp.zeros(9, bool)))
    searcher = searcher_of(problem, nothing, policy=idle)
    step = searcher.next(np.asarray(bare.depth))
    assert int(step.belief.restarts) == 1
    assert (step.kind, step.trajectory) == ("none", None)
    assert step.reason == "the shelf is empty: no object and no target is seen"
    assert step.warnings == (step.reason,)


def test_an_image_without_any_depth_is_refused_and_nothing_is_forgotten(problem):
    searcher = searcher_of(problem, HIDDEN, policy=idle)
    before = searcher.next(IMAGES.depth).belief
    with pytest.raises(InputError, match="depth image: nothing was measured"):
        searcher.next(np.zeros_like(IMAGES.depth))
    assert searcher.belief is before


def uncalled(problem):
    """A recogniser that must not be called."""

    def recognise(*images):
        pytest.fail("the images were recognised")

    return recognise


LAX = CalibrationLimits(refuse_shift=0.03)


def test_a_shelf_out_of_its_place_is_a_warning_of_a_step_and_is_refused_before_recognition(problem):
    def at(shift, **arguments):
        return searcher_of(problem.replace(camera=moved(problem.camera, (shift, 0.0, 0.0))), HIDDEN, idle, **arguments)

    step = at(0.005).next(IMAGES.depth)
    assert any("the shelf is up to 5 mm" in warning for warning in step.warnings)
    step = at(0.02, workcell=Workcell(calibration=LAX)).next(IMAGES.depth)
    assert any("the shelf is up to 20 mm" in warning for warning in step.warnings)
    refusing = at(0.02, recogniser=uncalled)
    with pytest.raises(InputError, match=r"the shelf is up to 20 mm .* too far to go on"):
        refusing.next(IMAGES.depth)


def test_where_all_that_was_tried_out_does_harm_it_says_so_and_the_next_call_draws_others(problem):
    drawn = []

    def harmed(key, problem, belief, observation):
        drawn.append(jax.random.key_data(key).tolist())
        return idle(key, problem, belief, observation).replace(refused=jnp.int32(8))

    searcher = searcher_of(problem, HIDDEN, policy=harmed)
    for _ in range(2):
        step = searcher.next(IMAGES.depth)
        assert (step.kind, step.trajectory, step.index) == ("none", None, 0)
        assert "each of the 8 best actions does harm" in step.reason
    assert drawn[0] != drawn[1]


def test_where_the_arm_cannot_do_what_was_decided_on_others_are_drawn(problem):
    drawn = []

    def fickle(blocked):
        def policy(key, problem, belief, observation):
            drawn.append(jax.random.key_data(key).tolist())
            far = grab(key, problem, belief, observation)
            push = far.action.replace(kind=jnp.int32(ActionKind.PUSH), object=jnp.int32(0))
            return far.replace(action=push) if len(drawn) <= blocked else idle(key, problem, belief, observation)

        return policy

    searcher_of(problem, HIDDEN, policy=fickle(2)).next(IMAGES.depth)
    assert len(drawn) == 3
    drawn.clear()
    searcher = searcher_of(problem, HIDDEN, policy=fickle(100))
    step = searcher.next(IMAGES.depth)
    assert (step.kind, step.trajectory) == ("none", None)
    assert "does not reach" in step.reason
    searcher.next(IMAGES.depth)
    assert len(drawn) == 2 * DRAWS == len({str(key) for key in drawn})


def test_after_each_look_at_which_nothing_could_be_done_less_distance_has_to_do(problem, monkeypatch):
    kept = []

    def refused(*arguments):
        kept.append(next(a.beside for a in arguments if isinstance(a, TrajectoryConfig)))
        return Motion("none", "refused", None, blocked=True)

    monkeypatch.setattr(searcher_module, "motion_of", refused)
    searcher = searcher_of(problem, HIDDEN, policy=grab)
    for _ in range(5):
        searcher.next(IMAGES.depth)
    np.testing.assert_allclose(sorted(set(kept), reverse=True), [0.01, 0.005, 0.0, -0.003], atol=1e-9)
    assert kept == sorted(kept, reverse=True)


def test_what_a_policy_does_not_propose_cannot_be_tried(problem):
    with pytest.raises(InputError, match="the policy proposes nothing to be tried; make it with tries=True"):
        Searcher(policy=search_for_grasp(), trials=NativeTrials())
    assert Searcher(policy=search_for_grasp(tries=True), trials=NativeTrials())._policy.tries
    with pytest.raises(InputError, match="push_model would have no effect"):
        Searcher(policy=idle, push_model=QuasiStatic())


def test_an_option_that_would_have_no_effect_is_refused():
    with pytest.raises(InputError, match='config names the push model "quasi-static", and another is given'):
        Searcher(config=standard(trials="none", push_model="quasi-static"), push_model=own_push_model("learned"))


def test_what_a_configuration_names_is_what_decides_by_default():
    method = Method()
    searcher = Searcher()
    # A robot touches nothing beside what is to be moved.
    quiet = dataclasses.replace(method, config=method.config.with_options(retrieval_contact=False))
    assert searcher.config == quiet.config
    assert (searcher._policy, searcher._trials) == (quiet.policy(), quiet.trials())
    physics = Searcher(config=standard(trials="none", push_model="physics"))
    assert physics._trials is None
    assert isinstance(physics._policy.predict.push_model, NativePhysics)
    # A policy tries what it proposes; a user's may do without.
    assert Searcher(policy=search_for_grasp(tries=True))._trials == method.trials()
    assert Searcher(policy=search_for_grasp())._trials is Searcher(policy=idle)._trials is None


def test_where_nothing_is_tried_out_it_says_so(problem):
    plain, bold = Searcher(config=standard(trials="none")), Searcher()
    for searcher in (plain, bold):
        searcher.problem, searcher.recogniser = problem, lambda *images: seen(OPEN)
    assert "no action is tried out before it is made" in plain.check().notices[0]
    assert bold.check().notices == ()
    del bold.recogniser
    (notice,) = bold.check().notices
    assert "told by its colour, red 0.7282, green 0.1558 and blue 0.2099 (the default" in notice
    # A user's policy may try actions by itself.
    assert searcher_of(problem, OPEN).check().notices == ()
    done = Motion("retrieve", "it is found", object())
    assert plain._within_limit(done, now(plain)).reason == "it is found; not tried out before"
    assert bold._within_limit(done, now(bold)).reason == "it is found"


def test_after_all_actions_only_the_target_is_taken_out(problem):
    searcher = searcher_of(problem, OPEN, config=standard(max_steps=1))
    push, take = Motion("push", "to push object 1", object()), Motion("retrieve", "to take it", object())
    assert searcher._within_limit(push, now(searcher)) == push
    searcher._state = dataclasses.replace(searcher._now, index=1)
    kept = searcher._within_limit(push, now(searcher))
    assert (kept.kind, kept.trajectory) == ("none", None)
    assert kept.reason.startswith("to push object 1; not done: all 1 actions of max_steps are used up")
    assert searcher._within_limit(take, now(searcher)) == take


def test_a_step_is_written_as_json(problem):
    step = searcher_of(problem, OPEN).next(IMAGES.depth, IMAGES.colour)
    values = json.loads(json.dumps(step.to_json(), allow_nan=False))
    assert (values["kind"], values["found"], values["warnings"]) == ("retrieve", True, [])
    assert values["motion"]["duration"] > 0
    (box,) = values["objects"]
    assert box["position"] == pytest.approx(OPEN.objects[0].position, abs=1e-5)
    assert box["size"] == pytest.approx(OPEN.objects[0].half_size, abs=1e-5)
    assert (np.shape(box["rotation"]), box["slot"], len(box["exponents"])) == ((3, 3), 0, 2)
    assert box["quaternion"] == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-5)
    assert 0.0 < box["confidence"] <= 1.0
    target = values["target"]
    assert target["visible"]
    assert target["found_pose"][:2] == pytest.approx(OPEN.target.position[:2], abs=1e-5)
    assert np.array(target["T_world_target"])[:3, 3] == pytest.approx(OPEN.target.position, abs=1e-3)
    action, hand = values["action"], values["hand"]
    assert (action["kind"], action["object"], action["displacement"]) == ("retrieve", None, [0.0, 0.0, 0.0])
    T = np.array(action["T_world_gripper"])
    assert np.linalg.norm(T[:3, 3] - OPEN.target.position) < 0.05
    assert np.array(hand["T_world_hand"])[:3, 3] == pytest.approx(T[:3, 3] - FINGER_TIPS * T[:3, 2])
    opens, closes = values["gripper"]
    assert (opens["kind"], opens["start"], opens["waits"]) == ("move", 0.0, False)
    assert opens["width"] == pytest.approx(action["opening"], abs=1e-6)
    assert (closes["kind"], closes["waits"], closes["force"]) == ("grasp", True, 60.0)
    assert closes["width"] == pytest.approx(2 * OPEN.target.half_size[0], abs=1e-6)
    assert set(closes) == {"kind", "start", "duration", "waits", "width", "speed", "force", "inner", "outer"}
    assert opens["start"] + opens["duration"] <= closes["start"] <= values["motion"]["duration"]
    assert values["reason"] == step.reason


def test_the_hand_and_the_place_are_the_workcells(problem):
    hand, place = HandConfig(speed=0.05, force=20.0), (0.35, -0.45, 0.1)
    cell = Workcell(hand=hand, arm=ArmConfig(place=place))
    searcher = searcher_of(problem, OPEN, workcell=cell)
    step = searcher.next(IMAGES.depth, IMAGES.colour, width=0.02)
    opens, closes, *_ = step.trajectory.events
    assert (opens.speed, closes.force) == (0.05, 20.0)
    assert opens.duration == pytest.approx(hand.time(0.06), abs=1e-3)
    assert step.trajectory.width[0] == 0.02
    assert step.trajectory.put_down is not None
    assert step.warnings == ()
    with pytest.raises(InputError, match=r"width: 20\.0 m must be between 0"):
        searcher.next(IMAGES.depth, width=20.0)
    with pytest.raises(InputError, match=r'width: "x" must be a number'):
        searcher.next(IMAGES.depth, width="x")
    far = Workcell(arm=ArmConfig(place=(1.9, 0.0, 0.0)))
    (warning,) = searcher_of(problem, OPEN, workcell=far).next(IMAGES.depth, IMAGES.colour).warnings
    assert warning.startswith("the target is to stay in the hand: place: the arm does not reach [1.9, 0.0, 0.0]")


def test_a_step_without_a_motion_has_neither_action_nor_hand(problem):
    values = searcher_of(problem, HIDDEN).next(IMAGES.depth).to_json()
    assert (values["kind"], values["motion"], values["action"], values["hand"]) == ("none", None, None, None)
    assert values["gripper"] is None
    assert (values["target"]["visible"], values["target"]["pose"], values["target"]["found_pose"]) == (
        False,
        None,
        None,
    )
    assert values["target"]["belief_size"] == values["poses"] > 0


@pytest.mark.parametrize("colour", [IMAGES.colour, (IMAGES.colour / 255.0).astype(np.float32), IMAGES.colour / 255.0])
def test_images_of_any_type_are_made_alike(colour):
    depth, red, mask, target_id = converted(
        IMAGES.depth.astype(float), colour, IMAGES.mask.astype(np.int64), np.int64(3)
    )
    assert (depth.dtype, red.dtype, mask.dtype, type(target_id)) == (np.float32, np.uint8, np.int32, int)
    np.testing.assert_array_equal(red, IMAGES.colour)
    np.testing.assert_array_equal(mask, IMAGES.mask)


def one_push(problem):
    """A plan of one push that the arm can make, which compiles in no time."""
    grasps = problem.grasps
    T = compose(grasps.T_world_target[grasps.pair_pose[0]], grasps.T_target_gripper[grasps.pair_grasp[0]])
    way = jnp.array([0.0, 0.05, 0.0])
    push = Action(
        kind=jnp.int32(ActionKind.PUSH),
        object=jnp.int32(0),
        T_world_gripper=T,
        displacement=way,
        T_world_place=T.at[:3, 3].add(way),
        q7=grasps.q7[grasps.pair_grasp[0]],
        opening=jnp.float32(0.0),
    )
    push = jax.tree.map(np.asarray, push)

    def plan(rollout, key, objects):
        none = no_sequences(rollout.config, objects)
        many = jax.tree.map(lambda a, b: jnp.broadcast_to(a, b.shape).astype(b.dtype), push, none.actions)
        value = jnp.zeros_like(none.value) + jax.random.uniform(key)
        return Decision(
            action=jax.tree.map(jnp.asarray, push),
            value=value[0],
            cost=jnp.float32(9.0),
            predicted_cost=jnp.float32(8.0),
            predicted=objects,
            sequences=none.replace(actions=many, value=value),
            refused=jnp.int32(0),
        )

    return plan


@pytest.mark.slow
@pytest.mark.parametrize("trials", ["none", "physics"])
def test_after_warming_up_nothing_is_compiled(problem, trials, monkeypatch):
    monkeypatch.setenv("MECHSEARCH_CACHE_DIR", "")
    searcher = load_searcher(keep=False, trials=trials, sequences=4, horizon=1, trajectories=TRUSTING)
    searcher.problem, searcher._policy = problem, searcher._policy.replace(plan=one_push(problem))
    stages = []
    searcher.warm_up(lambda what, left: stages.append((what, left)))
    assert [left for _, left in stages] == [5, 4, 3, 2, 1, 0]
    assert (searcher._now.index, searcher.moving) == (0, False)
    sees, moves = searcher.recogniser, 0
    # Whatever it comes from, what is seen is of one type.
    step = share_step(problem.camera)
    measured = np.ones((problem.camera.height // step, problem.camera.width // step), np.float32)
    shown = [seen(scenario).replace(measured=measured) for scenario in (HIDDEN, OPEN)]
    # In sight, but behind something wide that no hand reaches over.
    wall = {"position": [0.5, 0.07, 0.49], "size": [0.01, 0.25, 0.085]}
    objects = shown[1].objects
    barred = objects.replace(**{k: getattr(objects, k).at[0].set(jnp.array(v)) for k, v in wall.items()})
    shown.append(shown[1].replace(objects=barred))
    shown = [jax.device_put(jax.tree.map(np.asarray, there)) for there in shown]
    looks = [lambda *images, there=there: there for there in shown]
    with CompileClock() as clock:
        for looking in (sees, *looks, sees):
            searcher.recogniser = looking
            step = searcher.next(IMAGES.depth.astype(float), IMAGES.colour)
            step.to_json()
            _ = step.picture
            moves += searcher.moving
            if searcher.moving:
                searcher.acted(ok=False)
            assert clock.seconds == 0.0
    assert moves >= 2


@pytest.mark.slow
def test_impasses_have_reasons_of_their_own(problem):
    belief = initial_belief(problem)
    objects = seen(HIDDEN).objects
    far = objects.replace(position=objects.position.at[:, 0].add(1.0))
    assert "does not reach" in impasse(problem, belief, far)
    assert "sampled action is predicted to fail" in impasse(problem, belief, objects)


def test_a_saved_search_goes_on_where_it_was(problem, tmp_path):
    searcher, path = searcher_of(problem, OPEN), tmp_path / "search.npz"
    first = searcher.next(IMAGES.depth)
    searcher.acted(ok=False)
    searcher.save(path)
    again = searcher_of(problem, OPEN)
    again.load(path)
    jax.tree.map(np.testing.assert_array_equal, again.belief, first.belief)
    second = again.next(IMAGES.depth)
    assert second.index == 1
    jax.tree.map(np.testing.assert_array_equal, second.decision.action, searcher.next(IMAGES.depth).decision.action)
    # The motion that was handed out counts, too.
    again.save(path)
    third = searcher_of(problem, OPEN)
    third.load(path)
    third.acted()
    assert third.finished


def test_a_saved_search_goes_on_with_another_hand_and_place(problem, tmp_path):
    path = tmp_path / "search.npz"
    searcher_of(problem, OPEN).save(path)
    other = Workcell(hand=HandConfig(force=20.0), arm=ArmConfig(place=(0.35, -0.45, 0.1)))
    searcher_of(problem, OPEN, workcell=other).load(path)
    # As before there was a hand, so that older files can be read.
    assert "hand" not in repr(other)
    assert repr(other) == repr(Workcell())


def test_a_file_of_another_search_is_refused(problem, tmp_path):
    path = tmp_path / "search.npz"
    searcher_of(problem, OPEN).save(path)
    with pytest.raises(InputError, match="another workcell, configuration or seed"):
        searcher_of(problem, OPEN, seed=1).load(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"search\.npz: "):
        searcher_of(problem, OPEN).load(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(InputError, match="no search that was saved"):
        searcher_of(problem, OPEN).load(path)


@pytest.mark.slow
def test_what_an_action_may_have_moved_is_reckoned_with(problem):
    def handed(key, problem, belief, observation):
        return grab(key, problem, belief, seen(OPEN)).replace(action=retrieval)

    retrieval = searcher_of(problem, OPEN).next(IMAGES.depth).decision.action
    searcher = searcher_of(problem, HIDDEN, policy=handed)
    step = searcher.next(IMAGES.depth)
    assert step.trajectory is not None
    looked_again = searcher.next(IMAGES.depth)
    searcher.acted(ok=False)
    after = searcher.next(IMAGES.depth)
    observation = seen(HIDDEN)
    expected = update_belief(problem, looked_again.belief, observation, observation, retrieval)
    jax.tree.map(np.testing.assert_array_equal, after.belief, expected)


def test_what_is_in_reach_is_known_before_the_first_image(problem):
    check = searcher_of(problem, OPEN).check()
    assert 0.5 < check.reach <= 1.0
    assert check.warnings == ()
    nowhere = searcher_of(problem.replace(grasps=problem.grasps.replace(pair_pose=jnp.zeros(0, jnp.int32))), OPEN)
    assert nowhere.check().reach == 0.0
    assert "reaches the target nowhere" in nowhere.check().warnings[0]


def test_the_example_images_fit_their_camera():
    assert camera_faults(CAMERA, SHELF) == ()
    assert image_faults(Look(CAMERA, SHELF, IMAGES.depth, mask=IMAGES.mask)) == ()


def described(e1, e2, half=(0.03, 0.03, 0.06)):
    """What a recogniser returns of one object."""
    objects = empty(2)
    return Observation(
        objects.replace(
            size=objects.size.at[0].set(jnp.float32(half)),
            exponents=objects.exponents.at[0].set(jnp.float32([e1, e2])),
            valid=jnp.array([True, False]),
        ),
        jnp.array(False),
        jnp.zeros(3),
    )


def test_what_a_recogniser_describes_is_taken_for_what_it_is():
    seen = faults.checked(described(0.2, 1.9))
    assert seen.objects.exponents[0, 1] < 0.5
    assert faults.shape_warnings(seen) == faults.shape_warnings(described(0.2, 1.2)) == []
    for strange in (described(1.9, 1.0), described(0.2, 1.9, (0.05, 0.03, 0.06))):
        (warning,) = faults.shape_warnings(faults.checked(strange))
        assert "object 0: exponents" in warning
    for wrong in (
        described(0.2, 2.1),
        described(0.0, 1.0),
        described(0.2, jnp.nan),
        described(0.2, 0.2, (0.03, 0.0, 0.1)),
    ):
        with pytest.raises(InputError, match=r"recogniser: object 0 has half-extents .* exponents"):
            faults.checked(wrong)
