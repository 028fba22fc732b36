"""What networks saw of a shelf while they were trained, as their cards tell it, and what lies far outside of that.

A network is shown points, not images, and a segment's points in a frame of its own: what it can be used to are how far
away and from where a shelf is looked at, how densely, and how large the shelf is. Each is one number of a `View`.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np

from mechsearch_jax.images.cloud import density, distance, middle, shelf_view, thinned_view
from mechsearch_jax.runtime.errors import InputError, shown
from mechsearch_jax.runtime.tables import checked
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf


@dataclasses.dataclass(frozen=True)
class TrainedView:
    """A shelf, and the rays that look at it; hashable.

    Attributes:
      camera: whose image consists of exactly the rays that a network is shown, a `cloud.View`'s.
      shelf: what it looks at.
    """

    camera: Camera = dataclasses.field(default_factory=lambda: shelf_view(Camera(), Shelf()).camera)
    shelf: Shelf = dataclasses.field(default_factory=Shelf)

    def numbers(self) -> dict[str, float]:
        """What `TOLERANCES` compares; lengths in metres, angles in degrees, pixels per metre."""
        x, y, z = np.subtract(self.camera.position, middle(self.shelf)).tolist()
        away = distance(self.camera, self.shelf)
        shelf = self.shelf
        return {
            "distance": away,
            "azimuth": float(np.degrees(np.arctan2(y, -x))),
            "elevation": float(np.degrees(np.arcsin(z / away))),
            "density": density(self.camera, shelf),
            "depth": shelf.back - shelf.front,
            "width": shelf.left - shelf.right,
            "height": shelf.ceiling - shelf.board,
        }

    def entry(self) -> dict[str, Any]:
        """It as a card's `view` holds it."""
        return dataclasses.asdict(self)


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """How far a number may be from what it was in training.

    Attributes:
      what: the number, as a sentence that ends in its value.
      form: how the value is written, with its unit.
      low, high: multiplied with the trained value, or added to it: the ends of what is not warned of.
      times: whether they are multiplied.
    """

    what: str
    form: str
    low: float
    high: float
    times: bool = True

    def range(self, trained: float) -> tuple[float, float]:
        """The least and the largest value."""
        return (trained * self.low, trained * self.high) if self.times else (trained + self.low, trained + self.high)


# Set by what was measured in the places of `benchmarks/parts/views` (docs/method.md, "Other cameras and shelves").
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
    """What of a camera and a shelf is far outside of what networks were trained on; empty if nothing is.

    Args:
      camera: whose full images are given.
      shelf: what it sees.
      trained: what they were trained on, by the networks' names.

    Raises:
      InputError: the camera does not see the shelf.
    """
    numbers = TrainedView(thinned_view(camera, shelf).camera, shelf).numbers()
    lines: dict[str, list[str]] = {}
    for network, view in trained.items():
        usual = view.numbers()
        for name, tolerance in TOLERANCES.items():
            low, high = tolerance.range(usual[name])
            if not low <= numbers[name] <= high:
                value, *ends = (tolerance.form.format(number) for number in (numbers[name], low, high, usual[name]))
                line = f"{tolerance.what} {value}, outside of {ends[0]} to {ends[1]} (trained at {ends[2]})"
                lines.setdefault(line, []).append(network)
    return tuple(f"{line}; expect more mistakes in {' and '.join(names)}" for line, names in lines.items())


def read_view(card: Mapping[str, Any], where: str) -> TrainedView | None:
    """What a card says a network was trained on; None if it does not say.

    Args:
      card: of a network's weights.
      where: how a complaint begins, such as the card's path.

    Raises:
      InputError: the entry is none of `TrainedView.entry`.
    """
    if "view" not in card:
        return None
    entry = _table(card["view"], ("camera", "shelf"), f"{where}: view")
    return TrainedView(
        _record(Camera, entry["camera"], f"{where}: view: camera"),
        _record(Shelf, entry["shelf"], f"{where}: view: shelf"),
    )


def _table(value: Any, names: typing.Iterable[str], where: str) -> dict[str, Any]:
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
