"""The page of an episode: what is built of a recording, what the time line moves, and that a browser shows it."""

import shutil
import socket
import threading

import numpy as np
import pytest
from browser import page, wait_for
from recordings import LOST, MOVES, OBJECTS, RECORDING, SAMPLED, WORLD
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.world.world import TARGET
from mechsearch_jax.viz import drawing

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
