"""A search on a robot in the browser while it runs: what the `Searcher` believes, decides and plans to do.

    with LiveView() as view:
        searcher = ms.Searcher(workcell, view=view)
        print(view.url)
        ...

Nobody knows the true shapes there: what is shown is what was recognised, and the motion is the one that was planned.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import logging
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import numpy as np

from mechsearch_jax.envs.episode.endings import ending_words
from mechsearch_jax.envs.recording.body_solids import body_solids, moved
from mechsearch_jax.envs.recording.evidence import evidence_without_truth
from mechsearch_jax.envs.recording.playback import Playback
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording, empty_trace
from mechsearch_jax.envs.recording.sampled import sampled
from mechsearch_jax.envs.recording.step_pictures import Painter
from mechsearch_jax.envs.recording.step_values import Ending, recognised_shapes, step_values
from mechsearch_jax.envs.viewer.shown import ShownStep, card, shown_step
from mechsearch_jax.envs.viewer.stage import VISIBLE
from mechsearch_jax.envs.viewer.viewer import Viewer
from mechsearch_jax.envs.world.world import TARGET, World, outer_shape, with_target
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.planner.trials import TriedActions
from mechsearch_jax.robot.kinematics import HOME
from mechsearch_jax.session.step import SearchStep
from mechsearch_jax.shapes import in_order
from mechsearch_jax.viz import drawing, web
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

_LOG = logging.getLogger(__name__)
# What is recognised takes the place of the true shapes.
_LAYERS = (*(name for name in VISIBLE if name != "true"), "recognised")


class LiveView:
    """A `session.step.View` in the browser. Steps are drawn in a thread, so that the search need not wait.

    Attributes:
      url: address of the page.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8080, fps: int = 15):
        """Start the server.

        Args:
          host: address that is listened at; 0.0.0.0 is every one of this machine.
          port: of the page; the next free one where it is taken.
          fps: moments of a motion in a second.

        Raises:
          InputError: viser is not installed.
        """
        viser = web.import_viser()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(host, port, label="a search", verbose=False)
        shown = "localhost" if host in ("127.0.0.1", "0.0.0.0") else host
        self.url = f"http://{shown}:{self._server.get_port()}"
        begins = Ending(None, "No decision yet", "The first takes minutes where its programs have to be compiled.")
        self._waiting = self._server.gui.add_html(card(begins))
        self._fps = fps
        self._viewer: Viewer | None = None
        self._steps: list[RecordedStep] = []
        self._time = 0.0
        self._going = threading.Event()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="view")
        self._drawn: list[Future[None]] = []

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def decided(self, step: SearchStep, tried: TriedActions) -> None:
        """Show a step, and then its planned motion; see `session.step.View`."""
        self._submit(lambda: self._show(step, tried))

    def acted(self, step: SearchStep, ok: bool) -> None:
        """Show that the motion of a step is over."""
        self._submit(lambda: self._over(step, ok))

    def wait(self) -> None:
        """Wait until everything is shown.

        Raises what went wrong while it was drawn, if anything did.
        """
        for drawn in self._drawn:
            drawn.result()
        self._drawn.clear()

    def close(self) -> None:
        """Show the rest, and stop the server."""
        self._pool.shutdown()
        self._going.clear()
        self._server.stop()

    @property
    def viewer(self) -> Viewer | None:
        """The page; None before the first step is shown."""
        return self._viewer

    def _submit(self, draw: Callable[[], None]) -> None:
        drawn = self._pool.submit(_logged, draw)
        self._drawn = [*(d for d in self._drawn if not d.done() or d.exception()), drawn]

    def _show(self, step: SearchStep, tried: TriedActions) -> None:
        problem, recorded = step.problem, recorded_step(step, tried)
        steps = [*self._steps, recorded]
        shown = _shown(steps, step)
        played = planned(step, recorded.world, len(self._steps), self._time, self._fps)
        # What is drawn takes seconds, in which a page without a step would show an arm without joints.
        if self._viewer is None:
            self._waiting.remove()
            heading = "A search, as it runs: recognised shapes and planned motions"
            cell = problem.camera, problem.shelf
            self._viewer = Viewer(self._server, heading, *cell, self._fps, visible=_LAYERS)
            self._going.set()
            threading.Thread(target=self._viewer.run, args=(self._going.is_set,), daemon=True).start()
        first = self._viewer.count
        self._viewer.add([shown], played)
        self._steps, self._time = steps, float(played.time[-1]) + 1 / self._fps
        self._viewer.end(Ending(None, f"Searching: step {len(steps)}", step.reason))
        self._viewer.show(first)
        self._viewer.play(len(played.time) > 1)

    def _over(self, step: SearchStep, ok: bool) -> None:
        if self._viewer is None:
            return
        if not ok:
            how = Ending(None, "Broken off", f"The motion did not come to its end: {step.reason}")
        elif step.kind == "retrieve":
            how = Ending(True, ending_words(True, True, None, step.index + 1))
        else:
            how = Ending(None, f"Action {step.index + 1} is over", step.reason)
        self._viewer.end(how)


def _logged(draw: Callable[[], None]) -> None:
    """Draw, and write down what goes wrong; the search goes on."""
    try:
        draw()
    except Exception:
        _LOG.exception("view: a step could not be shown")
        raise


def recorded_step(step: SearchStep, tried: TriedActions) -> RecordedStep:
    """A step of a search on a robot as one of a recording, in which what was recognised stands for the truth.

    The pose of a target that is not found is NaN, and nothing moves.
    """
    frame, decision = step.frame, step.decision
    acts = step.trajectory is not None
    pose = np.full(3, np.nan, np.float32) if frame.target_pose is None else np.asarray(frame.target_pose, np.float32)
    return RecordedStep(
        title=frame.title,
        caption=frame.caption,
        found=frame.found,
        world=believed_world(frame.scene, pose, step.problem.target, step.problem.shelf),
        scene=frame.scene,
        after=frame.after,
        existence=frame.existence,
        graspability=frame.graspability,
        target_pose=pose,
        action=jax.tree.map(np.asarray, decision.action) if acts else None,
        trace=empty_trace(),
        sampled=sampled(decision.sequences),
        evidence=evidence_without_truth(step.problem, step.belief, step.observation, decision, tried),
    )


def believed_world(scene: Superquadrics, pose: np.ndarray, target: Target, shelf: Shelf) -> World:
    """The recognised objects and a target that is found as bodies; NumPy arrays.

    Args:
      scene: the objects.
      pose: x, y [m] and yaw [rad] of the target; NaN if it is not found.
      target, shelf: of the problem.
    """
    shapes = np.array([shape.exponents for shape in in_order()])
    kind = np.abs(np.asarray(scene.exponents)[:, None] - shapes).sum(axis=-1).argmin(axis=-1)
    x, y, yaw = np.nan_to_num(pose)
    cos, sin = np.cos(yaw), np.sin(yaw)
    stands = (
        outer_shape(target).code,
        target.half_size,
        (x, y, target.height(shelf)),
        ((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)),
        bool(np.isfinite(pose).all()),
    )
    objects = (kind, scene.size, scene.position, scene.rotation, scene.valid)
    whole = [np.concatenate([np.asarray(a), np.asarray(b)[None]]) for a, b in zip(objects, stands, strict=True)]
    world = World(*whole)  # pyright: ignore[reportArgumentType]
    return jax.tree.map(np.asarray, with_target(world, target))


def planned(step: SearchStep, world: World, i: int, begins: float, fps: int) -> Playback:
    """The planned motion of a step as evenly spaced moments, in which nothing but the arm moves.

    Args:
      step: of the search.
      world: what was recognised.
      i: index of the step among those that are shown.
      begins: time of the first moment [s].
      fps: moments in a second.
    """
    trajectory = step.trajectory
    if trajectory is None:
        time, q, opening = np.zeros(1), np.asarray(HOME, float)[None], np.zeros(1)
    else:
        time = np.append(np.arange(0.0, trajectory.time[-1], 1 / fps), trajectory.time[-1])
        q = np.stack([np.interp(time, trajectory.time, joint) for joint in trajectory.position.T], axis=1)
        opening = np.interp(time, trajectory.time, trajectory.width)
    position, rotation = (np.repeat(np.asarray(a, float)[None], len(time), 0) for a in (world.position, world.rotation))
    return Playback(np.full(len(time), i), begins + time, q, opening, position, rotation)


def _shown(steps: Sequence[RecordedStep], step: SearchStep) -> ShownStep:
    """What is shown of the last step."""
    problem, recorded = step.problem, steps[-1]
    recording = Recording("", problem.camera, problem.shelf, problem.target, tuple(steps))
    values = step_values(recording, len(steps) - 1)
    heading = values.heading if step.trajectory is not None else "nothing to be done"
    shapes = recognised_shapes(recorded)
    values = dataclasses.replace(values, heading=heading, warnings=step.warnings, shapes=shapes)
    shown = shown_step(recording, len(steps) - 1, step.frame, Painter(recording), values, step.reason)
    if recorded.world.valid[TARGET]:
        pose = (np.asarray(a[TARGET]) for a in (recorded.world.rotation, recorded.world.position))
        solids = [moved(solid, *pose) for solid in body_solids(recorded.world)[TARGET]]
        shown.recognised.append(("target", web.mesh_of(solids), drawing.TARGET, 0.8))
    return shown
