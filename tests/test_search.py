"""The searcher: what it hands out, what it remembers, and what it tells of what does not fit."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stage import HIDDEN, OPEN, grab, idle

from mechsearch_jax.envs.simulated_camera import observe
from mechsearch_jax.envs.snapshot import Snapshot, oracle
from mechsearch_jax.envs.world import from_scenario
from mechsearch_jax.errors import InputError
from mechsearch_jax.geometry.superquadric import empty
from mechsearch_jax.perception.doubt import DoubtConfig
from mechsearch_jax.perception.examples import example_images
from mechsearch_jax.perception.plausibility import camera_faults, image_faults
from mechsearch_jax.planner import initial_belief, update_belief
from mechsearch_jax.planner.impasse import impasse
from mechsearch_jax.search.searcher import Searcher
from mechsearch_jax.search.whole_trajectory import TrajectoryConfig
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

IMAGES = example_images()
CAMERA, SHELF = IMAGES.camera, Shelf()
FLIP = np.diag([1.0, -1.0, -1.0])
# The images are of another scene than what is recognised here.
TRUSTING = TrajectoryConfig(doubt=DoubtConfig(missing=1.0, unexplained=1.0, passed=1.0))


@functools.cache
def seen(scenario):
    return oracle(jax.random.key(0), Snapshot(Camera(), SHELF, from_scenario(scenario)))


def searcher_of(problem, scenario, policy=grab, **arguments):
    """A searcher that sees what stands in a scenario, whatever the images show."""
    observation = seen(scenario) if isinstance(scenario, type(HIDDEN)) else scenario
    given = {"trajectories": TRUSTING, **arguments}
    found = Searcher(policy=policy, recogniser=lambda problem: lambda *images: observation, **given)
    found.problem = problem
    return found


def turned(camera, by):
    return dataclasses.replace(camera, rotation=tuple(map(tuple, (np.array(camera.rotation) @ by).tolist())))


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
        searcher.acted()


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
    assert any("started anew" in warning for warning in step.warnings)


def test_what_does_not_tell_the_target_is_a_warning():
    searcher = Searcher()
    searcher.problem = types.SimpleNamespace(camera=CAMERA, shelf=SHELF, target=Target())
    assert searcher._faults(IMAGES.depth, IMAGES.colour, None, None) == []
    (fault,) = searcher._faults(IMAGES.depth, None, None, None)
    assert fault.startswith("images: the target cannot be told from the objects")
    (fault,) = searcher._faults(IMAGES.depth, None, IMAGES.mask, 8)
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


def test_where_all_that_was_tried_out_does_harm_it_says_so_and_draws_others_when_asked_again(problem):
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


def test_a_policy_is_given_its_rehearsal_itself(problem):
    with pytest.raises(InputError, match="give it the rehearsal"):
        Searcher(policy=idle, rehearsal=lambda *args: None)


@pytest.mark.slow
def test_an_impasse_is_told_from_another(problem):
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
    assert image_faults(CAMERA, SHELF, IMAGES.depth, IMAGES.mask) == ()


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (turned(CAMERA, FLIP), "looks away from the shelf"),
        (turned(CAMERA, np.diag([-1.0, -1.0, 1.0])), "upside down"),
        (dataclasses.replace(CAMERA, fx=6000.0, fy=6000.0), "% of the board only"),
    ],
)
def test_a_wrong_camera_is_told(camera, words):
    (fault,) = camera_faults(camera, SHELF)
    assert words in fault


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (moved(CAMERA, (0.0, 0.0, 0.02)), "2.0 cm too high"),
        (moved(CAMERA, (0.0, 0.0, -0.03)), "3.0 cm too low"),
        (moved(CAMERA, (0.0, 0.0, 0.12)), "shows no board"),
    ],
)
def test_a_board_elsewhere_is_told(camera, words):
    (fault,) = image_faults(camera, SHELF, IMAGES.depth)
    assert words in fault


def test_a_board_5_mm_off_is_not():
    assert image_faults(moved(CAMERA, (0.0, 0.0, 0.005)), SHELF, IMAGES.depth) == ()


def test_images_that_show_nothing_are_told():
    (fault,) = image_faults(CAMERA, SHELF, np.zeros_like(IMAGES.depth))
    assert "nothing was measured" in fault
    (fault,) = image_faults(CAMERA, SHELF, IMAGES.depth, np.full_like(IMAGES.mask, -1))
    assert "names no object" in fault
