"""The shelf, the robot and what is believed, as nodes of the viewer's scene."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.recording.body_solids import body_solids
from mechsearch_jax.envs.recording.film import shelf_solids
from mechsearch_jax.envs.recording.playback import Playback
from mechsearch_jax.envs.recording.shown_decisions import Ghost
from mechsearch_jax.envs.viewer.shown import ShownStep
from mechsearch_jax.envs.world.world import TARGET, World
from mechsearch_jax.robot.arm_clearance import link_poses
from mechsearch_jax.viz import drawing, sketches, web
from mechsearch_jax.viz.panda import panda_pieces
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import MAX_OBJECTS
from mechsearch_jax.workspace.shelf import Shelf

if TYPE_CHECKING:
    import viser

# Where whoever looks on stands and looks at, from the middle of the opening's lower edge [m]: so high that f and g lie
# open behind the objects.
STANDS, LOOKS_AT = np.array([-0.44, 0.74, 1.08]), np.array([0.02, 0.02, 0.03])
# Length of an arrow's head, and radius of its shaft [m].
HEAD, SHAFT = 0.03, 0.004
# Intensities of the lights.
AMBIENT_LIGHT, LIGHT_ABOVE = 1.4, 1.6
# Layers that can be hidden, and their labels; and those that are shown at first.
LAYERS = {
    "robot": "robot",
    "true": "true shapes",
    "numbers": "numbers",
    "recognised": "recognised",
    "blocked": "in the way",
    "map": "f and g",
    "action": "prediction",
    "sampled": "samples",
    "camera": "camera",
}
VISIBLE = ("robot", "true", "numbers", "blocked", "map", "action", "sampled")
# Layers, beside the prediction, whose nodes are of one step each.
_OF_STEPS = ("recognised", "blocked", "map", "sampled")


class Pose(NamedTuple):
    """Poses of a node, one for each row.

    Attributes:
      position: [m], shape (rows, 3).
      wxyz: unit quaternions, shape (rows, 4).
    """

    position: Float[np.ndarray, "rows 3"]
    wxyz: Float[np.ndarray, "rows 4"]

    @classmethod
    def of(cls, position: Float[np.ndarray, "rows 3"], rotation: Float[np.ndarray, "rows 3 3"]) -> Pose:
        return cls(position, Rotation.from_matrix(rotation).as_quat(scalar_first=True))


class Stage:
    """The scene of a search.

    Attributes:
      layers: the parent of the nodes of each layer, by its name.
    """

    def __init__(self, server: viser.ViserServer, camera: Camera, shelf: Shelf, visible: Collection[str]):
        """Args:
        server: shows the page.
        camera, shelf: of the problem.
        visible: the layers that are shown at first.
        """
        self._server, self._visible = server, visible
        self.layers = self._still(camera, shelf)
        self._robot = self._robot_nodes()
        self._numbers = [self._number(i) for i in range(MAX_OBJECTS)]

    def _still(self, camera: Camera, shelf: Shelf) -> dict[str, Any]:
        """Show light, shelf and camera; the parents of the layers."""
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        # The usual lights are so bright that colours fade.
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/lights/everywhere", intensity=AMBIENT_LIGHT)
        scene.add_light_directional("/lights/above", intensity=LIGHT_ABOVE, position=(-0.6, 0.8, 1.5))
        edge = np.array([shelf.front, (shelf.left + shelf.right) / 2, shelf.board])
        self._server.initial_camera.position = edge + STANDS
        self._server.initial_camera.look_at = edge + LOOKS_AT
        layers = {name: scene.add_frame(f"/{name}", show_axes=False, visible=name in self._visible) for name in LAYERS}
        for name, board in shelf_solids(shelf).items():
            self._mesh(f"/shelf/{name}", web.mesh_of([board]), board.colour)
        _frustum(scene, camera)
        return layers

    def _robot_nodes(self) -> list[Any]:
        """The robot's nodes: links, hand, and fingers."""
        *pieces, foot = panda_pieces()
        self._mesh("/robot/foot", web.mesh_of(foot), foot[0].colour)
        names = [*(f"/robot/link{i}" for i in range(1, 8)), "/robot/hand", "/robot/left", "/robot/right"]
        return [
            self._mesh(name, web.mesh_of(solids), solids[0].colour) for name, solids in zip(names, pieces, strict=True)
        ]

    def robot_poses(self, played: Playback) -> dict[str, tuple[Any, Pose]]:
        """The robot's nodes with poses; the fingers move along the hand's second axis."""
        poses, half = link_poses(played.q), played.opening[:, None] / 2
        hand = poses[:, 7]
        shift = hand[:, :3, 1] * half
        moved = [(poses[:, i, :3, 3], poses[:, i, :3, :3]) for i in range(8)]
        moved += [(hand[:, :3, 3] + side * shift, hand[:, :3, :3]) for side in (1, -1)]
        return {node.name: (node, Pose.of(*pose)) for node, pose in zip(self._robot, moved, strict=True)}

    def _number(self, i: int) -> Any:
        """The number of an object, hidden."""
        label = self._server.scene.add_label(f"/numbers/{i}", str(i), anchor="bottom-center", font_screen_scale=0.9)
        label.visible = False
        return label

    def place_numbers(self, played: Playback, row: int, world: World) -> None:
        """Put the numbers on top of the objects of a world at a moment that is played."""
        for i, label in enumerate(self._numbers):
            label.visible = bool(world.valid[i])
            top = np.abs(played.rotation[row, i, 2]) @ np.asarray(world.half_size[i], float)
            label.position = played.position[row, i] + np.array([0.0, 0.0, top])

    def bodies(self, world: World, played: Playback) -> dict[str, tuple[Any, Pose]]:
        """Show the true bodies of a world; their nodes, with their poses as they are played."""
        nodes: dict[str, tuple[Any, Pose]] = {}
        for i, solids in body_solids(world).items():
            mesh = web.mesh_of(solids)
            name = f"/true/{'target' if i == TARGET else i}"
            pose = Pose.of(played.position[:, i], played.rotation[:, i])
            nodes[name] = self._mesh(name, mesh, solids[0].colour), pose
        return nodes

    def decision(self, i: int, shown: ShownStep, examine: Callable[[int], None]) -> list[Any]:
        """Send the geometry of a step, hidden, so that little is left to be sent when the step begins.

        Args:
          i: index of the step.
          shown: what is shown of it.
          examine: called with the index of a sampled action whose arrow is clicked.

        Returns:
          The parents of the geometry, the last of which shows what was decided.
        """
        scene, decision = self._server.scene, shown.decision
        frames = [scene.add_frame(f"/{name}/{i}", show_axes=False, visible=False) for name in _OF_STEPS]
        for layer, ghosts in (("recognised", shown.recognised), ("blocked", shown.blocked)):
            for ghost in ghosts:
                self._ghost(f"/{layer}/{i}", *ghost)
        if len(decision.cells.position):
            _map(scene, f"/map/{i}/cells", decision.cells)
        for k, sample in enumerate(decision.samples):
            if sample.arrow is not None:
                node = self._mesh(f"/sampled/{i}/{k}", sample.arrow, sample.colour, 0.9)
                node.on_click(lambda event, k=k: examine(k))
        return [*frames, self.prediction(str(i), decision.ghosts, decision.path)]

    def prediction(self, name: str, ghosts: list[Ghost], path: Float[np.ndarray, "points 3"] | None) -> Any:
        """Send the predicted effect of an action, hidden."""
        frame = self._server.scene.add_frame(f"/action/{name}", show_axes=False, visible=False)
        for ghost in ghosts:
            self._ghost(f"/action/{name}", *ghost)
        if path is not None:
            _arrow(self._server.scene, f"/action/{name}", path)
        return frame

    def _ghost(self, parent: str, name: str, mesh: web.Mesh, colour: str, opacity: float) -> Any:
        return self._mesh(f"{parent}/{name}", mesh, tuple(drawing.rgb(colour)), opacity)

    def _mesh(self, name: str, mesh: web.Mesh, colour: tuple[float, ...], opacity: float | None = None) -> Any:
        red, green, blue = (round(255 * c) for c in colour)
        return self._server.scene.add_mesh_simple(
            name, mesh.vertices, mesh.faces, color=(red, green, blue), opacity=opacity, flat_shading=opacity is None,
            cast_shadow=opacity is None, side="double",
        )  # fmt: skip


def _map(scene: Any, name: str, cells: web.Cells) -> None:
    """f and g on the board."""
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(cells.position), 1))
    scene.add_batched_meshes_simple(
        name, *cells.mesh, level, cells.position, batched_colors=cells.colour,
        batched_opacities=cells.opacity, side="double", cast_shadow=False, receive_shadow=False,
    )  # fmt: skip


def _arrow(scene: Any, parent: str, path: Float[np.ndarray, "points 3"]) -> None:
    """A line along a path with an arrow at its end; nothing for a path that is too short to be seen."""
    back = np.linalg.norm(path - path[-1], axis=1)
    if back[0] <= sketches.SHORTEST:
        return
    # The head begins where the path comes near its end for the last time.
    first = int(np.flatnonzero(back >= min(HEAD, back.max()))[-1])
    tail = path[[first, -1]]
    colour = tuple(round(255 * c) for c in drawing.rgb(drawing.ACTION))
    style = {"shaft_radius": SHAFT, "head_radius": 3 * SHAFT, "head_length": min(HEAD, 0.8 * float(back[first]))}
    scene.add_arrows(f"{parent}/arrow", tail[None], colour, **style)
    if first > 0:
        points = np.stack([path[:first], path[1 : first + 1]], axis=1)
        scene.add_line_segments(f"{parent}/path", points, colour, thickness=2 * SHAFT)


def _frustum(scene: Any, camera: Camera) -> None:
    """The frustum of the camera that looks at the shelf."""
    wxyz = Rotation.from_matrix(np.array(camera.rotation)).as_quat(scalar_first=True)
    angle = 2 * float(np.arctan(camera.height / 2 / camera.fy))
    scene.add_camera_frustum(
        "/camera/frustum", angle, camera.width / camera.height, scale=0.12, wxyz=wxyz, position=camera.position
    )
