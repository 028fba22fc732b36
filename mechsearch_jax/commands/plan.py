"""`mechsearch plan`: one decision from images in files."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from mechsearch_jax.images.labels import CAPACITY
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from mechsearch_jax.session.searcher import Check, Searcher
    from mechsearch_jax.session.step import SearchStep
    from mechsearch_jax.workspace.camera import Camera

# Default number for no object in a mask of 8 bits.
BACKGROUND = 255


ImageFile = Annotated[Path | None, tyro.conf.arg(metavar="IMAGE", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class ImageFiles:
    """The images that are decided from.

    Attributes:
      depth: depth image: PNG or TIFF of 16 bits in millimetres, or TIFF or .npy of floats in metres. Of several of one
        look each pixel's median is taken where at least half of them measured it.
      colour: colour image, registered to the depth image; the target is seen by its colour.
      mask: image of whole numbers, one for each object, registered to the depth image; without it the segmentation
        network tells the objects apart.
      background: the number in the mask that stands for no object.
      target_id: the target's number in the mask, or in the names of a BOP scene's masks, where it shows the target.
      camera: JSON with the fields of a ROS CameraInfo and T_world_camera; the configuration's camera if not given.
        Images of a lens that distorts (D) are undistorted.
      bop: folder of a BOP scene, with images, masks and camera; the configuration's pose if it has none of its own.
      bag: bag of ROS 1 (.bag) or ROS 2 (folder), with images and CameraInfo; the pose is the configuration's.
      image: number of the image in the BOP scene, or of the depth image in the bag, from 0; its last if not given.
      topics: of the bag, as depth=/camera/depth colour=/camera/colour info=/camera/camera_info; those that are left
        out are found by their type.
      example: take the images that ship with the package, and write them to --out, too, as files like yours.
    """

    depth: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="IMAGE ...", help_behavior_hint="")] = ()
    colour: ImageFile = None
    mask: ImageFile = None
    background: int = BACKGROUND
    target_id: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    camera: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json", help_behavior_hint="")] = None
    bop: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    bag: Annotated[Path | None, tyro.conf.arg(metavar="BAG", help_behavior_hint="")] = None
    image: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    topics: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=TOPIC ...", help_behavior_hint="")] = ()
    example: bool = False

    def check(self) -> None:
        """Check that the options fit together.

        Raises:
          InputError: they do not.
        """
        given = {"--depth": self.depth, "--example": self.example, "--bop": self.bop, "--bag": self.bag}
        chosen = [name for name, value in given.items() if value]
        if len(chosen) != 1:
            raise InputError("plan: give one of --depth IMAGE, --bop FOLDER, --bag BAG and --example")
        if not self.depth and not self.colour is self.mask is self.camera is None:
            raise InputError(
                f"plan: {chosen[0]} has images and a camera of its own; leave --colour, --mask and --camera out"
            )
        if self.target_id is not None and self.mask is None and self.bop is None:
            raise InputError("plan: --target-id names a number of a mask; give --mask, too")
        if self.image is not None and self.bop is self.bag is None:
            raise InputError("plan: --image is a number in --bop or --bag; give one of them, too")
        if self.topics and self.bag is None:
            raise InputError("plan: --topics are those of --bag; give it, too")

    def load(
        self, config: Path | None, camera: Camera, capacity: int = CAPACITY
    ) -> tuple[dict[str, Any], Camera, tuple[str, ...]]:
        """The arguments of `Searcher.next`, their camera, and warnings about them.

        Args:
          config: the configuration file, if there is one.
          camera: its camera, or the default one.
          capacity: how many objects recognition can hold.

        Raises:
          InputError: a file cannot be used.
        """
        if self.depth:
            return self._from_files(camera, capacity)
        if self.bop is not None:
            from mechsearch_jax.commands.options import base_of
            from mechsearch_jax.images.bop import bop_image

            x, y, z = base_of(config)
            posed = None if config is None else camera.moved((x, y, z))
            images = bop_image(self.bop, self.image, camera=posed, target=self.target_id, capacity=capacity)
            images = dataclasses.replace(images, camera=images.camera.moved((-x, -y, -z)))
        else:
            from mechsearch_jax.images.bags import bag_images

            assert self.bag is not None
            if config is None:
                raise InputError("plan: --bag does not say where the camera is; say so in [camera] of --config")
            topics = {name: topic for name, _, topic in (each.partition("=") for each in self.topics)}
            images = bag_images(self.bag, camera, topics=topics, image=self.image)
        names = ("depth", "colour", "mask", "target_id")
        arguments = {name: value for name in names if (value := getattr(images, name)) is not None}
        return arguments, images.camera, ()

    def _from_files(self, camera: Camera, capacity: int) -> tuple[dict[str, Any], Camera, tuple[str, ...]]:
        from mechsearch_jax.images import image_files
        from mechsearch_jax.images.lens import Lens
        from mechsearch_jax.images.measured import median_depth

        lens = Lens(camera) if self.camera is None else image_files.load_lens(self.camera)
        frames = [image_files.load_depth(path) for path in self.depth]
        images: dict[str, Any] = {"depth": lens.depth(median_depth(frames) if len(frames) > 1 else frames[0])}
        warnings = ()
        if self.colour is not None:
            images["colour"] = lens.colour(image_files.load_colour(self.colour))
        if self.mask is not None:
            mask, numbers = image_files.load_mask(self.mask, self.background, capacity)
            images["mask"] = lens.mask(mask)
            if self.target_id is not None:
                # A number that the mask does not show: the target is not seen.
                images["target_id"] = numbers.get(self.target_id, -1)
                if self.target_id >= 0 and self.target_id not in numbers:
                    warnings = (
                        f"{self.mask}: no pixel holds the target's number {self.target_id}, and the target counts as "
                        "not seen; give the number that the mask has for it, or a negative one where it does not show "
                        "it",
                    )
            elif self.colour is None and len(numbers) > capacity:
                raise InputError(
                    f"{self.mask}: names {len(numbers)} objects; say with --target-id which is the target, or leave "
                    "one out"
                )
        return images, lens.camera, warnings


def plan(
    *,
    images: Annotated[ImageFiles, tyro.conf.arg(name="")] = ImageFiles(),
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None,
    joints: Annotated[tuple[float, ...], tyro.conf.arg(metavar="RAD ...")] = (),
    width: Annotated[float | None, tyro.conf.arg(metavar="M", help_behavior_hint="")] = None,
    state: Annotated[Path | None, tyro.conf.arg(metavar="FILE.npz")] = None,
    failed: bool = False,
    seed: int = 0,
    out: Path,
) -> None:
    """Decide on the next action from images of a real camera, and write its motion.

    Args:
      images: what is decided from.
      config: file of settings of camera, shelf, gripper, target and planner; `mechsearch config` prints an example.
      joints: where the arm is, seven angles; at home if not given.
      width: how far the fingers are apart at present; taken to be open if not given.
      state: where the search is kept from call to call. If it is there, the last motion is taken to be over.
      failed: whether that motion failed.
      seed: of all random numbers.
      out: folder for step.json, trajectory.csv, trajectory.json and step.png.
    """
    from rich.console import Console

    from mechsearch_jax.commands.options import settings_of
    from mechsearch_jax.envs.cell.loading import searcher_of
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable

    images.check()
    settings = settings_of(config)
    check_writable(out)
    if images.example:
        (arguments, camera), warnings = _example(out), ()
    else:
        arguments, camera, warnings = images.load(config, settings.workcell.camera, settings.workcell.capacity)
    keep_compilations()
    console = Console(highlight=False)
    with console.status("preparing") as status:
        searcher = searcher_of(settings, camera=camera, seed=seed)
        check = searcher.check()
        if _finished(searcher, state, failed):
            console.print(f"{state}: the target was taken out; the search is finished", soft_wrap=True, markup=False)
            return
        status.update("looking and planning; the first time in a workcell this takes minutes")
        step = searcher.next(**arguments, joints=joints or None, width=width)
        step = dataclasses.replace(step, warnings=(*warnings, *step.warnings))
        status.update("writing")
        files = _write(step, check, out)
        if state is not None:
            searcher.save(state)
    _report(console, step, check, files)


def _finished(searcher: Searcher, state: Path | None, failed: bool) -> bool:
    """Resume the search of an earlier call, if there is one, after its last motion; return whether it is finished."""
    from mechsearch_jax.runtime.files import is_file

    if state is not None and is_file(state):
        searcher.load(state)
        if searcher.moving:
            searcher.acted(ok=not failed)
    return searcher.finished


def _report(console: Console, step: SearchStep, check: Check, files: list[Path]) -> None:
    """Print the action, its reason, and the files."""
    from rich.markup import escape

    for notice in check.notices:
        console.print(f"note: {escape(notice)}", soft_wrap=True)
    for warning in dict.fromkeys((*check.warnings, *step.warnings)):
        console.print(f"[yellow]warning[/yellow]: {escape(warning)}", soft_wrap=True)
    console.print(f"[bold]{step.kind}[/bold]: {escape(step.reason)}", soft_wrap=True)
    console.print("\n".join(str(file) for file in files), soft_wrap=True, markup=False)


def _example(out: Path) -> tuple[dict[str, Any], Camera]:
    """The shipped images, and copies of them as files."""
    from mechsearch_jax.images import image_files
    from mechsearch_jax.images.examples import example_images

    images = example_images()
    assert images.colour is not None
    assert images.mask is not None
    image_files.save_depth(images.depth, out / "depth.png")
    image_files.save_colour(images.colour, out / "colour.png")
    image_files.save_mask(images.mask, out / "mask.png", BACKGROUND)
    image_files.save_camera(images.camera, out / "camera.json")
    return {"depth": images.depth, "colour": images.colour}, images.camera


def _write(step: SearchStep, check: Check, out: Path) -> list[Path]:
    """Write a step and the check of the cell; return the files.

    Without a trajectory, files of an earlier one are removed, so that nobody executes it.
    """
    from mechsearch_jax.robot.trajectory_files import save_csv, save_ros
    from mechsearch_jax.runtime.files import save_json
    from mechsearch_jax.viz.drawing import save_figure

    files = {"trajectory.csv": save_csv, "trajectory.json": save_ros}
    for name, save in files.items():
        if step.trajectory is None:
            (out / name).unlink(missing_ok=True)
        else:
            save(step.trajectory, out / name, overwrite=True)
    save_json({**step.to_json(), "cell": dataclasses.asdict(check)}, out / "step.json")
    save_figure(step.picture, out / "step.png")
    return [out / "step.json", out / "step.png", *(out / name for name in files if step.trajectory is not None)]
