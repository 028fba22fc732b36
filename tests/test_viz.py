"""Pictures: what is drawn where, and that drawing leaves no trace outside the figure."""

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread
from matplotlib.patches import Polygon

from mechsearch_jax.actions import ActionKind, kind_of, no_action, retrieve_action
from mechsearch_jax.geometry import superquadric
from mechsearch_jax.viz import drawing
from mechsearch_jax.viz.blockers import MARK, mark_from_above
from mechsearch_jax.viz.filmstrip import Frame, filmstrip
from mechsearch_jax.viz.maps import Maps, maps_figure
from mechsearch_jax.workspace import scenario as scenarios
from mechsearch_jax.workspace.camera import Camera, project
from mechsearch_jax.workspace.scenario import Body
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

CAMERA, SHELF = Camera(), Shelf()
TURNED = (np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8))
ON_ITS_SIDE = (np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0)
BODIES = (
    Body("box", (0.05, 0.02, 0.06), (0.6, 0.1, 0.4645), TURNED),
    Body("cylinder", (0.03, 0.03, 0.06), (0.55, -0.1, 0.4645), (1.0, 0.0, 0.0, 0.0)),
    Body("cylinder", (0.03, 0.03, 0.1), (0.65, 0.3, 0.4345), ON_ITS_SIDE),
)
SCENE = scenarios.superquadrics(BODIES)
RIGHT = np.array([[0, 0, 1, 0.55], [0, -1, 0, -0.1], [1, 0, 0, 0.46], [0, 0, 0, 1]], np.float32)
PLACE = RIGHT + np.array([[0, 0, 0, 0.1], [0, 0, 0, 0.2], [0, 0, 0, 0], [0, 0, 0, 0]], np.float32)
PUSH = no_action().replace(
    kind=jnp.int32(ActionKind.PUSH),
    object=jnp.int32(0),
    T_world_gripper=jnp.asarray(RIGHT),
    displacement=jnp.array([0.0, 0.1, 0.0]),
)
PUSH_BY = np.array([[0, 0, 0, 0], [0, 0, 0, 0.1], [0, 0, 0, 0], [0, 0, 0, 0]], np.float32)
PICK = no_action().replace(
    kind=jnp.int32(ActionKind.PICK_AND_PLACE),
    object=jnp.int32(1),
    T_world_gripper=jnp.asarray(RIGHT),
    T_world_place=jnp.asarray(PLACE),
)
RETRIEVAL = retrieve_action(jnp.asarray(RIGHT), jnp.float32(0.8), jnp.float32(0.08))


def moved_on(action):
    """The objects after an action, as a planner may expect them: the moved one is 20 cm further left and turned."""
    if int(action.kind) != ActionKind.PICK_AND_PLACE:
        return SCENE
    turn = jnp.asarray(scenarios.superquadrics(BODIES[:1]).rotation[0])
    return SCENE.replace(
        position=SCENE.position.at[1].add(jnp.float32([0.1, 0.2, 0.0])), rotation=SCENE.rotation.at[1].set(turn)
    )


def shown(action):
    """What frames hold of an action."""
    after = moved_on(action)
    return {"after": after, "sketch": kind_of(int(action.kind)).sketch(SCENE, after, action)}


def frame(target, **changes):
    poses = target.candidate_poses(SHELF)
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    fields = {
        "title": "1  push",
        "caption": "why",
        "image": image,
        "owner": np.full(image.shape[:2], -1, np.int8),
        "scene": SCENE,
        "existence": poses[:, 1] > 0.2,
        "graspability": np.arange(len(poses)) % 12 - 10,
        "target_pose": np.array([0.7, 0.1, 0.0], np.float32),
        "found": False,
        **shown(PUSH),
    }
    return Frame(**{**fields, **changes})


def test_outlines_are_the_bodies_seen_from_above():
    box, round_one, lying, *absent = drawing.outlines(SCENE)
    assert absent == [None] * (SCENE.capacity - 3)
    for side, direction in ((0.1, (1, 1)), (0.04, (1, -1))):
        assert np.ptp(box @ direction) / np.sqrt(2) == pytest.approx(side, abs=1e-3)
    radius = np.linalg.norm(round_one - np.array(BODIES[1].position[:2]), axis=1)
    np.testing.assert_allclose(radius, 0.03, atol=1e-3)
    np.testing.assert_allclose(np.ptp(lying, axis=0), [0.06, 0.2], atol=2e-3)


def test_outlines_in_the_view_reach_as_far_as_the_projected_corners():
    sharp = SCENE.replace(exponents=jnp.full_like(SCENE.exponents, 0.01))
    outline, _, _, *absent = drawing.outlines_in_view(sharp, CAMERA)
    assert absent == [None] * (SCENE.capacity - 3)
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(8, 3) * BODIES[0].half_size
    world = corners @ np.asarray(SCENE.rotation[0]).T + np.array(BODIES[0].position)
    pixels = np.asarray(project(CAMERA, jnp.asarray(world, jnp.float32))[0])[:, ::-1]
    np.testing.assert_allclose(outline.min(axis=0), pixels.min(axis=0), atol=1.5)
    np.testing.assert_allclose(outline.max(axis=0), pixels.max(axis=0), atol=1.5)


def filmed(*frames, target=None):
    return filmstrip(frames, CAMERA, SHELF, target or Target.cylinder(), "one")


def ghosts(axes, colour=drawing.ACTION):
    dashed = [p for p in axes.patches if isinstance(p, Polygon) and p.get_linestyle() != "solid"]
    return [p.get_xy()[:-1] for p in dashed if mpl.colors.same_color(p.get_edgecolor(), colour)]


def hands(axes):
    colour = mpl.colors.to_rgb(drawing.HAND)
    polygons = [p for p in axes.patches if isinstance(p, Polygon)]
    return [p.get_xy()[:-1] for p in polygons if mpl.colors.to_rgb(p.get_edgecolor()) == pytest.approx(colour)]


def test_the_picture_shows_the_planners_own_prediction():
    view, above = filmed(frame(Target.cylinder(), **shown(PICK))).axes
    (ghost,) = ghosts(above)
    expected = drawing.outlines(moved_on(PICK))[1][:, ::-1]
    assert len(ghost) == len(expected)
    assert {tuple(corner) for corner in ghost.round(6)} == {tuple(corner) for corner in expected.round(6)}
    (ghost,) = ghosts(view)
    np.testing.assert_allclose(ghost, drawing.outlines_in_view(moved_on(PICK), CAMERA)[1], atol=1e-6)


@pytest.mark.parametrize(("action", "places"), [(PUSH, 2), (PICK, 2), (RETRIEVAL, 1), (no_action(), 0)])
def test_the_hand_is_drawn_where_it_acts(action, places):
    view, above = filmed(frame(Target.cylinder(), **shown(action))).axes
    for axes in (view, above):
        assert len(hands(axes)) == 3 * places
    for i, T in enumerate([action.T_world_gripper, action.T_world_gripper + PUSH_BY, action.T_world_place][:places]):
        if i == 1 and int(action.kind) == ActionKind.PICK_AND_PLACE:
            T = action.T_world_place
        left, right, hand = hands(above)[3 * i : 3 * i + 3]
        tip = np.asarray(T)[[1, 0], 3]
        assert left[:, 1].max() == pytest.approx(tip[1], abs=0.01)
        assert hand[:, 1].max() < tip[1]
        assert (left.mean(axis=0) + right.mean(axis=0))[0] / 2 == pytest.approx(tip[0], abs=2e-3)


def test_the_view_is_cut_to_what_stands_there():
    low, high = (drawing.view_window(CAMERA, SHELF, height) for height in (drawing.height_of([SCENE], SHELF), None))
    assert low[3] - low[2] < 0.7 * (high[3] - high[2])
    for outline in drawing.outlines_in_view(SCENE, CAMERA)[:3]:
        assert (outline > (low[0], low[2])).all()
        assert (outline < (low[1], low[3])).all()
    tall = SCENE.replace(size=SCENE.size.at[0, 2].set(0.2))
    assert drawing.height_of([SCENE, tall], SHELF) > drawing.height_of([SCENE], SHELF)


@pytest.mark.parametrize("count", [1, 2, 6])
def test_all_type_is_large_enough_at_a_thousand_pixels(count):
    long = {"title": "10  push the target by 15 cm forward and to the right", "caption": "a reason " * 12}
    figure = filmed(*[frame(Target.cylinder(), **long)] * count)
    assert figure.get_figwidth() == 10.0
    figure.draw_without_rendering()
    texts = [*figure.texts, *(text for axes in figure.axes for text in axes.texts)]
    assert min(text.get_fontsize() for text in texts) >= 8
    # Nothing that is written lies over a picture or beyond its step.
    boxes = [text.get_window_extent() for text in figure.texts]
    pictures = [axes.get_window_extent() for axes in figure.axes]
    assert not any(box.overlaps(picture) for box in boxes for picture in pictures)
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.width for box in boxes)
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


@pytest.mark.parametrize("target", [Target.cylinder(), Target.box()], ids=["cylinder", "box"])
def test_a_map_puts_every_pose_where_it_is(target):
    rows, columns = target.grid
    shown = np.zeros(rows * columns * target.yaws, bool)
    index = np.ravel_multi_index((3, 7, 0), (rows, columns, target.yaws))
    shown[index] = True
    image = drawing.map_image(shown, np.ones(len(shown), int), target)
    assert image.shape == (rows, columns, 4)
    assert np.argwhere(image[..., 3] > 0).tolist() == [[3, 7]]
    np.testing.assert_allclose(image[3, 7, :3], drawing.rgb(drawing.GRASPABLE))


def test_a_map_shows_the_best_of_the_possible_yaw_angles():
    target = Target.box()
    shape = (*target.grid, target.yaws)
    shown, g = np.zeros(shape, bool), np.full(shape, 1)
    shown[0, 0, :2] = True
    g[0, 0, :2] = (-1, 0)
    image = drawing.map_image(shown.reshape(-1), g.reshape(-1), target)
    np.testing.assert_allclose(image[0, 0, :3], drawing.rgb(drawing.BLOCKED[0]))
    assert image[0, 0, 3] < 0.9


# What somebody without red or green cones sees of linear red, green and blue: Machado et al., 2009.
SEEN = {
    "all": np.eye(3),
    "no red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "no green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


@pytest.mark.parametrize("eyes", SEEN)
def test_colours_that_stand_for_different_things_differ_for_everybody(eyes):
    colours = [drawing.GRASPABLE, *drawing.BLOCKED, drawing.NO_GRASP, drawing.TARGET, drawing.WARNING]
    linear = np.array([drawing.rgb(colour) for colour in colours])
    linear = np.where(linear > 0.04045, ((linear + 0.055) / 1.055) ** 2.4, linear / 12.92)
    xyz = np.clip(linear @ np.array(SEEN[eyes]).T, 0, 1) @ TO_XYZ.T / TO_XYZ.sum(axis=1)
    root = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    lightness, ab = 116 * root[:, 1] - 16, np.array([500, 200]) * -np.diff(root, axis=1)
    lab = np.column_stack([lightness, ab])
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=-1) + 100 * np.eye(len(colours))
    # CIELAB; about 2 is just seen.
    assert apart.min() > 15


def test_warnings_are_legible_and_inside_the_picture():
    lines = [f"warning {k}: " + "what is said of it " * 14 for k in range(4)]
    for heading in ("\n".join(lines), " ".join(lines), "short", "one\ntwo"):
        figure = filmstrip([frame(Target.cylinder())], CAMERA, SHELF, Target.cylinder(), heading)
        FigureCanvasAgg(figure).draw()
        text = figure.texts[0]
        box, whole = text.get_window_extent(), figure.bbox
        assert text.get_fontsize() >= 9.0
        assert 0 <= box.x0 < box.x1 <= whole.x1
        assert max(axes.get_window_extent().y1 for axes in figure.axes) < box.y0 < box.y1 <= whole.y1
        assert " ".join(text.get_text().split()) == " ".join(heading.split())


def test_an_empty_scene_can_be_drawn(tmp_path):
    nothing = superquadric.empty(8)
    empty = frame(Target.cylinder(), scene=nothing, **shown(no_action()), existence=np.zeros(792, bool))
    full = frame(Target.cylinder(), **shown(no_action()))
    strips = [filmed(empty), filmed(full)]
    maps = Maps(Target.cylinder().candidate_poses(SHELF), empty.existence, empty.graspability, nothing)
    rest = empty.image, empty.owner, empty.target_pose, CAMERA, SHELF, Target.cylinder()
    drawn = [*strips, maps_figure(maps, *rest, heading="none")]
    outlines = [
        sum(
            mpl.colors.same_color(patch.get_edgecolor(), drawing.OBJECT)
            for axes in figure.axes
            for patch in axes.patches
        )
        for figure in drawn
    ]
    assert outlines == [0, len(BODIES), 0]
    for figure in drawn:
        drawing.save_figure(figure, tmp_path / "drawn.png", dpi=40)
        assert imread(tmp_path / "drawn.png")[..., :3].std() > 0.05


def test_what_is_in_the_way_is_marked_from_above():
    axes = mpl.figure.Figure().add_axes((0, 0, 1, 1))
    mark_from_above(axes, SCENE, (1,))
    (outline,) = (patch for patch in axes.patches if mpl.colors.same_color(patch.get_edgecolor(), MARK))
    y, x = outline.get_xy().mean(axis=0)
    assert (x, y) == pytest.approx((0.55, -0.1), abs=0.01)


def test_what_is_drawn_is_where_the_camera_sees_it():
    camera = Camera()
    points = np.random.default_rng(0).uniform((0.4, -0.3, 0.4), (0.8, 0.5, 0.8), (50, 3))
    rows_columns = np.asarray(project(camera, jnp.asarray(points, jnp.float32))[0])
    np.testing.assert_allclose(drawing.pixels(camera, points), rows_columns[:, ::-1], atol=0.01)
