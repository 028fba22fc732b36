"""The page of an episode: what is built of a recording, what the time line moves, and that a browser shows it."""

import shutil
import socket
import sys
import threading

import numpy as np
import pytest
from browser import page, wait_for
from recordings import LOST, MOVES, OBJECTS, RECORDING, SAMPLED, WORLD
from scipy.spatial.transform import Rotation

from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.recording.recording import NAME, save_recording
from mechsearch_jax.envs.recording.step_values import Ending
from mechsearch_jax.envs.viewer.shown import card, shown_steps
from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.robot.arm_clearance import link_poses
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import Capsule
from mechsearch_jax.viz import drawing, web
from mechsearch_jax.viz.panda import panda_pieces, panda_solids

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FPS = 10


def free_port():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def opened():
    viser = pytest.importorskip("viser", reason="the page needs viser: pip install 'mechsearch-jax[viewer]'")
    server = viser.ViserServer("127.0.0.1", free_port(), verbose=False)
    yield server
    server.stop()


server = pytest.fixture(scope="module")(opened)
another_server = pytest.fixture(opened)


@pytest.fixture(scope="module")
def viewer(server):
    from mechsearch_jax.envs.viewer.viewer import Viewer

    return Viewer.of(RECORDING, server, FPS)


def node(server, name):
    return server.scene.get_handle_by_name(name)


def first_row(viewer, step):
    """The first moment of a step."""
    return next(row for row in range(viewer.count) if viewer.step_at(row) == step)


def test_everything_is_on_the_page(viewer, server):
    viewer.show(0)
    for name in (
        "/shelf/board",
        "/robot/link1",
        "/robot/hand",
        "/robot/left",
        "/true/0",
        "/true/target",
        "/map/0/cells",
    ):
        assert node(server, name) is not None, name
    assert node(server, "/true/1") is None
    assert len(node(server, "/map/0/cells").batched_positions) == RECORDING.steps[0].existence.sum()
    np.testing.assert_allclose(node(server, "/true/target").position, WORLD.position[TARGET], atol=1e-6)
    ghost = np.asarray(node(server, "/action/0/ghost0").vertices)
    middle = (ghost.min(axis=0) + ghost.max(axis=0)) / 2
    np.testing.assert_allclose(middle, RECORDING.steps[0].after.position[0], atol=2e-3)


def test_the_time_line_moves_what_moves(viewer, server):
    viewer.show(0)
    box, link = node(server, "/true/0"), node(server, "/robot/link7")
    y, arm = box.position[1], np.array(link.position)
    viewer.show(first_row(viewer, 1) - 1)
    assert box.position[1] - y == pytest.approx(0.1, abs=1e-6)
    moved = []
    for row in range(first_row(viewer, 1)):
        viewer.show(row)
        moved.append(np.linalg.norm(link.position - arm))
    assert max(moved) > 0.02
    viewer.show(10**6)
    assert viewer.row == viewer.count - 1


def test_a_step_brings_its_own_decision(viewer, server):
    viewer.show(0)
    shown = [node(server, f"/{layer}/{i}") for i in (0, 1) for layer in ("map", "recognised", "sampled", "action")]
    assert [one.visible for one in shown] == 4 * [True] + 4 * [False]
    viewer.show(first_row(viewer, 1))
    assert [one.visible for one in shown] == 4 * [False] + 4 * [True]
    assert node(server, "/sampled/0/1") is not None
    assert node(server, "/sampled/0/2") is None
    assert node(server, "/sampled/1/0") is None


def test_a_sampled_action_shows_what_was_predicted_of_it(viewer, server):
    viewer.show(0)
    viewer.examine(1)
    ghost = np.asarray(node(server, "/action/examined/ghost0").vertices)
    middle = (ghost.min(axis=0) + ghost.max(axis=0)) / 2
    np.testing.assert_allclose(middle, SAMPLED.position[1, 0], atol=2e-3)
    assert not node(server, "/action/0").visible
    assert "cost 95" in viewer.text
    viewer.examine(None)
    assert node(server, "/action/examined/ghost0") is None
    assert node(server, "/action/0").visible
    assert "cost 95" not in viewer.text
    best, worst = (np.array(node(server, f"/sampled/0/{k}").color, int) for k in (0, 1))
    assert best[1] > worst[1]
    assert worst[0] > best[0]


def test_numbers_stand_on_the_objects_and_go_with_them(viewer, server):
    viewer.show(0)
    number, box = node(server, "/numbers/0"), node(server, "/true/0")
    height = 2 * float(WORLD.half_size[0, 2])
    np.testing.assert_allclose(number.position - box.position, [0.0, 0.0, height / 2], atol=1e-6)
    assert (number.text, number.visible, node(server, "/numbers/1").visible) == ("0", True, False)
    viewer.show(first_row(viewer, 1) - 1)
    np.testing.assert_allclose(number.position - box.position, [0.0, 0.0, height / 2], atol=1e-6)
    assert node(server, "/true/0").position[1] > WORLD.position[0, 1] + 0.09


def test_the_map_is_shown_from_above_and_lies_open_in_the_window(viewer, server):
    viewer.show(0)
    maps = [shown.above for shown in shown_steps(RECORDING)]
    np.testing.assert_array_equal(viewer.pictures["above"], maps[0])
    viewer.show(first_row(viewer, 2))
    np.testing.assert_array_equal(viewer.pictures["above"], maps[2])
    assert (maps[0] != maps[2]).any()
    # From where the page begins most of the cells are seen beside the box, which is as high as they are far behind it.
    camera = server.initial_camera
    cells = np.asarray(node(server, "/map/0/cells").batched_positions)
    rays = cells - np.asarray(camera.position)
    box = np.asarray(WORLD.position[0]), np.asarray(WORLD.half_size[0])
    near, far = ((box[0] + side * box[1] - camera.position) / rays for side in (-1, 1))
    enters, leaves = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    assert ((enters > leaves) | (enters > 1)).mean() > 0.9


def test_a_panel_shows_the_values_and_what_blocks_the_target(another_server):
    from mechsearch_jax.envs.viewer.viewer import Viewer

    server = another_server
    lost = Viewer.of(LOST, server, FPS)
    assert "the target was found, but is not out after 1 action" in lost.ended
    lost.show(0)
    assert "100.0 before, 60.0 predicted, 95.0 measured" in lost.text
    assert "next best" in lost.evidence
    assert "did harm: something fell" in lost.evidence
    assert "90 %" in lost.evidence
    assert node(server, "/blocked/0/0") is None
    lost.show(first_row(lost, 1))
    assert "all hit object 0" in lost.text
    marked = np.asarray(node(server, "/blocked/1/0").vertices)
    assert (np.ptp(marked, axis=0) > 2 * np.asarray(OBJECTS.size[0])).all()
    assert node(server, "/blocked/1").visible
    colour = node(server, "/recognised/1/0").color
    np.testing.assert_allclose(colour, 255 * drawing.rgb(drawing.ACTION), atol=1)


def test_words_are_escaped():
    evil = "<script>alert(1)</script>"
    assert evil not in card(Ending(False, evil, evil))


def test_time_goes_on_while_it_is_played_and_ends(viewer):
    viewer.show(viewer.count - 3)
    viewer.play(True)
    moments = iter([True] * 6)
    viewer.run(lambda: next(moments, False))
    assert viewer.row == viewer.count - 1
    assert not viewer.playing
    viewer.play(True)
    assert viewer.row == 0
    viewer.play(False)


def test_the_pieces_of_the_robot_are_the_solids_of_the_film():
    q, opening = np.array([[0.1, -1.0, 0.2, -2.0, 0.1, 1.5, 0.7]]), 0.03
    poses = link_poses(q)[0]
    *pieces, foot = panda_pieces()
    frames = [*poses, *(poses[7] for _ in range(2))]
    frames[8], frames[9] = (frames[8].copy() for _ in range(2))
    for frame, side in ((frames[8], 1), (frames[9], -1)):
        frame[:3, 3] += side * opening / 2 * frame[:3, 1]
    placed = [
        T[:3, :3] @ solid.position + T[:3, 3] for T, solids in zip(frames, pieces, strict=True) for solid in solids
    ]
    drawn = panda_solids(poses, opening)
    np.testing.assert_allclose(placed, [solid.position for solid in drawn[1:]], atol=1e-6)
    np.testing.assert_allclose(foot[0].position, drawn[0].position)


def test_meshes_are_as_large_as_what_they_show():
    capsule = Capsule().mesh((0.1, 0.1, 0.3))
    np.testing.assert_allclose(capsule.bounds, [[-0.1, -0.1, -0.3], [0.1, 0.1, 0.3]], atol=5e-3)
    box, *rest = web.meshes_of(OBJECTS)
    low, high = box.vertices.min(axis=0), box.vertices.max(axis=0)
    np.testing.assert_allclose(high - low, 2 * np.asarray(OBJECTS.size[0]), rtol=1e-3)
    assert not any(rest)
    corners = box.vertices[box.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away = corners.mean(axis=1) - np.asarray(OBJECTS.position[0])
    assert (np.einsum("ij,ij->i", outward, away) > -1e-12).all()
    assert web.arrow_mesh(np.zeros(3), np.array([1e-3, 0.0, 0.0])) is None
    start, end = np.array([0.5, 0.1, 0.5]), np.array([0.6, 0.1, 0.5])
    np.testing.assert_allclose(web.arrow_mesh(start, end).vertices[:, 0].max(), 0.6, atol=1e-6)


def test_a_missing_library_is_reported_in_one_line(monkeypatch, tmp_path):
    save_recording(RECORDING, tmp_path / NAME)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'mechsearch-jax\[viewer\]'") as refused:
        cli.parse(["view", str(tmp_path)])()
    assert "\n" not in str(refused.value)


WRONG = {
    "no recording": ([], "recording.npz: there is none; search once more with --record"),
    "port": (["--port", "0"], "view: --port 0 is not between 1 and 65535"),
    "fps": (["--fps", "0"], "view: --fps 0 is not between 1 and 60"),
}


@pytest.mark.parametrize("case", WRONG, ids=list(WRONG))
def test_what_cannot_be_shown_is_refused_at_once(case, tmp_path):
    pytest.importorskip("viser")
    more, message = WRONG[case]
    with pytest.raises(InputError) as refused:
        cli.parse(["view", str(tmp_path), *more])()
    assert message in str(refused.value)


def pixel(browser, server, point):
    """Where a point in the world is in the browser's window."""
    (client,) = server.get_clients().values()
    camera = client.camera
    x, y, z = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix().T @ (point - camera.position)
    rectangle = "document.querySelector('canvas').getBoundingClientRect()"
    left, top, width, height = (browser.value(f"{rectangle}.{side}") for side in ("left", "top", "width", "height"))
    focal = height / 2 / np.tan(camera.fov / 2)
    return left + width / 2 + focal * x / z, top + height / 2 + focal * y / z


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_a_browser_shows_it(viewer, server, tmp_path):
    viewer.show(0)
    going = threading.Event()
    going.set()
    playing = threading.Thread(target=viewer.run, args=(going.is_set,))
    playing.start()
    text = "document.body.innerText"
    try:
        with page(CHROMIUM, f"http://127.0.0.1:{server.get_port()}/", tmp_path) as browser:
            wait_for(lambda: browser.value(f"{text}.includes('what the camera saw')"))
            assert "hidden: retrieved" in browser.value(text)
            # The arrow of the action that is farther goes on where the other ends.
            arrow = np.asarray(node(server, "/sampled/0/1").vertices)
            far = np.average([arrow[arrow[:, 1].argmin()], arrow[arrow[:, 1].argmax()]], axis=0, weights=(0.3, 0.7))
            wait_for(lambda: click(browser, server, far) or "cost 95" in viewer.text, pause=1.0)
            wait_for(lambda: browser.value(f"{text}.includes('cost 95')"))
            press = "[...document.querySelectorAll('button')].find(b => b.innerText.trim() == '{}').click()"
            browser.value(press.format("play"))
            wait_for(lambda: viewer.row > FPS * MOVES)
            browser.value(press.format("pause"))
            wait_for(lambda: not viewer.playing)
    finally:
        going.clear()
        playing.join(20)


def click(browser, server, point):
    x, y = pixel(browser, server, point)
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        browser.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
