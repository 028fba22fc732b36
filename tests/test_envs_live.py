"""A search that is shown while it runs: what is on the page, and that nothing of the search changes."""

import dataclasses
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recordings import OBJECTS, SEQUENCES
from stage import HIDDEN, OPEN, idle
from test_envs_viewer import free_port, node
from test_search import IMAGES, searcher_of, seen

from mechsearch_jax.envs.recording.recording import Recording
from mechsearch_jax.envs.recording.step_pictures import Painter
from mechsearch_jax.envs.recording.step_values import trouble
from mechsearch_jax.envs.world.world import TARGET, from_scenario
from mechsearch_jax.observation import Observation
from mechsearch_jax.planner import Decision
from mechsearch_jax.planner.trials import TrialResult, sequences_to_try


@pytest.fixture
def view():
    pytest.importorskip("viser", reason="the page needs viser: pip install 'mechsearch-jax[viewer]'")
    from mechsearch_jax.envs.viewer.live import LiveView

    with LiveView(port=free_port()) as shown:
        yield shown


class Noting:
    """A view that keeps what it is shown."""

    def __init__(self):
        self.shown, self.over = [], []

    def decided(self, step, tried):
        self.shown.append((step, tried))

    def acted(self, step, ok):
        self.over.append((step, ok))


def comparing(key, problem, belief, observation):
    """Chooses among two pushes, after trials."""
    objects = jax.tree.map(jnp.asarray, OBJECTS)
    sequences = jax.tree.map(jnp.asarray, SEQUENCES)
    return Decision(
        jax.tree.map(lambda a: a[0, 0], sequences.actions),
        sequences.value[0],
        jnp.float32(100.0),
        sequences.cost[0, 0],
        objects,
        sequences,
        alternatives=sequences_to_try(sequences, objects, jnp.float32(0.0)),
    )


def refusing(problem, scenes, actions, wanted):
    """Trials of which the first does harm, and all others succeed."""
    return np.where(np.arange(wanted.shape[1]) > 0, TrialResult.SUCCEEDED, TrialResult.HARMFUL)[None].astype(np.int32)


BOX = Observation(jax.tree.map(jnp.asarray, OBJECTS), jnp.array(False), jnp.zeros(3))


def test_a_page_says_so_until_there_is_a_decision_and_then_shows_it_at_once(problem, view, monkeypatch):
    from mechsearch_jax.envs.viewer import live

    waiting, asked, go_on = view._waiting, threading.Event(), threading.Event()
    assert "No decision yet" in waiting.content

    def slowly(step, tried):
        asked.set()
        assert go_on.wait(60)
        return recorded_step(step, tried)

    recorded_step = live.recorded_step
    monkeypatch.setattr(live, "recorded_step", slowly)
    searcher_of(problem, OPEN, view=view).next(IMAGES.depth, IMAGES.colour)
    assert asked.wait(60)
    assert node(view._server, "/robot/link7") is None
    go_on.set()
    view.wait()
    assert waiting._impl.removed
    # Nobody knows the true shapes.
    assert "off by" not in view.viewer.evidence
    assert "taken for" in view.viewer.evidence


def test_decisions_are_the_same_with_a_view_and_it_is_shown_each(problem):
    noting, steps = Noting(), []
    for view in (None, noting):
        searcher = searcher_of(problem, BOX, policy=comparing, trials=refusing, view=view)
        steps.append(searcher.next(IMAGES.depth))
    plain, shown = ((step.kind, step.reason, step.warnings, step.decision, step.belief) for step in steps)
    assert plain[:3] == shown[:3]
    jax.tree.map(np.testing.assert_array_equal, plain[3:], shown[3:])
    ((step, tried),) = noting.shown
    assert step is steps[1]
    # The arm cannot do the second, which succeeds in its trial.
    assert tried.result.tolist() == [TrialResult.HARMFUL, TrialResult.FAILED]


def test_the_page_shows_what_was_recognised_and_what_is_planned(problem, view):
    searcher = searcher_of(problem, OPEN, view=view)
    step = searcher.next(IMAGES.depth, IMAGES.colour)
    view.wait()
    server = view.viewer._server
    assert step.reason in view.viewer.text
    assert node(server, "/true/0") is None
    recognised = np.asarray(node(server, "/recognised/0/0").vertices)
    middle = (recognised.min(axis=0) + recognised.max(axis=0)) / 2
    np.testing.assert_allclose(middle, np.asarray(seen(OPEN).objects.position[0]), atol=2e-3)
    target = np.asarray(node(server, "/recognised/0/target").vertices)
    stands = np.asarray(from_scenario(OPEN).position[TARGET])
    np.testing.assert_allclose((target.min(axis=0) + target.max(axis=0)) / 2, stands, atol=1e-2)
    assert node(server, "/numbers/0").visible
    assert view.viewer.count == pytest.approx(15 * step.trajectory.time[-1], abs=2)
    assert "Searching: step 1" in view.viewer.ended
    searcher.acted(ok=False)
    view.wait()
    assert "Broken off" in view.viewer.ended
    searcher.next(IMAGES.depth, IMAGES.colour)
    searcher.acted()
    view.wait()
    assert "the target is out after 2 actions" in view.viewer.ended
    assert view.viewer.step_at(view.viewer.count - 1) == 1


@pytest.mark.slow
def test_every_look_is_a_step_of_its_own(problem, view):
    searcher = searcher_of(problem, HIDDEN, policy=idle, view=view)
    for _ in range(2):
        step = searcher.next(IMAGES.depth)
    view.wait()
    assert view.viewer.count == 2
    assert step.reason in view.viewer.text
    assert "2. nothing to be done" in view.viewer.text
    # Nobody knows where the target is: it has not fallen, and the map from above shows where it can be.
    recording = Recording("", problem.camera, problem.shelf, problem.target, tuple(view._steps))
    assert [trouble(recording, shown) for shown in recording.steps] == [None, None]
    assert "fell" not in view.viewer.text
    empty = dataclasses.replace(step.frame, existence=np.zeros_like(step.frame.existence))
    without_f = Painter(recording).believed(recording.steps[1], empty)
    assert np.mean((view.viewer.pictures["above"] != without_f).any(axis=-1)) > 0.01
    cells = node(view.viewer._server, "/map/1/cells").batched_positions
    assert len(cells) >= int(step.belief.exists.sum()) / problem.target.yaws


def test_what_cannot_be_drawn_does_not_stop_the_search(problem, view, monkeypatch, caplog):
    from mechsearch_jax.envs.viewer import live

    monkeypatch.setattr(live, "recorded_step", lambda step, tried: (_ for _ in ()).throw(RuntimeError("drawn wrong")))
    step = searcher_of(problem, OPEN, view=view).next(IMAGES.depth, IMAGES.colour)
    assert step.kind == "retrieve"
    with pytest.raises(RuntimeError, match="drawn wrong"):
        view.wait()
    assert "a step could not be shown" in caplog.text
