"""Fit the shelf's inner faces to a depth image: how the camera must be moved for what it sees to lie on them.

First the rotation, from the normals of flat patches; then the place of each face along its normal, the outermost plane
with many patches, for objects stand in front of the faces; then all six numbers at once by least squares from the
points to the planes, with Tukey's weights (Y. Chen and G. Medioni, 1992). The motion, which turns about the middle of
the board, has no part in directions that the faces in sight do not determine, such as sliding along a board without
walls.

On the host, in float64; milliseconds.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mechsearch_jax.images.camera_pose import with_pose
from mechsearch_jax.images.cloud import middle
from mechsearch_jax.workspace.camera import Camera, measured
from mechsearch_jax.workspace.shelf import Shelf

# Side of a block in pixels of the thinned image.
SIDE = 8
# Least share of a block's pixels with a depth.
LEAST_MEASURED = 0.2
# A pixel counts that is off by at most so many standard deviations of its block, by their median, and this [m]; at
# least this share of a block's measured pixels must count.
NEAR, LEAST_NEAR, LEAST_COUNTED = 4.0, 0.0005, 0.75
# A block is flat if its depth deviates from a plane by at most so many times the median of all blocks, and this [m].
FLATNESS, LEAST_DEVIATION = 2.0, 0.0005


class Patches(NamedTuple):
    """N flat patches in the camera's frame.

    Attributes:
      point: the middle of each, on its plane [m].
      normal: unit vectors towards the camera.
      pixels: how many of the image's pixels each stands for.
    """

    point: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    pixels: Float[np.ndarray, " n"]


def flat_patches(camera: Camera, depth: Float[np.ndarray, "h w"], most: int) -> Patches:
    """The flat patches of a depth image.

    Args:
      camera: of the image.
      depth: along the camera's axis [m].
      most: the image is thinned to at most about so many pixels.
    """
    stride = max(1, round(math.sqrt(depth.size / most)))
    thin = np.asarray(depth[::stride, ::stride])
    rows, columns = (size // SIDE for size in thin.shape)
    blocks = thin[: rows * SIDE, : columns * SIDE].reshape(rows, SIDE, columns, SIDE).swapaxes(1, 2)
    blocks = blocks.reshape(rows * columns, SIDE**2)
    is_measured = np.isfinite(blocks) & measured(blocks)
    enough = is_measured.sum(axis=1) >= max(LEAST_MEASURED * SIDE**2, 4)
    blocks, is_measured = blocks[enough], is_measured[enough]
    # The middle of each block in the image, at unit depth.
    place = (np.arange(rows), np.arange(columns))
    down, across = ((p * SIDE + (SIDE - 1) / 2.0) * stride + 0.5 for p in place)
    down, across = np.meshgrid((down - camera.cy) / camera.fy, (across - camera.cx) / camera.fx, indexing="ij")
    middle = np.stack([across.ravel(), down.ravel()], axis=1)[enough]
    # The pixels of all blocks lie alike around their middles.
    offset = (np.arange(SIDE) - (SIDE - 1) / 2.0) * stride
    v, u = np.meshgrid(offset / camera.fy, offset / camera.fx, indexing="ij")
    basis = np.stack([u.ravel(), v.ravel(), np.ones(SIDE**2)], axis=1)
    inverse = np.where(is_measured, 1.0 / np.where(is_measured, blocks, 1.0), np.nan)
    slopes = _plane_of_medians(inverse, v, u)
    off = np.abs(inverse - slopes @ basis.T) / np.maximum(slopes[:, 2:], 1e-6) ** 2
    counted = off <= NEAR * 1.4826 * _median(off) + LEAST_NEAR
    enough = counted.sum(axis=1) >= LEAST_COUNTED * is_measured.sum(axis=1)
    weight, inverse = counted.astype(float), np.where(counted, inverse, 0.0)
    products = (basis[:, :, None] * basis[:, None, :]).reshape(SIDE**2, 9)
    matrix, right = (weight @ products).reshape(-1, 3, 3), inverse @ basis
    # A block whose pixels lie on a line has no plane.
    solid = enough & (np.linalg.cond(matrix * np.outer(*[1.0 / np.sqrt(np.diag(basis.T @ basis))] * 2)) < 1e4)
    slopes = np.zeros_like(right)
    slopes[solid] = np.linalg.solve(matrix[solid], right[solid][..., None])[..., 0]
    return _flat(middle, slopes, inverse, weight, basis, solid, stride)


def _median(values: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n 1"]:
    """The lower median of each row's finite values; NaN without any."""
    middle = np.maximum(np.isfinite(values).sum(axis=1, keepdims=True) - 1, 0) // 2
    # NaN is sorted last.
    return np.take_along_axis(np.sort(values, axis=1), middle, axis=1)


def _plane_of_medians(
    inverse: Float[np.ndarray, "n p"], v: Float[np.ndarray, "s s"], u: Float[np.ndarray, "s s"]
) -> Float[np.ndarray, "n 3"]:
    """Slopes of blocks' inverse depths along u and v, and those at their middles, by the medians of differences.

    Args:
      inverse: depth of the pixels, NaN where not measured.
      v, u: of the pixels at unit depth.
    """
    square = inverse.reshape(-1, SIDE, SIDE)

    def slope(along: Float[np.ndarray, "n s s"], at: Float[np.ndarray, " s"]) -> Float[np.ndarray, "n 1"]:
        # Two distances, for a sensor may measure every second or third row or column only.
        parts = [(along[:, by:] - along[:, :-by]) / (at[by] - at[0]) for by in (SIDE // 2 - 1, SIDE // 2)]
        return np.nan_to_num(_median(np.concatenate(parts, axis=1).reshape(len(along), (SIDE + 1) * SIDE)))

    across, down = slope(square.swapaxes(1, 2), u[0]), slope(square, v[:, 0])
    return np.hstack([across, down, _median(inverse - across * u.ravel() - down * v.ravel())])


def _flat(
    middle: np.ndarray,
    slopes: np.ndarray,
    inverse: np.ndarray,
    weight: np.ndarray,
    basis: np.ndarray,
    solid: np.ndarray,
    stride: int,
) -> Patches:
    """The blocks that are flat.

    Args:
      middle: of each block at unit depth, shape (n, 2).
      slopes: of its inverse depth, and that at its middle, shape (n, 3).
      inverse: its pixels' inverse depths, 0 where not measured, shape (n, p).
      weight: 1 where measured, else 0, shape (n, p).
      basis: offset of each pixel from the middle at unit depth, and 1, shape (p, 3).
      solid: which blocks have a plane, shape (n,).
      stride: thinning of the image.
    """
    count = weight.sum(axis=1)
    centre = weight @ basis[:, :2] / np.maximum(count, 1)[:, None]
    at_centre = np.sum(slopes[:, :2] * centre, axis=1) + slopes[:, 2]
    solid = solid & (at_centre > 1e-3)
    safe = np.where(solid, at_centre, 1.0)
    residual = weight * (inverse - slopes @ basis.T)
    deviation = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(count - 3, 1)) / safe**2
    usual = float(np.median(deviation[solid])) if solid.any() else 0.0
    flat = solid & (deviation <= FLATNESS * usual + LEAST_DEVIATION)
    ray = np.concatenate([middle + centre, np.ones((len(middle), 1))], axis=1)
    normal = np.concatenate([slopes[:, :2], (slopes[:, 2] - np.sum(slopes[:, :2] * middle, axis=1))[:, None]], axis=1)
    # It points away from the camera, for its product with a point is 1.
    normal = -normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Patches((ray / safe[:, None])[flat], normal[flat], stride**2 * count[flat])


class Face(NamedTuple):
    """An inner face of the shelf, across an axis of the world.

    Attributes:
      name: in messages.
      field: of `Shelf`, its place.
      axis: 0, 1, 2 for x, y, z.
      inward: 1 if the free space is where the coordinate is larger, else -1.
    """

    name: str
    field: str
    axis: int
    inward: float

    @property
    def normal(self) -> Float[np.ndarray, "3"]:
        """Unit vector into the free space."""
        return self.inward * np.eye(3)[self.axis]

    def height(self, shelf: Shelf, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """How far points are in front of the face, negative behind it [m]."""
        return self.inward * (points[:, self.axis] - getattr(shelf, self.field))

    def across(self, shelf: Shelf, points: Float[np.ndarray, "n 3"], spare: float) -> Bool[np.ndarray, " n"]:
        """Whether points are within the face's edges, or at most `spare` [m] beyond them."""
        ranges = ((shelf.front, shelf.back), (shelf.right, shelf.left), (shelf.board, shelf.ceiling))
        within = np.ones(len(points), bool)
        for axis, (low, high) in enumerate(ranges):
            if axis != self.axis:
                within &= (points[:, axis] > low - spare) & (points[:, axis] < high + spare)
        return within


FACES = (
    Face("board", "board", 2, 1.0),
    Face("back wall", "back", 0, -1.0),
    Face("right side wall", "right", 1, 1.0),
    Face("left side wall", "left", 1, -1.0),
    Face("upper board", "ceiling", 2, -1.0),
)


def faces_of(shelf: Shelf) -> tuple[Face, ...]:
    """Those of `FACES` that a shelf has."""
    return tuple(face for face in FACES if face.field in ("board", *shelf.faces))


# Pixels that are used: of a whole calibration, and of the check at every look.
ALL_PIXELS, FEW_PIXELS = 1_000_000, 60_000
# How far from its place a face is searched [m].
REACH = 0.12
# Angles between a patch's normal and its face's within which it may be the face's, from step to step [rad].
TURNS = tuple(math.radians(angle) for angle in (25.0, 25.0, 15.0, 10.0, 6.0, 4.0, 4.0))
# Distances of a point from its face within which it counts, from step to step [m].
REACHES = (0.015, 0.015, 0.015, 0.01, 0.007, 0.005, 0.005, 0.005)
# Angle between a point's normal and its face's in these steps [rad].
ALIKE = math.radians(8.0)
# Bins of the search for a face [m]; the outermost with this share of the most patches is the face.
BIN, SHARE = 0.004, 0.2
# A face needs so many patches, over a width, or else a height or depth, that no object has [m].
FEWEST, WIDTH, LENGTH = 6, 0.18, 0.24
# Two faces across an axis that contradict each other by more than this are not both fitted [m].
CONTRADICTION = 0.006
# A rotation counts as the shift at this distance [m].
LEVER = 0.25
# A direction is determined if its standard error is below this [m], with residuals of at least this [m].
LEAST_PRECISION, LEAST_RESIDUAL = 0.001, 0.0003


@dataclasses.dataclass(frozen=True)
class FaceFit:
    """A face in the image.

    Attributes:
      face: the face.
      patches, pixels: how much of the image lies on it; 0 where it is not in sight.
      off: how far it is in front of its place after the fit, negative behind it [m]; nearly 0 unless the shelf's
        measures are wrong; NaN where it is not in sight.
    """

    face: Face
    patches: int
    pixels: int
    off: float

    @property
    def side(self) -> str:
        """On which side of its place it is, in words."""
        return "inside" if self.off > 0 else "outside"


@dataclasses.dataclass(frozen=True, eq=False)
class ShelfFit:
    """Where the shelf is in an image, as a motion of the camera in the world that puts it in its place.

    Attributes:
      camera: as it was given.
      pivot: the point that the motion turns about, the middle of the board [m].
      shift: of the pivot [m].
      turn: rotation vector [rad].
      covariance: of shift and turn, in the directions that are determined, shape (6, 6).
      undetermined: directions of (shift, `LEVER` * turn) that the image does not determine, as columns, shape (6, k);
        shift and turn have no part in them.
      faces: those that the shelf has, in the order of `FACES`.
    """

    camera: Camera
    pivot: Float[np.ndarray, "3"]
    shift: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "6 6"]
    undetermined: Float[np.ndarray, "6 k"]
    faces: tuple[FaceFit, ...]

    @property
    def corrected(self) -> Camera:
        """The camera where the image says that it is."""
        T = np.eye(4)
        turn = _matrix(self.turn)
        T[:3, :3] = turn @ np.array(self.camera.rotation)
        T[:3, 3] = turn @ (np.array(self.camera.position) - self.pivot) + self.pivot + self.shift
        return with_pose(self.camera, T)


class _Matched(NamedTuple):
    """Patches with the face that each lies on: normals, heights above it and weights."""

    points: np.ndarray
    normals: np.ndarray
    heights: np.ndarray
    weights: np.ndarray


def fit_shelf(camera: Camera, shelf: Shelf, depth: Float[np.ndarray, "h w"], most: int = ALL_PIXELS) -> ShelfFit:
    """Fit the shelf's faces to a depth image.

    Args:
      camera: as it is taken to be, at most some 10 cm and 15 degrees off.
      shelf: as it is taken to be.
      depth: an image that `check_images` was called with.
      most: pixels that are used.
    """
    patches = flat_patches(camera, depth, most)
    pivot = np.array(middle(shelf), float)
    rotation, place = np.array(camera.rotation, float), np.array(camera.position, float)
    points, normals = patches.point @ rotation.T + place, patches.normal @ rotation.T
    return _Fit(shelf, pivot, points, normals, patches.pixels, place).run(camera)


class _Fit:
    """A fit under way: the motion `x -> turn (x - pivot) + pivot + shift` of all points."""

    def __init__(
        self,
        shelf: Shelf,
        pivot: np.ndarray,
        points: np.ndarray,
        normals: np.ndarray,
        pixels: np.ndarray,
        place: np.ndarray,
    ):
        self.shelf, self.pivot, self.pixels, self.place = shelf, pivot, pixels, place
        self.given = points, normals
        self.turn, self.shift = np.eye(3), np.zeros(3)

    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        points, normals = self.given
        return (points - self.pivot) @ self.turn.T + self.pivot + self.shift, normals @ self.turn.T

    def run(self, camera: Camera) -> ShelfFit:
        for within in TURNS:
            self._turn_by_normals(within)
        used = self._shift_to_faces()
        covariance, free = np.zeros((6, 6)), np.eye(6)
        for reach in REACHES:
            covariance, free = self._step(used, reach)
        if free.size:
            # Objects' faces may have turned what the shelf's faces do not determine.
            self._give_back(free)
            for reach in REACHES:
                covariance, free = self._step(used, reach)
        scale = np.diag([1.0] * 3 + [1.0 / LEVER] * 3)
        return ShelfFit(
            camera,
            self.pivot,
            self.shift,
            _vector(self.turn),
            scale @ covariance @ scale,
            free,
            tuple(self._seen(face) for face in faces_of(self.shelf)),
        )

    def _turn_by_normals(self, within: float) -> None:
        """A step towards the rotation that turns the patches' normals into those of the faces nearest to them."""
        points, normals = self.moved()
        near = np.zeros(len(points), bool)
        faces = faces_of(self.shelf)
        for face in faces:
            near |= face.across(self.shelf, points, REACH) & (np.abs(face.height(self.shelf, points)) < 2 * REACH)
        normals, pixels = normals[near], self.pixels[near]
        axes = np.stack([face.normal for face in faces])
        cosines = normals @ axes.T
        best = cosines.argmax(axis=1) if len(cosines) else np.zeros(0, int)
        angle = np.arccos(np.clip(cosines.max(axis=1), -1.0, 1.0)) if len(cosines) else np.zeros(0)
        weight = pixels * np.maximum(1.0 - (angle / within) ** 2, 0.0) ** 2
        if not weight.sum() > 0:
            return
        weight = weight / weight.sum()
        aim = axes[best]
        matrix = np.eye(3) - np.einsum("n,ni,nj->ij", weight, normals, normals)
        pull = np.einsum("n,ni->i", weight, np.cross(normals, aim))
        values, vectors = np.linalg.eigh(matrix)
        # One face alone leaves the rotation about its normal free, but for noise in the normals.
        kept = values > 0.02
        step = vectors[:, kept] @ ((vectors[:, kept].T @ pull) / values[kept])
        turn = _matrix(step)
        self.turn = turn @ self.turn
        # About the camera, which is turned about itself more often than the shelf is about its middle.
        self.shift = turn @ (self.pivot + self.shift - self.place) + self.place - self.pivot

    def _candidates(self, face: Face, points: np.ndarray, normals: np.ndarray, spare: float) -> np.ndarray:
        return face.across(self.shelf, points, spare) & (normals @ face.normal > math.cos(ALIKE))

    def _outermost(self, face: Face) -> tuple[float, float] | None:
        """Height of the face above its place [m], and its pixels; None if it is not in sight."""
        points, normals = self.moved()
        heights = face.height(self.shelf, points)
        near = self._candidates(face, points, normals, REACH) & (np.abs(heights) < REACH)
        if near.sum() < FEWEST:
            return None
        edges = np.arange(-REACH, REACH + BIN / 2, BIN)
        pixels, _ = np.histogram(heights[near], edges, weights=self.pixels[near])
        pixels = pixels + np.append(pixels[1:], 0.0)
        for i in np.flatnonzero(pixels >= SHARE * pixels.max()):
            on = near & (np.abs(heights - edges[i + 1]) < 1.5 * BIN)
            if on.sum() >= FEWEST and self._is_wide(face, points[on]):
                return float(np.median(heights[on])), float(self.pixels[on].sum())
        return None

    def _is_wide(self, face: Face, points: np.ndarray) -> bool:
        """Whether points spread wider than any object."""
        low, high = np.percentile(points, (5, 95), axis=0)
        spans = high - low
        level = [axis for axis in (0, 1) if axis != face.axis]
        return bool(max(spans[level]) > WIDTH or max(np.delete(spans, face.axis)) > LENGTH)

    def _shift_to_faces(self) -> list[Face]:
        """Shift the points so that the faces are in their places; return the faces that agree."""
        seen = {face: place for face in faces_of(self.shelf) if (place := self._outermost(face)) is not None}
        used: list[Face] = []
        shift = np.zeros(3)
        for axis in range(3):
            along = sorted((face for face in seen if face.axis == axis), key=lambda face: -seen[face][1])
            if not along:
                # What turning about the camera moved is not known either.
                shift[axis] = -self.shift[axis]
                continue
            best = along[0]
            shift[axis] = -best.inward * seen[best][0]
            used += [best]
            used += [f for f in along[1:] if abs(-f.inward * seen[f][0] - shift[axis]) < CONTRADICTION]
        self.shift = self.shift + shift
        return used

    def _matched(self, faces: list[Face], reach: float) -> _Matched:
        points, normals = self.moved()
        parts = []
        for face in faces:
            heights = face.height(self.shelf, points)
            on = self._candidates(face, points, normals, 0.01) & (np.abs(heights) < reach)
            weight = self.pixels[on] * (1.0 - (heights[on] / reach) ** 2) ** 2
            parts.append((points[on], np.broadcast_to(face.normal, (on.sum(), 3)), heights[on], weight))
        if not parts:
            parts = [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))]
        return _Matched(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def _step(self, faces: list[Face], reach: float) -> tuple[np.ndarray, np.ndarray]:
        """A Gauss-Newton step; returns the scaled covariance, and the directions that are left."""
        points, normals, heights, weight = self._matched(faces, reach)
        if len(points) < FEWEST:
            return np.zeros((6, 6)), np.eye(6)
        weight = weight / weight.max()
        arm = points - self.pivot - self.shift
        jacobian = np.concatenate([normals, np.cross(arm, normals) / LEVER], axis=1)
        matrix = jacobian.T @ (weight[:, None] * jacobian)
        pull = -jacobian.T @ (weight * heights)
        residual = math.sqrt(float(weight @ heights**2) / max(float(weight.sum()), 1e-9))
        values, vectors = np.linalg.eigh(matrix)
        kept = np.maximum(residual, LEAST_RESIDUAL) < LEAST_PRECISION * np.sqrt(np.maximum(values, 0.0))
        inside, values = vectors[:, kept], values[kept]
        step = inside @ (inside.T @ pull / values)
        self.turn = _matrix(step[3:] / LEVER) @ self.turn
        self.shift = self.shift + step[:3]
        return residual**2 * (inside / values) @ inside.T, vectors[:, ~kept]

    def _give_back(self, free: np.ndarray) -> None:
        """Take the part of the motion back that lies in directions of (shift, `LEVER` * turn), as columns."""
        motion = np.concatenate([self.shift, LEVER * _vector(self.turn)])
        motion -= free @ (free.T @ motion)
        self.shift, self.turn = motion[:3], _matrix(motion[3:] / LEVER)

    def _seen(self, face: Face) -> FaceFit:
        place = self._outermost(face)
        if place is None:
            return FaceFit(face, 0, 0, math.nan)
        points, normals = self.moved()
        on = self._candidates(face, points, normals, 0.01)
        on &= np.abs(face.height(self.shelf, points) - place[0]) < REACHES[-1]
        return FaceFit(face, int(on.sum()), int(self.pixels[on].sum()), place[0])


def _matrix(turn: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation by a rotation vector [rad]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(turn).as_matrix()


def _vector(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """The rotation vector [rad] of a rotation."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_rotvec()
