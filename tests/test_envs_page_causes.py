"""Why a target was lost, physically: what touched what, why trials failed, what could not be moved, and where it is."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import EPISODE, LOST, OBJECTS, PUSH, RECORDING, STEPS, evidence, record, stacked, trace
from scipy.spatial.transform import Rotation
from stage import BOX, CYLINDER, UPRIGHT

from mechsearch_jax.config.presets import PRESETS
from mechsearch_jax.envs.page import causes
from mechsearch_jax.envs.page.causes import cause, why_none
from mechsearch_jax.envs.page.choices import Ways, begun, none_in_words, only_entering, ways
from mechsearch_jax.envs.page.contacts import ARM, BESIDE, HAND, WALLS, chain, knocked, pressed, touches
from mechsearch_jax.envs.page.ending import ending
from mechsearch_jax.envs.page.page import page
from mechsearch_jax.envs.page.places import Group, area, beside_wall, groups, groups_in_words, possible, walls, where
from mechsearch_jax.envs.page.reasons import did_nothing
from mechsearch_jax.envs.page.replays import Stop, knocks, run_stop, trial_stop
from mechsearch_jax.envs.page.steps import trials
from mechsearch_jax.envs.world.world import BODIES, TARGET, from_scenario
from mechsearch_jax.planner.noted_trials import TriedActions
from mechsearch_jax.planner.trials import TrialResult
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf

SHELF = Shelf()
# Against the right wall, a little turned, and a push that presses it on: of a search in which it was refused.
TURN = Rotation.from_euler("z", 16, degrees=True)
TURNED = tuple(TURN.as_quat(scalar_first=True).tolist())
AT_WALL = Body("box", (0.028, 0.047, 0.08), (0.5294, -0.2285, 0.4846), TURNED)
START = np.array(
    [[0.5, 0.0, 0.866, 0.5494], [0.0, -1.0, 0.0, -0.0706], [0.866, 0.0, -0.5, 0.4845], [0.0, 0.0, 0.0, 1.0]]
)
PLACE = START.copy()
PLACE[1, 3] -= 0.1


def pair(one, other):
    return frozenset((one, other))


def moving(*begins):
    """A trace of ten rows in which bodies begin to move along x at these rows; None stays where it is."""
    position = np.zeros((10, BODIES, 3))
    for k, begin in enumerate(begins):
        if begin is not None:
            position[begin:, k, 0] = 0.01 * (1 + np.arange(10 - begin))
    return dataclasses.replace(RECORDING.steps[0].trace, position=position)


def pushed_on(k=0, result=TrialResult.FAILED, body=AT_WALL, **config):
    """A recording of a push of an object at the right wall, onto the wall, that was tried."""
    world = jax.tree.map(np.asarray, from_scenario(Scenario("wall", (body,), CYLINDER)))
    action = PUSH.replace(
        object=np.int32(k),
        T_world_gripper=START.astype(np.float32),
        displacement=np.array([0.0, -0.1, 0.0], np.float32),
        T_world_place=PLACE.astype(np.float32),
    )
    tried = TriedActions(stacked(action), np.array([result], np.int32))
    scene = OBJECTS.replace(
        **{
            name: np.concatenate([np.asarray(value, np.float32)[None], getattr(OBJECTS, name)[1:]])
            for name, value in (
                ("size", body.half_size), ("position", body.position), ("rotation", TURN.as_matrix()),
            )
        }
    )  # fmt: skip
    step = dataclasses.replace(STEPS[0], world=world, scene=scene, action=action, evidence=evidence(tried=tried))
    options = {**EPISODE.config, "rehearsal": "physics", **config}
    return dataclasses.replace(LOST, steps=(step, STEPS[1]), episode=dataclasses.replace(EPISODE, config=options))


def test_a_chain_leads_from_the_robot_to_a_wall_by_the_shortest_way():
    row = [pair(HAND, 0), pair(0, 2), pair(2, "the left wall"), pair(0, "the back wall"), pair(3, "the right wall")]
    assert chain(row, WALLS) == (HAND, 0, "the back wall")
    assert chain(row, [2]) == (HAND, 0, 2)
    assert chain(row, [3]) == chain([], WALLS) == ()
    assert pressed(chain(row, WALLS)) == "the hand pressed object 0 against the back wall"
    assert pressed((ARM, "the upper board"), now=True) == "the arm runs into the upper board"
    far = pressed((HAND, 1, TARGET, "the back wall"), hidden=True)
    assert far == "the hand pressed object 1 against the hidden target, and that against the back wall"


@given(st.lists(st.tuples(st.sampled_from([HAND, *range(5), *sorted(WALLS)]), st.integers(0, 4)), max_size=12))
def test_each_two_of_a_chain_touch(pairs):
    row = {frozenset(each) for each in pairs if len(set(each)) == 2}
    path = chain(row, WALLS)
    assert all(frozenset(each) in row for each in itertools.pairwise(path))
    assert len(set(path)) == len(path)
    assert not path or (path[0] == HAND and path[-1] in WALLS)


def test_a_body_is_knocked_by_what_touched_it_as_it_began_to_move():
    begins = moving(2, 4, None, 6)
    rows = [set() for _ in range(10)]
    rows[2] = {pair(HAND, 0)}
    rows[4] = {pair(0, 1), pair(1, 2)}
    rows[6] = {pair(1, 3), pair(2, 3)}
    never = lambda: [frozenset()] * 10  # noqa: E731
    assert knocked(rows, never, begins, 3) == (HAND, 0, 1, 3)
    assert knocked(rows, never, begins, 2) == ()
    # What moves later has moved nothing.
    assert knocked(rows, never, moving(5, 4), 1) == ()
    # They may meet and part between two rows.
    near = [frozenset()] * 10
    near[6] = frozenset({pair(0, 3)})
    rows[6] = {pair(2, 3)}
    assert knocked(rows, never, begins, 3) == ()
    assert knocked(rows, lambda: near, begins, 3) == (HAND, 0, 3)


def test_what_touches_is_seen_at_the_recorded_poses():
    beside = dataclasses.replace(BOX, position=(0.5, 0.135 + 0.056, 0.4845))
    wall = dataclasses.replace(BOX, position=(0.788 - 0.048, -0.1, 0.4845))
    bodies = [BOX, beside, wall, *[None] * (BODIES - 4), CYLINDER]
    still = trace(np.zeros(3))
    position, turned = np.zeros((36, BODIES, 3)), np.tile(UPRIGHT, (36, BODIES, 1))
    for k, body in enumerate(bodies):
        position[:, k] = body.position if body else 0.0
    rows = touches(SHELF, bodies, dataclasses.replace(still, position=position, quaternion=turned))
    assert rows[0] == rows[-1] == {pair(0, 1), pair(2, "the back wall")}
    position[:, 1, 1] += 0.008
    apart = dataclasses.replace(still, position=position, quaternion=turned)
    assert touches(SHELF, bodies, apart)[0] == {pair(2, "the back wall")}
    assert pair(0, 1) in touches(SHELF, bodies, apart, BESIDE)[0]
    position[:, 1, 1] += 0.004
    assert pair(0, 1) not in touches(SHELF, bodies, apart, BESIDE)[0]


def test_the_trial_of_a_push_into_a_wall_is_explained_by_simulating_it_once_more():
    recording = pushed_on()
    stop = trial_stop(recording, 0, 0)
    assert stop.reason == "the arm was held up"
    assert stop.path == (HAND, 0, "the right wall")
    assert stop.words == "the arm was held up: the hand pressed object 0 against the right wall"
    (row,) = trials(recording.steps[0], [stop])
    assert (row.result, row.verdict) == (stop.words, "chosen")
    assert trials(recording.steps[0])[0].result == "failed; why is not known"
    # Nothing is said of trials that succeeded, of those that ran otherwise, or that do not fail again.
    assert trial_stop(pushed_on(result=TrialResult.SUCCEEDED), 0, 0) is None
    assert trial_stop(pushed_on(rehearsal="learning"), 0, 0) is None
    assert trial_stop(dataclasses.replace(recording, episode=None), 0, 0) is None
    assert trial_stop(pushed_on(body=dataclasses.replace(AT_WALL, position=(0.5294, -0.14, 0.4846))), 0, 0) is None


def test_a_run_that_failed_says_why():
    failed = (record(PUSH, failure="dropped"), EPISODE.steps[1])
    recording = dataclasses.replace(LOST, episode=dataclasses.replace(EPISODE, steps=failed))
    assert run_stop(recording, 0).words == "the object slipped out of the hand"
    assert run_stop(LOST, 0) is run_stop(RECORDING, 0) is None


def fallen(**changes):
    """A recording of a push at which the hidden target fell off the board."""
    steps = (record(PUSH, target_fallen=True), EPISODE.steps[1])
    episode = dataclasses.replace(EPISODE, steps=steps, failure="the target fell over", found_step=None, **changes)
    return dataclasses.replace(LOST, episode=episode)


def test_what_fell_is_said_to_have_been_moved_by_what_touched_it(monkeypatch):
    # The arm of this trace is far from the box, so that nothing moved it.
    assert cause(fallen(), 0, ()).words == ""
    off = "the hidden target, which fell off the board (action 1)."
    for path, said in (
        ((HAND, 0, TARGET), f"The hand pushed object 0 into {off}"),
        ((ARM, 3, 2, TARGET), f"The arm pushed object 3 into object 2, and that into {off}"),
        ((HAND, TARGET), f"The hand ran into {off}"),
    ):
        monkeypatch.setattr(causes, "knocks", lambda *_, path=path: path)
        assert cause(fallen(), 0, ()).words == said
    seen = dataclasses.replace(LOST.steps[0], found=True)
    known = dataclasses.replace(fallen(), steps=(seen, LOST.steps[1]))
    assert "ran into the target, which fell" in cause(known, 0, ()).words


def test_a_robot_that_stood_elsewhere_is_not_said_to_have_touched_anything():
    moved = fallen(config={**EPISODE.config, "mismatch.base": 0.01})
    assert knocks(moved, 0, 0) == knocks(moved, 0, TARGET) == ()


def test_a_target_that_was_pushed_out_of_reach_is_said_to_have_been(monkeypatch):
    world = STEPS[1].world
    position = np.array(world.position)
    position[TARGET, :2] = SHELF.back - 0.02, 0.1
    none = dataclasses.replace(evidence(found=True), hits=np.zeros((0, OBJECTS.capacity), bool))
    last = dataclasses.replace(STEPS[1], world=world.replace(position=position), evidence=none)
    recording = dataclasses.replace(LOST, steps=(STEPS[0], last))
    assert cause(recording, None, ()).words.startswith("The target stands against the back wall, and there the arm")
    monkeypatch.setattr(causes, "knocks", lambda *_: (HAND, 0, TARGET))
    assert cause(recording, None, ()).words == (
        "The hand pushed object 0 into the hidden target, which moved 15 cm (action 1); since then the arm can reach no"
        " grasp of it: it stands against the back wall."
    )
    assert not cause(recording, None, ()).evidence
    options = {**EPISODE.config, "move_target": False}
    fixed = dataclasses.replace(recording, episode=dataclasses.replace(EPISODE, config=options))
    assert cause(fixed, None, ()).evidence == ["A target that is found is not pushed in this search."]


def test_what_the_hand_met_as_it_reached_for_the_target_is_said_with_how_often(monkeypatch):
    held_up = Stop("the arm was held up", (HAND, 0, "the back wall"))
    stops = {None: [held_up, held_up, Stop("the hand missed the target")], 0: [held_up]}
    monkeypatch.setattr(causes, "trial_stops", lambda recording, steps, k: stops[k])
    said = cause(LOST, None, (0,))
    assert said.words == (
        "Object 0 stands in the way of each of the 2 grasps of the target that the arm can reach: reaching for it, the"
        " hand presses object 0 against the back wall, and the arm is held up."
    )
    assert said.evidence == [
        "So it was in 2 of the 3 failed trials of taking the target out at the last look.",
        "So it was in the only failed trial of moving object 0, too.",
    ]
    # Where most trials ended otherwise, nothing is said of them.
    stops[None] = [held_up, *[Stop("the hand missed the target")] * 2]
    assert "reaching for it" not in cause(LOST, None, (0,)).words
    assert cause(LOST, None, (0,)).evidence == [f"In the only failed trial of moving object 0 {held_up.words}."]


def test_since_when_nothing_could_move_what_hides_the_target_and_which_action_had_blocked_it(monkeypatch):
    free, blocked = Ways("push", True, 30, 4, 4, 4, ()), Ways("push", True, 30, 4, 0, 0, (3,))
    world = STEPS[0].world
    position, valid = np.array(world.position), np.array(world.valid)
    valid[3] = True
    before, after = (world.replace(position=position + shift, valid=valid) for shift in (0.0, 0.1))
    other = STEPS[0].sampled
    other = dataclasses.replace(other, action=other.action.replace(object=np.full(2, 5, np.int32)))
    step = dataclasses.replace(STEPS[0], sampled=other, action=other.single(0), evidence=evidence(), world=after)
    first = dataclasses.replace(step, sampled=STEPS[0].sampled, world=before)
    end = dataclasses.replace(STEPS[1], found=False, evidence=evidence(), world=after)
    records = (EPISODE.steps[0], EPISODE.steps[0], EPISODE.steps[0], EPISODE.steps[1])
    recording = dataclasses.replace(
        LOST, steps=(first, step, step, end), episode=dataclasses.replace(EPISODE, steps=records, failure="not found")
    )
    monkeypatch.setattr(causes.choices, "ways", lambda recording, i, k: (blocked,) if i else (free,))
    said = cause(recording, None, (0,))
    assert said.words.endswith(
        "hidden from the camera by object 0, and from action 2 on nothing could move object 0: object 3 is in the way"
        " of each push that the arm can follow; action 1 had put object 3 there."
    )
    (before,) = said.evidence
    assert before.startswith("Before action 2 each motion that could move it passed where the target may be")
    # Of what can be begun nothing is said.
    monkeypatch.setattr(causes.choices, "ways", lambda recording, i, k: (free._replace(entering=0),))
    assert cause(recording, None, (0,)).words.endswith("hidden from the camera by object 0.")
    monkeypatch.setattr(causes.choices, "ways", lambda recording, i, k: None)
    assert cause(recording, None, (0,)).words.endswith("hidden from the camera by object 0.")


def test_places_are_named_as_the_robot_sees_them():
    left, right, x = SHELF.left, SHELF.right, (SHELF.front + SHELF.back) / 2
    assert area(SHELF, np.array([[SHELF.back - 0.02, left - 0.02]])) == "at the back left"
    assert area(SHELF, np.array([SHELF.front + 0.02, right + 0.02])) == "at the front right"
    assert area(SHELF, np.array([x, (left + right) / 2])) == "in the middle"
    world = jax.tree.map(np.asarray, from_scenario(Scenario("wall", (AT_WALL,), CYLINDER)))
    assert next(iter(walls(SHELF, world, 0))) == "the right wall"
    assert where(SHELF, world, 0) == beside_wall(SHELF, world, 0) == "against the right wall"
    assert beside_wall(SHELF, world, TARGET) == ""


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_left_and_right_are_mirrored(deep, aside):
    x = SHELF.front + deep * (SHELF.back - SHELF.front)
    one, other = (area(SHELF, np.array([x, y])) for y in (
        SHELF.left - aside * (SHELF.left - SHELF.right), SHELF.right + aside * (SHELF.left - SHELF.right)
    ))  # fmt: skip
    if 0.34 > aside > 0.33 or 0.67 > aside > 0.66:
        return
    swapped = one.replace("left", "RIGHT").replace("right", "LEFT").replace("RIGHT", "right").replace("LEFT", "left")
    assert swapped == other


def test_where_a_hidden_target_can_be_is_behind_what_hides_it():
    recording = dataclasses.replace(LOST, camera=Camera().scaled(2))
    at_truth = np.linalg.norm(
        np.asarray(recording.target.candidate_poses(SHELF))[:, :2] - CYLINDER.position[:2], axis=1
    )
    existence = at_truth < 0.02
    step = dataclasses.replace(STEPS[0], existence=existence)
    (group,) = groups(recording, step)
    assert (group.hider, group.count) == (0, existence.sum()) == (0, possible(recording, step).sum())
    assert groups_in_words([group]) == f"behind object 0 ({group.count} places, in the middle)"
    in_view = np.asarray(recording.target.candidate_poses(SHELF))[:, 1] < SHELF.right + 0.06
    assert [g.hider for g in groups(recording, dataclasses.replace(step, existence=in_view))] == [None]


def test_groups_are_listed_the_largest_first_and_the_rest_counted():
    every = [Group(6, 20, "at the back left"), Group(2, 4, "at the back"), Group(None, 1, "in the middle")]
    assert groups_in_words(every[:2]) == "behind object 6 (20 places, at the back left) or object 2 (4, at the back)"
    assert groups_in_words(every).endswith(", object 2 (4, at the back) or elsewhere (1)")
    assert groups_in_words(every[2:]) == groups_in_words([]) == ""
    many = [Group(k, 9 - k, "at the back") for k in range(5)]
    assert groups_in_words(many).endswith("object 2 (7, at the back) or elsewhere (11)")


def test_why_nothing_could_move_an_object_is_said_in_words():
    stuck = Ways("pick-and-place", True, 0, 0, 0, 0, ())
    blocked = Ways("push", True, 30, 4, 0, 0, (3,))
    assert none_in_words([stuck, blocked], 8) == (
        "no grasp of it fits the hand, and object 3 is in the way of each push that the arm can follow"
    )
    far = Ways("push", True, 30, 0, 0, 0, ())
    assert none_in_words([far], 8) == "the arm can follow no push of it"
    assert none_in_words([far._replace(able=False)], 8) == "pushes are not among the actions"
    assert none_in_words([far._replace(plausible=0)], 8) == "each push would tip it"
    both = [blocked, Ways("pick-and-place", True, 6, 2, 0, 0, (3,))]
    assert none_in_words(both, 8) == "object 3 is in the way of each push and grasp that the arm can follow"
    several = blocked._replace(blockers=(1, 2, 8))
    assert none_in_words([several], 8).startswith("object 1 or object 2 or the target is in the way")
    free = blocked._replace(free=4, entering=4, blockers=())
    assert none_in_words([stuck, free], 8) == ""
    assert begun([stuck, free]) == 4
    assert only_entering([free])
    assert not only_entering([free._replace(entering=3)])
    assert not only_entering([stuck])


def test_of_a_record_that_does_not_hold_the_actions_it_is_not_known_why_nothing_could_move_an_object():
    assert ways(LOST, 0, 0) is ways(RECORDING, 0, 0) is None
    assert why_none(LOST, 0, 0) == ""


@pytest.mark.slow
def test_why_nothing_could_move_an_object_is_computed_from_the_recorded_scene():
    options = {**PRESETS["standard"]().options(), "policy": "search-for-grasp", "recognition": "oracle"}
    alone = pushed_on(**options)
    (pick, push) = sorted(ways(alone, 0, 0), key=lambda each: each.kind)
    assert (pick.kind, push.kind) == ("pick-and-place", "push")
    assert push.free > 0
    assert why_none(alone, 0, 0) == ""
    # A wall of boxes in front of it, which the hand can pass nowhere.
    front = np.array([[0.44, y, 0.4845] for y in (-0.25, -0.13, 0.0, 0.13, 0.25, 0.37)], np.float32)
    scene = alone.steps[0].scene
    position, size, valid = (np.array(a) for a in (scene.position, scene.size, scene.valid))
    rotation = np.array(scene.rotation)
    position[1:7], size[1:7], rotation[1:7], valid[1:7] = front, (0.02, 0.065, 0.15), np.eye(3), True
    fenced = scene.replace(position=position, size=size, rotation=rotation, valid=valid)
    recording = dataclasses.replace(alone, steps=(dataclasses.replace(alone.steps[0], scene=fenced), alone.steps[1]))
    assert begun(ways(recording, 0, 0)) == 0
    assert "in the way of each" in why_none(recording, 0, 0)


def test_the_cause_is_the_first_that_is_said_and_a_trial_is_explained_once():
    end = ending(LOST)
    assert end.cause == "Object 0 stands in the way of each of the 2 grasps of the target that the arm can reach."
    text = page(LOST)
    assert text.index(end.cause) < text.index("used up") < text.index("Believed")
    assert end.words.startswith(end.cause)
    failed = TriedActions(stacked(PUSH), np.array([TrialResult.FAILED], np.int32))
    tried = dataclasses.replace(LOST, steps=(STEPS[0], dataclasses.replace(
        STEPS[1], evidence=evidence(found=True, tried=failed), sampled=STEPS[0].sampled)
    ))  # fmt: skip
    assert ending(tried).words.count("(simulated before acting)") == 1
    assert "(simulated before acting)" not in end.words


def test_an_idle_action_says_why():
    same = (record(PUSH, cost=50.0, predicted_cost=50.0, observed_cost=50.0), EPISODE.steps[1])
    recording = dataclasses.replace(LOST, episode=dataclasses.replace(EPISODE, steps=same))
    said = did_nothing(recording, 0)
    assert said == "It did nothing for the search, because object 0 stayed where it was. J was expected to fall by 30."
    assert said in page(recording)
    assert did_nothing(LOST, 0) == did_nothing(RECORDING, 0) == ""
    world = STEPS[1].world
    position = np.array(world.position)
    position[0, 1] += 0.1
    moved = (STEPS[0], dataclasses.replace(STEPS[1], world=world.replace(position=position)))
    nowhere = dataclasses.replace(STEPS[0], existence=np.zeros_like(STEPS[0].existence))
    aside = dataclasses.replace(recording, steps=(nowhere, moved[1]))
    assert "because none of the places where the target can be is behind object 0." in did_nothing(aside, 0)
    found = dataclasses.replace(STEPS[0], found=True, evidence=evidence(found=True))
    still = dataclasses.replace(recording, steps=(found, moved[1]))
    assert "because object 0 is still in the way of the target’s best grasps." in did_nothing(still, 0)
    none = dataclasses.replace(found, evidence=dataclasses.replace(found.evidence, hits=found.evidence.hits[:0]))
    unreached = dataclasses.replace(recording, steps=(none, moved[1]))
    assert "because the arm can reach no grasp of the target, whatever stands around it." in did_nothing(unreached, 0)
