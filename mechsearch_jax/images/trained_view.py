"""The views of a shelf on which networks were trained, as their cards record, and warnings about views far from these.

Networks take points, not images, and a segment's points in its own frame. So they depend on the distance and direction
of the view, its density, and the size of the shelf. Each is a number of `TrainedView.numbers`.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from mechsearch_jax.images.cloud import density, distance, middle, shelf_view, thinned_view
from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.runtime.tables import checked
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import FACES, Shelf


@dataclasses.dataclass(frozen=True)
class TrainedView:
    """A shelf and the rays of a view of it; hashable.

    Attributes:
      camera: of a `cloud.View`, whose image consists of exactly the rays of a network's input.
      shelf: in the view.
    """

    camera: Camera = dataclasses.field(default_factory=lambda: shelf_view(Camera(), Shelf()).camera)
    shelf: Shelf = dataclasses.field(default_factory=Shelf)

    def numbers(self) -> dict[str, float]:
        """The numbers that `TOLERANCES` compares; lengths in metres, angles in degrees, pixels per metre."""
        x, y, z = np.subtract(self.camera.position, middle(self.shelf)).tolist()
        to_board = distance(self.camera, self.shelf)
        shelf = self.shelf
        return {
            "distance": to_board,
            "azimuth": float(np.degrees(np.arctan2(y, -x))),
            "elevation": float(np.degrees(np.arcsin(z / to_board))),
            "density": density(self.camera, shelf),
            "depth": shelf.back - shelf.front,
            "width": shelf.left - shelf.right,
            "height": shelf.ceiling - shelf.board,
        }

    def entry(self) -> dict[str, Any]:
        """The entry `view` of a card."""
        return dataclasses.asdict(self)


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """How far a number may be from its value in training without a warning.

    Attributes:
      what: beginning of a sentence that ends in the value.
      form: format of the value, with its unit.
      low, high: factors of, or differences from, the value in training.
      times: whether they are factors.
    """

    what: str
    form: str
    low: float
    high: float
    times: bool = True

    def range(self, trained: float) -> tuple[float, float]:
        """The least and the largest value."""
        return (trained * self.low, trained * self.high) if self.times else (trained + self.low, trained + self.high)


# From measurements with `benchmarks/lab/parts/views` (docs/method.md, "Other cameras and shelves").
TOLERANCES: Mapping[str, Tolerance] = {
    "distance": Tolerance("camera: its distance from the middle of the board is", "{:.2f} m", 0.8, 1.4),
    "azimuth": Tolerance(
        "camera: the angle by which it stands to the left of the board's middle is", "{:.0f} degrees", -65, 15, False
    ),
    "elevation": Tolerance("camera: the angle by which it looks down on the board is", "{:.0f} degrees", -6, 16, False),
    "density": Tolerance("camera: its pixels for a metre at the middle of the board are", "{:.0f}", 0.7, 1.6),
    "depth": Tolerance("shelf: the depth of its board is", "{:.2f} m", 0.7, 1.4),
    "width": Tolerance("shelf: the width of its board is", "{:.2f} m", 0.7, 1.4),
    "height": Tolerance("shelf: the height of its free space is", "{:.2f} m", 0.7, 1.4),
}


def view_faults(camera: Camera, shelf: Shelf, trained: Mapping[str, TrainedView]) -> tuple[str, ...]:
    """Warnings about a camera and a shelf that differ much from those that networks were trained on.

    Args:
      camera: of the full images.
      shelf: in its view.
      trained: the views in training, by the networks' names.

    Raises:
      InputError: the camera does not see the shelf.
    """
    numbers = TrainedView(thinned_view(camera, shelf).camera, shelf).numbers()
    bounds = {"depth": ("back",), "width": ("right", "left"), "height": ("ceiling",)}
    unbounded = [name for name, faces in bounds.items() if not set(faces) <= set(shelf.faces)]
    lines: dict[str, list[str]] = {}
    for network, view in trained.items():
        usual = view.numbers()
        for name, tolerance in TOLERANCES.items():
            low, high = tolerance.range(usual[name])
            if name not in unbounded and not low <= numbers[name] <= high:
                value, *ends = (tolerance.form.format(number) for number in (numbers[name], low, high, usual[name]))
                line = f"{tolerance.what} {value}, outside of {ends[0]} to {ends[1]} (trained at {ends[2]})"
                lines.setdefault(line, []).append(network)
    return tuple(f"{line}; expect more mistakes in {' and '.join(names)}" for line, names in lines.items())


def read_view(card: Mapping[str, Any], where: str) -> TrainedView | None:
    """The view in training that a network's card records, if any; error messages begin with `where`.

    Raises:
      InputError: the entry was not made by `TrainedView.entry`.
    """
    if "view" not in card:
        return None
    entry = _table(card["view"], ("camera", "shelf"), f"{where}: view")
    # Cards that do not name its faces are of a shelf with all of them.
    shelf = entry["shelf"]
    if isinstance(shelf, dict) and shelf:
        shelf = {"faces": list(FACES)} | shelf
    return TrainedView(
        _record(Camera, entry["camera"], f"{where}: view: camera"),
        _record(Shelf, shelf, f"{where}: view: shelf"),
    )


def _table(value: Any, names: Iterable[str], where: str) -> dict[str, Any]:
    if not isinstance(value, dict) or value.keys() != set(names):
        raise InputError(f"{where}: {shown(value)} must hold {', '.join(names)}; train or install anew")
    return value


def _record(kind: type, value: Any, where: str) -> Any:
    hints = typing.get_type_hints(kind)
    table = _table(value, hints, where)
    given = {name: checked(part, hints[name], f"{where}: {name}") for name, part in table.items()}
    try:
        return kind(**given)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
