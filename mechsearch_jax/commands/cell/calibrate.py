"""`mechsearch calibrate`: where the camera is, measured on the shelf in a depth image."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mechsearch_jax.commands.options import ConfigFile, base_of, settings_of
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from mechsearch_jax.images.lens import Lens
    from mechsearch_jax.workspace.shelf import Shelf

# Largest turn of a shelf that stays as it is when the shelf's place is corrected, for its faces are axis-aligned [rad].
SHELF_TURN = 0.005
# What the table of a shelf says of its place.
PLACES = ("front", "back", "right", "left", "board", "ceiling")


def calibrate(
    *,
    depth: Annotated[Path, tyro.conf.arg(metavar="IMAGE")],
    camera: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None,
    config: ConfigFile = None,
    moved: Literal["camera", "shelf"] = "camera",
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml|FILE.json")] = None,
) -> None:
    """Measure on the shelf in a depth image how far the camera's pose is off, and write the corrected one.

    The planes of the board, the walls and the upper board are fitted, as far as they are in sight; objects may stand
    before them. One image says where camera and shelf are to each other: which of them is off is for you to say. The
    configuration has to say where the shelf is.

    Args:
      depth: depth image: PNG or TIFF of 16 bits in millimetres, or TIFF or .npy of floats in metres.
      camera: JSON with the fields of a ROS CameraInfo and T_world_camera, whose lens may distort; the configuration's
        camera if not given.
      config: file of settings, of which the shelf is taken, and the camera; its table [shelf] must say where that is.
      moved: what is off and is corrected: the camera's pose, or the place of the shelf.
      out: file for the correction: the configuration with the corrected pose (.toml), or the camera (.json).
    """
    from mechsearch_jax.calibration.check import check_holds, check_in_sight
    from mechsearch_jax.calibration.fit import fit_shelf
    from mechsearch_jax.calibration.report import report
    from mechsearch_jax.images.checks import check_images
    from mechsearch_jax.images.image_files import load_depth, load_lens
    from mechsearch_jax.images.lens import Lens
    from mechsearch_jax.runtime.files import check_writable
    from mechsearch_jax.workspace.sight import check_camera

    suffixes = (".toml",) if moved == "shelf" else (".toml", ".json")
    if out is not None and out.suffix.lower() not in suffixes:
        raise InputError(f"calibrate: --out {out} must end in {' or '.join(suffixes)}")
    workcell = settings_of(config).workcell
    _check_shelf(config)
    lens, shelf = Lens(workcell.camera) if camera is None else load_lens(camera), workcell.shelf
    if lens.distorts and out is not None and out.suffix.lower() == ".toml" and moved == "camera":
        raise InputError(
            f"calibrate: the lens of {camera} distorts, and a configuration has none; give --out FILE.json"
        )
    given, image = lens.camera, lens.depth(load_depth(depth))
    if out is not None:
        check_writable(out.parent)
    check_camera(given, shelf)
    check_images(given, image)
    fit = fit_shelf(given, shelf, image)
    check_in_sight(fit, shelf, image)
    places = ", ".join(f"{name} {getattr(shelf, name):g}" for name in PLACES)
    print(f"{config}: the shelf in the robot's frame: {places} m; the camera of {camera or config}")
    print(report(fit, moved))
    check_holds(fit, shelf, image)
    if moved == "shelf":
        if (turn := float(sum(fit.turn**2)) ** 0.5) > SHELF_TURN:
            raise InputError(
                f"calibrate: the shelf is turned by {turn:.3f} rad, and its faces are along the axes of the robot's "
                "frame; leave --moved out to correct the camera, and turn the shelf or the robot back"
            )
        _write_shelf(shelf.moved(tuple((-fit.shift).tolist())), config, out)
    else:
        _write_camera(Lens(fit.corrected, lens.distortion), config, out, whole=camera is not None)


def _check_shelf(config: Path | None) -> None:
    """Check that it is said which shelf the image shows: the default one is nobody's.

    Raises:
      InputError: it is not.
    """
    from mechsearch_jax.runtime.tables import read_document

    missing = [n for n in PLACES if config is None or n not in read_document(config).tables.get("shelf", {})]
    if missing:
        where = "there is no --config" if config is None else f"{config}: [shelf] has no {', '.join(missing)}"
        raise InputError(
            f"calibrate: {where}; write the shelf's front, back, right, left, board and ceiling into [shelf] of a file "
            "(mechsearch config prints one), and give it with --config"
        )


def _write_camera(lens: Lens, config: Path | None, out: Path | None, whole: bool) -> None:
    """Write a camera; `whole` with its intrinsics, which the configuration may not have."""
    from mechsearch_jax.images.image_files import save_camera

    if out is None:
        return
    if out.suffix.lower() == ".json":
        save_camera(lens.camera, out, lens.distortion)
        print(out)
        return
    corrected = lens.camera
    base = base_of(config)
    position = [round(a + b, 7) for a, b in zip(corrected.position, base, strict=True)]
    rotation = [[round(value, 9) for value in row] for row in corrected.rotation]
    sizes = {name: getattr(corrected, name) for name in ("width", "height", "fx", "fy", "cx", "cy")} if whole else {}
    _write_values(config, out, "camera", {**sizes, "rotation": rotation, "position": position})


def _write_shelf(shelf: Shelf, config: Path | None, out: Path | None) -> None:
    """Write the place of a shelf."""
    if out is None:
        return
    x, y, z = base_of(config)
    moved = shelf.moved((x, y, z))
    values = {name: getattr(moved, name) for name in (*PLACES, "spawn_x", "spawn_y")}
    rounded = {k: round(v, 5) if isinstance(v, float) else [round(a, 5) for a in v] for k, v in values.items()}
    _write_values(config, out, "shelf", rounded)


def _write_values(config: Path | None, out: Path, table: str, values: Mapping[str, object]) -> None:
    """Write the configuration with other values in a table.

    Raises:
      InputError: it cannot be written, or what would be written is no valid configuration; `out` stays as it was.
    """
    from mechsearch_jax.problem.settings import load_settings
    from mechsearch_jax.runtime.files import read_text, replacing
    from mechsearch_jax.runtime.tables import with_values

    text = with_values("" if config is None else read_text(config), table, values, str(config))
    with replacing(out) as file:
        file.write(text.encode())
        file.flush()
        try:
            load_settings(file.name)
        except InputError as error:
            raise InputError(f"{str(error).replace(file.name, str(out))}; {out} was not written") from error
    print(out)
