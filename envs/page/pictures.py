"""The pictures of an episode's page: what the camera saw, and the shelf from above."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib import patches
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import Rotation

from mechsearch_jax.actions import Action, kind_of
from mechsearch_jax.envs.camera.snapshot import Snapshot, objects_on_the_board, true_target_pose
from mechsearch_jax.envs.episode.episode_log import target_trouble
from mechsearch_jax.envs.recording.pictures import colour_image
from mechsearch_jax.envs.recording.recording import RecordedStep, Recording
from mechsearch_jax.envs.recording.sampled import Sampled
from mechsearch_jax.envs.recording.shown_decisions import sampled_sketch
from mechsearch_jax.envs.world.world import TARGET, World, superquadrics
from mechsearch_jax.geometry.superquadric import Superquadrics
from mechsearch_jax.viz import drawing, sketches
from mechsearch_jax.viz.blockers import Moment, draw_seen_blockers, mark_from_above
from mechsearch_jax.viz.filmstrip import Frame, draw_seen
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

# Width of a picture [inches], dots per inch, and the quality of WebP.
WIDTH, DPI, QUALITY = 3.6, 190, 80
# Confidence from which a shape is sure, and below which it is doubtful.
SURE, DOUBTFUL = 0.8, 0.5
# Colours of candidate poses that were ruled out or opened again since the step before.
RULED_OUT, REOPENED = "#9aa5ae", drawing.ACTION


Picture = UInt8[np.ndarray, "h w 3"]


class End(NamedTuple):
    """How the shelf looks at the end.

    Attributes:
      seen, above: in the camera's view and from above.
      stands: whether the target still stands on the board.
      lies: whether it lies there.
      shows: whether the camera sees some of the target.
      blockers: the objects on the board that are marked as in its way.
    """

    seen: Picture
    above: Picture
    stands: bool
    lies: bool
    shows: bool
    blockers: tuple[int, ...]


class Painter:
    """Draws the pictures of one recording at one scale.

    Attributes:
      room: height of what is shown above the board [m].
    """

    def __init__(self, recording: Recording):
        """Args:
        recording: of the episode.
        """
        self._recording = recording
        self._camera: Camera = recording.camera
        self._shelf: Shelf = recording.shelf
        self._target: Target = recording.target
        scenes = [scene for step in recording.steps for scene in (step.scene, step.after)]
        self.room = drawing.height_of(scenes, recording.shelf)

    def seen(self, frame: Frame) -> Picture:
        """What the camera saw at a step, with the action."""
        camera, shelf = self._camera, self._shelf
        return self._view(lambda axes: draw_seen(axes, frame, camera, shelf, self._target, self.room))

    def recognised(self, step: RecordedStep, frame: Frame, confidence: Float[np.ndarray, " n"]) -> Picture:
        """The outlines of the recognised shapes over what the camera saw, coloured by how sure recognition is."""

        def draw(axes: Axes) -> None:
            drawing.draw_view(axes, frame.image, self._camera, self._shelf, self.room)
            for i, outline in enumerate(drawing.outlines_in_view(step.scene, self._camera)):
                if outline is None:
                    continue
                sure = float(confidence[i])
                style = {"facecolor": "none", "edgecolor": colour_of(sure), "linewidth": 1.6}
                axes.add_patch(patches.Polygon(outline, closed=True, **style))
                x, y = outline.mean(axis=0)
                text = drawing.number(axes, (float(x), float(y)), i)
                # More would cover what it is about.
                if sure < SURE:
                    text.set_text(f"{i}: {100 * sure:.0f} %")

        return self._view(draw)

    def believed(
        self, step: RecordedStep, frame: Frame, before: RecordedStep | None, blockers: Collection[int]
    ) -> Picture:
        """f and g from above, what changed since the step before, the objects, the target's true pose, the action."""
        lost, lies = self._lost(step.world), self._lies(step.world)

        def draw(axes: Axes) -> None:
            if lost:
                drawing.draw_shelf(axes, self._shelf)
                drawing.draw_objects(axes, step.scene)
                if lies:
                    draw_lying(axes, step.world)
                return
            self._map(axes, step, step.existence, step.graspability, step.scene)
            if before is not None and not (step.found or before.found):
                self._changes(axes, before.existence, step.existence)
            mark_from_above(axes, step.scene, blockers)
            flat = sketches.from_above
            _draw_tried_grasp(axes, step)
            sketches.draw_action(axes, flat, frame.sketch, step.scene, step.after, self._shelf)
            if is_known(step.target_pose):
                sketches.draw_taken_target(axes, flat, frame.sketch, step.target_pose, self._target, self._shelf)

        return self._above(draw)

    def foreseen(self, step: RecordedStep, k: int) -> Picture:
        """f and g from above as predicted after a candidate, the objects there, and the action."""
        candidates: Sampled = step.sampled
        after = candidates.after(k, step.scene)

        def draw(axes: Axes) -> None:
            forecasts = None if step.evidence is None else step.evidence.forecasts
            row = None if forecasts is None else forecasts.of(k)
            if forecasts is not None and row is not None:
                self._map(axes, step, forecasts.existence[row], forecasts.graspability[row], after)
            else:
                self._map(axes, step, np.zeros_like(step.existence), step.graspability, after)
            sketch = sampled_sketch(step, k)
            sketches.draw_action(axes, sketches.from_above, sketch, step.scene, after, self._shelf)

        return self._above(draw)

    def end(self, blocking: Collection[int]) -> End:
        """The true state at the end in the camera's view and from above, with the objects in the way marked.

        Args:
          blocking: indices of the objects in the way; those that are no longer on the board are not marked.
        """
        world = last_world(self._recording.steps[-1])
        scene = objects_of(world, self._camera, self._shelf)
        position, rotation = (np.asarray(a)[TARGET] for a in (world.position, world.rotation))
        episode, alike = self._recording.episode, self._target.solid.ends_alike
        upright = target_trouble(self._shelf, position, rotation, alike) is None
        taken = episode is not None and episode.retrieved
        stands, lies = upright and not taken, self._lies(world)
        pose = np.asarray(true_target_pose(jax.tree.map(jnp.asarray, world))) if stands else None
        blockers = tuple(i for i in blocking if scene.valid[i])
        image = Snapshot(self._camera, self._shelf, jax.tree.map(jnp.asarray, world)).image
        owner, somewhere = np.asarray(image.segmentation), np.zeros(3) if pose is None else pose
        moment = Moment("", colour_image(image), owner, scene, somewhere, blockers)

        def seen(axes: Axes) -> None:
            draw_seen_blockers(axes, moment, self._camera, self._shelf, self.room)
            if pose is not None:
                drawing.draw_hidden_target_in_view(axes, pose, self._target, self._camera, self._shelf)

        def above(axes: Axes) -> None:
            drawing.draw_shelf(axes, self._shelf)
            drawing.draw_objects(axes, scene)
            if pose is not None:
                drawing.draw_target(axes, pose, self._target, certain=True)
                _draw_tried_grasp(axes, self._recording.steps[-1])
            if lies:
                draw_lying(axes, world)
            mark_from_above(axes, scene, blockers)

        shows = bool((owner == TARGET).any())
        return End(self._view(seen), self._above(above), stands, lies, shows, blockers)

    def _lost(self, world: World) -> bool:
        """Whether the target lies, or has left the board, without being taken out."""
        if self._recording.episode is not None and self._recording.episode.retrieved:
            return False
        position, rotation = (np.asarray(a)[TARGET] for a in (world.position, world.rotation))
        return target_trouble(self._shelf, position, rotation, self._target.solid.ends_alike) is not None

    def _lies(self, world: World) -> bool:
        """Whether it lies on the board."""
        x, _, z = np.asarray(world.position)[TARGET]
        return self._lost(world) and bool(x >= self._shelf.front and z >= self._shelf.board)

    def _map(
        self,
        axes: Axes,
        step: RecordedStep,
        existence: Bool[np.ndarray, " x"],
        graspability: np.ndarray,
        scene: Superquadrics,
    ) -> None:
        drawing.draw_shelf(axes, self._shelf)
        drawing.draw_map(axes, drawing.map_image(existence, graspability, self._target), self._shelf, self._target)
        drawing.draw_objects(axes, scene)
        if is_known(step.target_pose):
            drawing.draw_target(axes, step.target_pose, self._target, step.found)

    def _changes(self, axes: Axes, before: Bool[np.ndarray, " x"], now: Bool[np.ndarray, " x"]) -> None:
        """Mark the cells in which the target could be before and no more, or the other way round."""
        rows, columns = self._target.grid
        places = self._target.candidate_poses(self._shelf).reshape(rows * columns, -1, 3)[:, 0, :2]
        gone, opened = changed_cells(self._target, before, now)
        for cells, colour, mark in ((gone, RULED_OUT, "x"), (opened, REOPENED, "+")):
            x, y = places[cells].T
            axes.scatter(y, x, s=11, c=colour, marker=mark, linewidths=1.0, zorder=2)

    def _view(self, draw: Callable[[Axes], None]) -> Picture:
        left, right, top, bottom = drawing.view_window(self._camera, self._shelf, self.room)
        return _drawn((bottom - top) / (right - left), draw)

    def _above(self, draw: Callable[[Axes], None]) -> Picture:
        return _drawn(drawing.map_share(self._shelf), draw)


def draw_lying(axes: Axes, world: World) -> None:
    """Draw the target from above as it lies."""
    bodies = jax.tree.map(np.asarray, superquadrics(jax.tree.map(jnp.asarray, world)))
    outline = drawing.outlines(bodies.replace(valid=np.arange(len(bodies.valid)) == TARGET))[TARGET]
    assert outline is not None
    style = {"facecolor": drawing.TARGET, "edgecolor": drawing.TARGET, "linewidth": 1.6, "zorder": 5}
    lying = patches.Polygon(outline[:, ::-1], closed=True, **style)
    lying.set_path_effects(drawing.halo(1.6))
    axes.add_patch(lying)


def changed_cells(
    target: Target, before: Bool[np.ndarray, " x"], now: Bool[np.ndarray, " x"]
) -> tuple[Bool[np.ndarray, " cells"], Bool[np.ndarray, " cells"]]:
    """The cells of the grid in which the target could be before and no more, and those opened again."""
    rows, columns = target.grid
    was, stays = (a.reshape(rows * columns, -1).any(axis=-1) for a in (before, now))
    return np.asarray(was & ~stays), np.asarray(stays & ~was)


def colour_of(sure: float) -> str:
    """The colour of a recognised shape by how sure recognition is; blue where nothing says so."""
    return drawing.TARGET if sure < DOUBTFUL else drawing.WARNING if sure < SURE else drawing.ACTION


def tried_grasp(step: RecordedStep) -> Action | None:
    """The first grasp of the target that was tried out at a step without an action; None without one.

    Beside the hand of an action it would be hard to see.
    """
    if step.evidence is None or step.action is not None:
        return None
    tried = step.evidence.tried.action
    rows = [k for k, kind in enumerate(np.asarray(tried.kind).tolist()) if kind_of(kind).takes_target]
    return jax.tree.map(lambda a: a[rows[0]], tried) if rows else None


def _draw_tried_grasp(axes: Axes, step: RecordedStep) -> None:
    grasp = tried_grasp(step)
    if grasp is not None:
        T = np.asarray(grasp.T_world_gripper, float)
        sketches.draw_grasp(axes, sketches.from_above, T, float(grasp.opening), drawing.INK)


def is_known(target_pose: Float[np.ndarray, " 3"]) -> bool:
    """Whether a target's pose is known to whoever draws it."""
    return bool(np.isfinite(target_pose).all())


def hidden_behind(step: RecordedStep, camera: Camera, shelf: Shelf) -> list[tuple[int, float]]:
    """The objects that hide the target from the camera, the greatest share of its pixels first, with that share."""
    world = jax.tree.map(jnp.asarray, step.world)
    alone = world.replace(valid=jnp.arange(len(world.valid)) == TARGET)
    there = np.asarray(Snapshot(camera, shelf, alone).image.segmentation) == TARGET
    owner = np.asarray(Snapshot(camera, shelf, world).image.segmentation)[there]
    counts = np.bincount(owner[(owner >= 0) & (owner < TARGET)], minlength=TARGET)
    return [(int(i), float(counts[i]) / len(owner)) for i in np.argsort(-counts, kind="stable") if counts[i]]


def target_pixels(step: RecordedStep, camera: Camera, shelf: Shelf) -> int:
    """The number of pixels that the target shows at a step."""
    world = jax.tree.map(jnp.asarray, step.world)
    return int(np.count_nonzero(np.asarray(Snapshot(camera, shelf, world).image.segmentation) == TARGET))


def last_world(step: RecordedStep) -> World:
    """The true state after the step's action, or at the step if there was none."""
    if not len(step.trace.time):
        return step.world
    rotation = Rotation.from_quat(np.asarray(step.trace.quaternion[-1]), scalar_first=True).as_matrix()
    return step.world.replace(
        position=np.asarray(step.trace.position[-1], np.float32), rotation=rotation.astype(np.float32)
    )


def objects_of(world: World, camera: Camera, shelf: Shelf) -> Superquadrics:
    """The true objects of a state that are on the board; NumPy arrays."""
    snapshot = Snapshot(camera, shelf, jax.tree.map(jnp.asarray, world))
    return jax.tree.map(np.asarray, objects_on_the_board(snapshot))


def data_uri(picture: Picture) -> str:
    """A picture as WebP in a data URI."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="WEBP", quality=QUALITY, method=5)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"


def _drawn(share: float, draw: Callable[[Axes], None]) -> Picture:
    """A picture whose height is a share of its width."""
    figure = Figure(figsize=(WIDTH, WIDTH * share), dpi=DPI, facecolor=drawing.PAPER)
    canvas = FigureCanvasAgg(figure)
    draw(figure.add_axes((0.0, 0.0, 1.0, 1.0)))
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
