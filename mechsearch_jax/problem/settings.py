"""All settings of a workcell and a planner in one file (docs/commands.md, "The configuration file")."""

from __future__ import annotations

import dataclasses
import importlib.resources
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from mechsearch_jax.actions.registry import check_kinds
from mechsearch_jax.config.config import OPTIONS, Config
from mechsearch_jax.config.presets import DEFAULT_PRESET, PRESETS, expanded
from mechsearch_jax.images.colour import HUE, LEAST_TARGET_SATURATION, RED, TargetColour, rgb_of_hue
from mechsearch_jax.images.labels import CAPACITY, check_capacity
from mechsearch_jax.problem.workcell import Workcell
from mechsearch_jax.robot.entry import check_outside
from mechsearch_jax.runtime.errors import InputError, check_range, nearest
from mechsearch_jax.runtime.files import PathLike
from mechsearch_jax.runtime.tables import Document, apply, check_names, checked, read_document, with_table
from mechsearch_jax.workspace.object_sizes import ObjectSizes
from mechsearch_jax.workspace.obstacle import CAMERA_BODY, Obstacle
from mechsearch_jax.workspace.scenario import parse_compound
from mechsearch_jax.workspace.target import DENSITY, FRICTION, Target

PLANNER = "planner"
# Largest coordinate of the base in a file's frame [m].
FARTHEST = 10.0
# The example in the folder `data` of the package.
EXAMPLE = "example-config.toml"


@dataclasses.dataclass(frozen=True)
class Base:
    """Where the robot's base stands in the frame in which a file gives camera, shelf and the target's place.

    Attributes:
      position: of the base, whose axes are parallel to the frame's [m].
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self):
        for axis, value in zip("xyz", self.position, strict=True):
            check_range(f"Base: position {axis}", value, -FARTHEST, FARTHEST, "m")


@dataclasses.dataclass(frozen=True)
class Settings:
    """The content of a configuration file.

    Attributes:
      workcell: camera, shelf, gripper and target.
      objects: sizes of the objects of generated scenes.
      preset: holds the planner's settings that are not in `given`.
      given: options of the planner by name.
    """

    workcell: Workcell = dataclasses.field(default_factory=Workcell)
    objects: ObjectSizes = dataclasses.field(default_factory=ObjectSizes)
    preset: str = DEFAULT_PRESET
    given: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def config(self) -> Config:
        """The planner's configuration."""
        return PRESETS[self.preset]().with_options(**self.given)

    def with_options(self, preset: str | None = None, **options: Any) -> Settings:
        """The settings with another preset or other options of the planner, which override those of the file.

        Raises:
          InputError: an option is impossible.
        """
        settings = dataclasses.replace(self, preset=preset or self.preset, given={**self.given, **expanded(options)})
        check_kinds(settings.config.problem.actions.actions)
        return settings


# The keys of the target's table that are the workcell's `colour` and `hue_tolerance`; all others are of the `Target`.
COLOUR, HUE_TOLERANCE = "colour", "hue_tolerance"
# The key of the objects' table that is the workcell's.
ROOM = "capacity"

# The defaults of a file's tables, without the planner's.
_PARTS: Mapping[str, Any] = {
    **{
        field.name: getattr(Workcell(), field.name)
        for field in dataclasses.fields(Workcell)
        if field.name not in ("colour", "hue_tolerance", "camera_body", "obstacles", ROOM)
    },
    "base": Base(),
    "objects": ObjectSizes(),
}


# The key of the camera's table that is the workcell's `camera_body`, and the tables of which there may be several.
BODY, OBSTACLE = "body", "obstacle"


# What a target of several pieces is made of, instead of a shape and half-extents, and the defaults.
_MADE_OF: dict[str, Any] = {"mesh": "", "scale": 1.0, "pieces": [], "density": DENSITY, "friction": FRICTION}


def tables() -> dict[str, dict[str, Any]]:
    """Every table and key that a file may have, with its default."""
    parts = {
        name: {field.name: getattr(usual, field.name) for field in dataclasses.fields(usual)}
        for name, usual in _PARTS.items()
    }
    parts["target"].pop("compound")
    parts["gripper"].pop("arm")
    parts["camera"][BODY] = Workcell().camera_body
    parts["objects"][ROOM] = CAPACITY
    parts["target"] |= _MADE_OF | {COLOUR: Workcell().colour, HUE_TOLERANCE: Workcell().hue_tolerance}
    return {**parts, PLANNER: {"preset": DEFAULT_PRESET, **PRESETS[DEFAULT_PRESET]().options()}}


def load_settings(path: PathLike) -> Settings:
    """Read a configuration file (TOML); missing keys take their defaults.

    Lengths in metres, angles in degrees but the joints' in radians, poses in the robot's base frame, or in a frame in
    which `[base]` locates it.

    Raises:
      InputError: the file cannot be read or is not TOML; a table or key is unknown; a value is of the wrong type or
        impossible. The message names file, line, table and key.
    """
    document = read_document(path, arrays=(OBSTACLE,))
    names, bodies = [*_PARTS, PLANNER, OBSTACLE], [name for name in document.tables if name.startswith(f"{OBSTACLE} ")]
    for table in document.tables:
        if table == OBSTACLE:
            raise InputError(
                f"{document.where(table)} must have two brackets, [[{OBSTACLE}]], since there may be several"
            )
        if table and table not in [*names, *bodies]:
            raise InputError(f"{document.where(table)} is unknown; {nearest(table, names)}")
    if "arm" in document.tables.get("gripper", {}):
        raise InputError(f"{document.where('gripper', 'arm')} is unknown; say which arm it is by model in [arm]")
    for key in document.tables[""]:
        begin = ", ".join(f"[[{table}]]" if table == OBSTACLE else f"[{table}]" for table in names)
        raise InputError(f"{document.where('', key)} stands in no table; begin one of {begin}")
    detector, document = _detector(document)
    body, document = _camera_body(document)
    room, document = _room(document)
    base = with_table(document, "base", Base())
    x, y, z = base.position
    document = _with_moved_place(document, (-x, -y, -z))
    parts = {
        name: with_table(document, name, usual) for name, usual in _PARTS.items() if name not in ("target", "base")
    }
    objects = parts.pop("objects")
    in_base_frame = lambda _: {name: parts[name].moved((-x, -y, -z)) for name in ("camera", "shelf")}  # noqa: E731
    parts |= apply(document, "base", {}, in_base_frame)
    places = {"outside": parts["gripper"].outside}
    apply(document, "gripper", places, lambda _: check_outside(parts["gripper"], parts["shelf"]))
    target = _target(document)
    workcell = apply(
        document,
        "target",
        {"inset": target.inset},
        lambda given: Workcell(target=target if given else Target(), **detector, **room, **parts),
    )
    bodied = lambda given: dataclasses.replace(workcell, camera_body=given.get(BODY, CAMERA_BODY))  # noqa: E731
    workcell = apply(document, "camera", body, bodied)
    for name in bodies:
        workcell = _with_obstacle(document, name, workcell, (-x, -y, -z))
    return _with_planner(document, Settings(workcell, objects))


def _with_moved_place(document: Document, offset: tuple[float, float, float]) -> Document:
    """The document with the target's place moved, if the place is a point; joint angles stay as they are.

    The place is moved before it is checked, since its bounds are around the robot.
    """
    arm = document.tables.get("arm", {})
    if "place" not in arm:
        return document
    place = checked(arm["place"], tuple[float, ...], document.where("arm", "place"))
    if len(place) != len(offset):
        return document
    # Without the digits that binary fractions add: messages show the place.
    moved = [round(value + by, 9) for value, by in zip(place, offset, strict=True)]
    return dataclasses.replace(document, tables={**document.tables, "arm": {**arm, "place": moved}})


def _detector(document: Document) -> tuple[dict[str, Any], Document]:
    """What the workcell holds of the target's colour, and the document without it."""
    table = document.tables.get("target", {})
    if "color" in table:
        raise InputError(f"{document.where('target', 'color')} is called {COLOUR} now")
    given: dict[str, Any] = {}
    if COLOUR in table:
        given[COLOUR] = _rgb(document, table[COLOUR])
    if HUE_TOLERANCE in table:
        given[HUE_TOLERANCE] = checked(table[HUE_TOLERANCE], float, document.where("target", HUE_TOLERANCE))
    lit = lambda values: TargetColour.lit(values.get(COLOUR, RED), values.get(HUE_TOLERANCE, HUE))  # noqa: E731
    apply(document, "target", given, lit)
    names = {COLOUR: "colour", HUE_TOLERANCE: "hue_tolerance"}
    rest = {key: value for key, value in table.items() if key not in names}
    without = dataclasses.replace(document, tables={**document.tables, "target": rest})
    return {names[key]: value for key, value in given.items()}, without


def _camera_body(document: Document) -> tuple[dict[str, Any], Document]:
    """The size of the camera's body, if it is given, and the document without it."""
    table = dict(document.tables.get("camera", {}))
    if BODY not in table:
        return {}, document
    size = checked(table.pop(BODY), tuple[float, float, float], document.where("camera", BODY))
    return {BODY: size}, dataclasses.replace(document, tables={**document.tables, "camera": table})


def _with_obstacle(document: Document, table: str, workcell: Workcell, shift: tuple[float, float, float]) -> Workcell:
    """The workcell with the obstacle of a table, moved into the base's frame."""
    obstacles = (*workcell.obstacles, _obstacle(document, table).moved(shift))
    return apply(document, table, {}, lambda _: dataclasses.replace(workcell, obstacles=obstacles))


def _obstacle(document: Document, table: str) -> Obstacle:
    """The obstacle of a table."""
    given = document.tables[table]
    row = tuple[float, float, float]
    hints: dict[str, Any] = {
        "name": str,
        "shape": Literal["box", "cylinder"],
        "size": row,
        "mesh": str,
        "scale": float,
        "position": row,
        "rotation": tuple[row, row, row],
    }
    check_names(document, table, hints)
    needed, foreign, what = (("name", "size", "position"), ("scale",), "box or cylinder")
    if "mesh" in given:
        needed, foreign, what = ("name", "mesh"), ("shape", "size"), "mesh"
    for key in foreign:
        if key in given:
            raise InputError(f"{document.where(table, key)}: is nothing that a {what} has; leave it out")
    for key in needed:
        if key not in given:
            raise InputError(f"{document.where(table)}: {key} is missing")
    values = {key: checked(value, hints[key], document.where(table, key)) for key, value in given.items()}
    if "mesh" in values:
        needed = {"name": values["name"], "mesh": Path(document.path).parent / values.pop("mesh")}
        return apply(document, table, values, lambda changes: Obstacle.of_mesh(**{**changes, **needed}))
    usual = Obstacle("obstacle", (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    return apply(document, table, values, lambda changes: dataclasses.replace(usual, **changes))


def _room(document: Document) -> tuple[dict[str, int], Document]:
    """How many objects the workcell has room for, and the document without it."""
    rest = dict(document.tables.get("objects", {}))
    given = {ROOM: checked(rest.pop(ROOM), int, document.where("objects", ROOM))} if ROOM in rest else {}
    apply(document, "objects", given, lambda values: check_capacity(values.get(ROOM, CAPACITY)))
    return given, dataclasses.replace(document, tables={**document.tables, "objects": rest})


def _rgb(document: Document, value: Any) -> tuple[float, float, float]:
    """The target's colour, given as red, green and blue, or as a table of hue and saturation."""
    where = document.where("target", COLOUR)
    if not isinstance(value, dict):
        return checked(value, tuple[float, float, float], where)
    if value.keys() != {"hue", "saturation"}:
        raise InputError(f"{where} must be red, green and blue, or {{hue = DEGREES, saturation = SHARE}}")
    hue, saturation = (checked(value[name], float, f"{where} {name}") for name in ("hue", "saturation"))
    if saturation < LEAST_TARGET_SATURATION:
        raise InputError(
            f"{where} saturation {saturation:g} is too grey to tell the target by; give at least "
            f"{LEAST_TARGET_SATURATION:g}, or a mask with the images"
        )
    return apply(
        document, "target", {COLOUR: (hue, saturation)}, lambda numbers: rgb_of_hue(*numbers.get(COLOUR, (0.0, 1.0)))
    )


def _target(document: Document) -> Target:
    """The target; the defaults of its other keys depend on its shape."""
    table = document.tables.get("target", {})
    if "compound" in table:
        raise InputError(f"{document.where('target', 'compound')} is unknown; {nearest('compound', list(_MADE_OF))}")
    made_of = {key: table.get(key, usual) for key, usual in _MADE_OF.items()}
    rest = {key: value for key, value in table.items() if key not in _MADE_OF}
    document = dataclasses.replace(document, tables={**document.tables, "target": rest})
    if made_of["pieces"] or made_of["mesh"]:
        return with_table(document, "target", _compound_target(document, made_of))
    name = rest.get("shape", Target().shape)
    shape = checked(name, str, document.where("target", "shape"))
    usual = apply(document, "target", {"shape": shape}, lambda given: Target.of(given.get("shape", Target().shape)))
    return with_table(document, "target", usual)


def _compound_target(document: Document, made_of: dict[str, Any]) -> Target:
    """A target of pieces or of a mesh, as scenario files have them."""
    where = document.where("target")
    for key in ("shape", "half_size"):
        if key in document.tables["target"]:
            raise InputError(f"{document.where('target', key)}: follows from the mesh or the pieces; leave it out")
    if made_of["pieces"] and made_of["mesh"]:
        raise InputError(f"{where}: has pieces and a mesh; give one of them")
    unused = ("mesh", "scale") if made_of["pieces"] else ("pieces",)
    value = {key: item for key, item in made_of.items() if key not in unused}
    compound = parse_compound(value, (), where, Path(document.path).parent)
    return apply(document, "target", made_of, lambda _: Target.of_compound(compound))


def _with_planner(document: Document, settings: Settings) -> Settings:
    """The settings with the planner's table."""
    types = {option.name: option.values for option in OPTIONS}
    check_names(document, PLANNER, {"preset": str, **types})
    table = dict(document.tables.get(PLANNER, {}))
    preset = checked(table.pop("preset", DEFAULT_PRESET), Literal[tuple(PRESETS)], document.where(PLANNER, "preset"))
    given = {name: checked(value, types[name], document.where(PLANNER, name)) for name, value in table.items()}
    inside = {option.name: option.inside for option in OPTIONS}
    return apply(
        document,
        PLANNER,
        given,
        lambda options: settings.with_options(preset, **{name: inside[name](value) for name, value in options.items()}),
    )


def example_config() -> str:
    """The text of the example file, which holds every key with its default."""
    return (importlib.resources.files("mechsearch_jax") / "data" / EXAMPLE).read_text(encoding="utf-8")
