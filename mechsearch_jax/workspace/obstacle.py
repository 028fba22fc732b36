"""What stands in a cell beside the shelf and the objects on it: boxes and cylinders that the arm keeps clear of."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np

from mechsearch_jax.runtime.errors import InputError, check_range
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.shapes.meshes import box_around
from mechsearch_jax.workspace.camera import Camera, check_rotation
from mechsearch_jax.workspace.scenario import SCALES
from mechsearch_jax.workspace.shelf import Shelf

# Largest coordinate of an obstacle, and smallest and largest of its measures [m].
FARTHEST, SIZES = 10.0, (1e-3, 10.0)
# Name of the camera's body, which no other obstacle may have.
CAMERA = "camera"
# The body of a typical depth camera (D435, D455), whose optical centre is off its middle [m].
CAMERA_BODY = (0.13, 0.05, 0.05)
_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclasses.dataclass(frozen=True)
class Obstacle:
    """A body that the arm, the hand and what it holds must not touch; hashable. Frame: the robot's base.

    Attributes:
      name: how messages and reports call it.
      size: along its own x, y and z; of a cylinder, whose axis is z, its diameter twice and its height [m].
      position: of its centre [m].
      rotation: rows of its orientation, whose columns are its axes.
      shape: box or cylinder.
    """

    name: str
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    rotation: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]] = _AXES
    shape: Literal["box", "cylinder"] = "box"

    def __post_init__(self):
        if not self.name or not self.name.isprintable():
            raise InputError("Obstacle: name must be a word or two, by which messages call it")
        for axis, size, place in zip("xyz", self.size, self.position, strict=True):
            check_range(f"Obstacle: size {axis}", size, *SIZES, "m")
            check_range(f"Obstacle: position {axis}", place, -FARTHEST, FARTHEST, "m")
        check_rotation("Obstacle", self.rotation)
        if self.shape not in ("box", "cylinder"):
            raise InputError(f'Obstacle: shape {self.shape!r} is unknown; use "box" or "cylinder"')
        if self.shape == "cylinder" and self.size[0] != self.size[1]:
            raise InputError(
                f"Obstacle: size {list(self.size)} of a cylinder must be its diameter, the same once more, and its "
                "height along z"
            )

    @classmethod
    def of_mesh(
        cls,
        name: str,
        mesh: PathLike,
        scale: float = 1.0,
        position: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rotation: tuple[tuple[float, float, float], ...] = _AXES,
    ) -> Obstacle:
        """The smallest box around a mesh (OBJ, STL or PLY), turned as it may be.

        Args:
          name: of the obstacle.
          mesh: its file.
          scale: metres per unit of the mesh.
          position, rotation: pose of the mesh's own frame.

        Raises:
          InputError: the mesh cannot be read, or is no body.
        """
        check_range("Obstacle: scale", scale, *SCALES, "metres per unit of the mesh")
        check_rotation("Obstacle", rotation)
        R, centre, size = box_around(Path(mesh), scale, "Obstacle: mesh")
        turned = np.array(rotation, float)
        rows, place = turned @ R, turned @ centre + np.array(position, float)
        x, y, z = (tuple(map(float, row)) for row in rows)
        # A flat mesh is a thin box.
        sizes = np.maximum(size, SIZES[0]).tolist()
        return cls(name, tuple(sizes), tuple(place.tolist()), (x, y, z))  # pyright: ignore[reportArgumentType]

    def moved(self, shift: tuple[float, float, float]) -> Obstacle:
        """The same body elsewhere, by a translation [m]."""
        x, y, z = (a + b for a, b in zip(self.position, shift, strict=True))
        return dataclasses.replace(self, position=(x, y, z))


def camera_body(camera: Camera, shelf: Shelf, size: tuple[float, float, float]) -> tuple[Obstacle, ...]:
    """The body of a camera as an obstacle around its pose, of a size along its x, y and z [m].

    None where the size is 0, where the camera is in the shelf, whose free space is the objects' alone, and at the
    default pose, where the camera is simulated and no body: the arm would meet it.
    """
    x, y, z = camera.position
    if (camera.position, camera.rotation) == (Camera().position, Camera().rotation):
        return ()
    inside = shelf.front < x < shelf.back and shelf.right < y < shelf.left and shelf.board < z < shelf.ceiling
    return () if inside or not any(size) else (Obstacle(CAMERA, size, camera.position, camera.rotation),)  # pyright: ignore[reportArgumentType]
