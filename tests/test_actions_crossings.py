"""What stands in the way of a gripper, and of what it holds, where they cross into the shelf along x."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mechsearch_jax.actions import approach
from mechsearch_jax.actions.config import CLOSED, OPEN, ActionConfig, ActionSpace, action_tables
from mechsearch_jax.actions.kinds import placement, push
from mechsearch_jax.actions.kinds.nothing import no_action
from mechsearch_jax.dynamics import rigid
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.geometry.collision import collisions
from mechsearch_jax.geometry.transforms import make, transform, translate, upright_pose, yaw_rotation
from mechsearch_jax.grasping import retrieval
from mechsearch_jax.grasping.config import GraspConfig
from mechsearch_jax.grasping.graspability import grasp_tables
from mechsearch_jax.robot.entry import crossing_length
from mechsearch_jax.robot.grasp_frames import gripper_rotation
from mechsearch_jax.robot.gripper import Gripper, gripper_cloud
from mechsearch_jax.shapes import shape_of
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

SHELF, GRIPPER = Shelf(), Gripper()
WRIST = 2


@pytest.fixture(scope="module")
def space():
    tables = action_tables(GRIPPER, GraspConfig().wrists, ActionConfig())
    return ActionSpace(SHELF, tables, GRIPPER, ActionConfig(), math.radians(45), 4)


@pytest.fixture(scope="module")
def grasps():
    config = GraspConfig(yaw_step=math.radians(45), tilts=(math.radians(30),), wrists=(math.radians(60),), points=512)
    return grasp_tables(GRIPPER, Target(), config)


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


def touched(tables, opening, T, scene, still=False):
    """Which objects the gripper touches at poses (C, 4, 4), on its straight way in to them or where it is."""
    return touches(tables, jnp.full(len(T), approach.cloud_index(tables, opening, WRIST, still)), T, scene)


@jax.jit
def touches(tables, cloud, T, scene):
    mask = jnp.broadcast_to(scene.valid, (len(T), scene.capacity))
    return collisions(approach.gripper_clouds(tables), cloud, T, scene, mask)


@jax.jit
def open_hand_hits(space, T, scene):
    """Whether the open gripper hits anything on its crossing to a pose."""
    places, crosses = approach.crossing_places(space, T[None])
    return crosses[0] & jnp.any(touched(space.tables, OPEN, places[0], scene, still=True))


def push_from(T, way=(0.0, 0.0, 0.0)):
    way = jnp.float32(way)
    action = no_action()
    return action.replace(
        kind=jnp.int32(push.CODE), T_world_gripper=T, T_world_place=translate(T, way), displacement=way
    )


def absent(scene):
    return scene.replace(valid=jnp.zeros(scene.capacity, bool))


@jax.jit
def meets(space, scene, after, action, moved=True, pushes=True):
    """`push.gripper_meets`; where all objects are moved, only those on the ways in and back count."""
    moved = jnp.broadcast_to(jnp.asarray(moved), scene.capacity)
    return push.gripper_meets(space, scene, after, action, jnp.int32(WRIST), moved, jnp.asarray(pushes))


def closed_hand_hits(space, T, scene):
    """Whether a push from a pose meets anything on its way in along x."""
    return meets(space, scene, absent(scene), push_from(T))


HANDS = pytest.mark.parametrize(("opening", "judge"), [(OPEN, open_hand_hits), (CLOSED, closed_hand_hits)])


@HANDS
def test_the_gripper_hits_on_its_crossing_what_a_float64_reference_says(space, opening, judge):
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(60):
        T = pose((rng.uniform(0.6, 0.76), 0.1, 0.5), rng.uniform(-40, 40), rng.uniform(20, 30))
        tips = np.asarray(T)[:3, 3] - 0.3 * np.asarray(T)[:3, 2]
        half = (rng.uniform(0.015, 0.04), rng.uniform(0.015, 0.04), rng.uniform(0.08, 0.14))
        scene = standing(
            (half, tips[0] - rng.uniform(-0.06, 0.16), tips[1] + rng.uniform(-0.1, 0.1)),
            shape=str(rng.choice(["box", "cylinder"])),
        )
        points = swept(T, GRIPPER.max_opening if opening == OPEN else 0.0, float(space.tables.q7[opening, WRIST]))
        is_hit = bool(judge(space, T, scene))
        # Clouds have gaps: what is touched less than a centimetre deep may be missed.
        if least_gauge(scene, points) > 1.0 + 1e-3:
            assert not is_hit
        elif float(crossing_length(T, 0.374, GRIPPER)) > 0.03 and least_gauge(scene, points, -0.01) < 1.0:
            # A push may begin to touch something where its straight way in begins: that is proposals' to look at.
            assert is_hit or (opening == CLOSED and touched(space.tables, opening, T[None], scene).any())
        seen.append(is_hit)
    assert 5 < sum(seen) < 50


@HANDS
def test_where_there_is_no_crossing_nothing_is_hit(space, opening, judge):
    T = pose((0.56, 0.1, 0.5))
    scene = in_the_way(T, 0.1)
    assert touched(space.tables, opening, approach.crossing_places(space, T[None])[0][0], scene, still=True).any()
    assert not judge(space, T, scene)


@pytest.mark.parametrize("ends", ["start", "end"])
def test_a_push_past_a_post_that_only_its_crossing_touches_is_impossible(space, ends):
    action = push_from(pose(DEEP), (0.0, 0.25, 0.0))
    T, end = action.T_world_gripper, action.T_world_place
    scene = in_the_way(T if ends == "start" else end)
    free = absent(scene)
    judge = lambda a, b, pushes: meets(space, a, b, action, pushes=pushes)  # noqa: E731
    assert not touched(space.tables, CLOSED, jnp.stack([T, end]), scene).any()
    assert bool(judge(scene, scene, True))
    assert bool(judge(scene, free, True)) == (ends == "start")
    assert bool(judge(free, scene, True)) == (ends == "end")
    assert not bool(judge(free, free, True))
    assert not bool(judge(scene, scene, False))


def beside(T, side, shift=0.0):
    """A post that the fingers of a closed hand at a pose have sunk into, or stand apart from by a shift [m]."""
    x, y, _ = np.asarray(T)[:3, 3]
    return standing(((0.02, 0.02, 0.06), x, y + side * shift))


def test_a_push_meets_what_it_leaves_in_place_and_not_what_it_moves(space):
    # No crossing, so that the way in along x is no matter.
    action = push_from(pose((0.5, 0.1, SHELF.board + 0.05), 0.0), (0.0, 0.15, 0.0))
    judge = lambda scene, moved: meets(space, scene, absent(scene), action, moved)  # noqa: E731
    for share in (1 / 3, 2 / 3, 1.0):
        scene = beside(translate(action.T_world_gripper, share * action.displacement), 1.0)
        assert bool(judge(scene, False))
        assert not bool(judge(scene, True))
    assert not bool(judge(beside(action.T_world_place, 1.0, 0.15), False))


def test_a_push_meets_on_its_way_back_what_it_moved_beside_its_own(space):
    action = push_from(pose((0.5, 0.1, SHELF.board + 0.05), 0.0), (0.0, 0.15, 0.0))
    nothing = absent(beside(action.T_world_place, 1.0))
    judge = lambda after, index, moved: meets(space, nothing, after, action.replace(object=index), moved)  # noqa: E731
    own, another = jnp.int32(0), jnp.int32(1)
    in_the_hand = beside(action.T_world_place, 1.0)
    assert bool(judge(in_the_hand, another, True))
    assert not bool(judge(in_the_hand, own, True))
    assert not bool(judge(in_the_hand, another, False))
    # What touches the hand, because the hand has pushed it, is not in its way back.
    reach = next(
        d
        for d in np.arange(0.0, 0.1, 0.001)
        if not touched(space.tables, CLOSED, action.T_world_place[None], beside(action.T_world_place, 1.0, d)).any()
    )
    touching = beside(action.T_world_place, 1.0, reach - 0.004)
    assert touched(space.tables, CLOSED, action.T_world_place[None], touching).any()
    assert not bool(judge(touching, another, True))


ANYWHERE, FAULTS = 0, {"ways_in": 1, "arm_hits": 2, "arm_hits_shelf": 3, "cloud_hits_shelf": 4, "turns": 5}
SMALL = (0.02, 0.02, 0.06)


@pytest.fixture(scope="module")
def transfers(space):
    """Whether a body of a half size at `DEEP` can be taken to two places, with or without a post: compiled once.

    The arm gets anywhere and touches nothing, so that what the gripper and its load hit is all that can be in the way;
    unless a number says what is wrong with it.
    """
    turned = placement.LARGEST_TRANSFER + 0.1

    def able(space, half, post, post_there, T, wanted, fault):
        def fails(what):
            return fault == FAULTS[what]

        def ways_in(T, q7, gripper, crossings, waypoints):
            there = T[1, 3] > DEEP[1] + 0.1
            q = jnp.zeros((crossings + waypoints, 7)) + turned * (there & fails("turns"))
            return q, ~(there & fails("ways_in")), jnp.float32(gripper.outside[0])

        body = standing((SMALL, DEEP[0], DEEP[1]))
        scene = jax.tree.map(lambda a, b: jnp.stack([a[0], b[0]]), body.replace(size=body.size.at[0].set(half)), post)
        scene = scene.replace(valid=jnp.array([True, False]).at[1].set(post_there))
        index = jnp.int32(0)
        grasp = placement.ObjectGrasp(index, T[0], jnp.int32(WRIST), wanted[0])
        held = make(rigid.in_hand(scene, index, T[0]), scene.position[0])
        put = [rigid.pick_and_place(scene, index, T[0], place) for place in T[1:]]
        objects = jnp.stack([held, *(make(after.rotation[0], after.position[0]) for after in put)])
        cloud = superquadric.sample_surface(scene.size[0], scene.exponents[0], space.config.object_points)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(placement, "ways_in", ways_in)
            arm_hits = lambda q, scene: jnp.full((len(q), scene.capacity), fails("arm_hits"))  # noqa: E731
            patch.setattr(placement, "arm_hits", arm_hits)
            patch.setattr(placement, "arm_hits_shelf", lambda q, shelf: jnp.full(len(q), fails("arm_hits_shelf")))
            patch.setattr(placement, "cloud_hits_shelf", lambda shelf, T, cloud: fails("cloud_hits_shelf"))
            return placement.transfers(space, scene, grasp, cloud, placement.Ends(T, objects, wanted))

    compiled = jax.jit(able)

    def transferable(post, places, half, post_there, wanted=(True, True, True), fault=ANYWHERE):
        # One program for all: a single place is looked at twice.
        T = jnp.stack([pose(DEEP), *places, *places][:3])
        return compiled(space, jnp.float32(half), post, post_there, T, jnp.array(wanted), fault)

    return transferable


@pytest.mark.parametrize("ends", ["grasp", "place"])
def test_a_pick_past_a_post_that_only_its_crossing_touches_is_impossible(space, transfers, ends):
    T, place, other = (pose((DEEP[0], DEEP[1] + y, DEEP[2])) for y in (0.0, 0.15, -0.15))
    post = in_the_way(T if ends == "grasp" else place)
    able = functools.partial(transfers, post, [place, other], SMALL)
    wider = post.replace(size=post.size + space.config.clearance)
    assert not touched(space.tables, OPEN, jnp.stack([T, place, other]), wider).any()
    assert able(False).tolist() == [True, True]
    # Past what is in the way of the grasp it goes nowhere; past what is in the way of a place, to the others.
    assert able(True).tolist() == [False, ends == "place"]
    # And nowhere if it is not wanted there, or not at all.
    assert able(False, (True, False, True)).tolist() == [False, True]
    assert able(False, (False, True, True)).tolist() == [False, False]


def test_what_is_held_must_get_past_too_and_out_of_the_shelf(space, transfers):
    """Lower than the hand, but not than what hangs from it."""
    T, place = pose(DEEP), pose((DEEP[0], DEEP[1] + 0.15, DEEP[2]))
    post = in_the_way(T, -0.045)
    able = functools.partial(transfers, post, [place])
    assert not open_hand_hits(space, T, post)
    assert able(SMALL, False).all()
    assert not able(SMALL, True).any()
    # Longer than there is room for between the gripper's place outside and the shelf.
    assert not able((0.2, 0.02, 0.06), False).any()


@pytest.mark.parametrize("what", FAULTS)
def test_a_pick_is_impossible_where_the_arm_is(transfers, what):
    place = pose((DEEP[0], DEEP[1] + 0.15, DEEP[2]))
    able = functools.partial(transfers, in_the_way(place), [place], SMALL, False)
    assert able().all()
    assert not able(fault=FAULTS[what]).any()


def test_a_retrieval_past_a_post_that_only_its_crossing_touches_hits_it(grasps):
    T_world_target = upright_pose(jnp.float32([DEEP[0] - 0.02, DEEP[1], 0.0]), Target().height(SHELF))
    T = transform(T_world_target, grasps.T_target_gripper[:, :3, 3])
    turned = int(jnp.argmax(grasps.T_target_gripper[:, 1, 2]))
    grasp = make(grasps.T_target_gripper[turned, :3, :3], T[turned])
    feasible = jnp.arange(len(grasps.q7)) == turned
    crossing_hits = jax.jit(retrieval.crossing_hits, static_argnums=1)
    for top, hit in ((-0.005, True), (-0.045, True), (-0.15, False)):
        scene = in_the_way(grasp, top)
        hits = crossing_hits(grasps, GRIPPER, scene, T_world_target, feasible)
        assert bool(hits[turned, 0]) == hit
        assert not hits[~np.asarray(feasible)].any()
        assert not hits[:, 1].any()
        found_grasps = retrieval.FoundGrasps(T_world_target, feasible, jnp.zeros((len(grasps.q7), 1, 7)))
        z = jax.jit(retrieval.straight_hits)(grasps, found_grasps, scene)
        assert not z.any()


def test_the_arm_is_followed_closely_to_just_before_the_fingers_close():
    poses, last = retrieval.ARM_POSES, retrieval.CROSSINGS + approach.CLOSE_WAYPOINTS - 1
    assert poses[-1] == last - 1
    # The longest way along x is 17 cm; the approach begins at row CROSSINGS.
    along = np.concatenate(
        [
            0.17 * np.arange(retrieval.CROSSINGS) / retrieval.CROSSINGS,
            0.17 + GRIPPER.approach * np.linspace(0.0, 1.0, approach.CLOSE_WAYPOINTS),
        ]
    )
    assert np.diff(along[poses]).max() <= 0.055
