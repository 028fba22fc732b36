"""Whether targets of any shape are grasped wherever physics says that they can be."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mechsearch_jax.commands.options import JsonFile, at_least_one, check_files
from mechsearch_jax.runtime.errors import InputError

if TYPE_CHECKING:
    from mechsearch_jax.benchmarks.lab.targets.graspable import GivenMesh

Meshes = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[MESH ...]")]


def bench_targets(
    meshes: Meshes = (),
    /,
    *,
    scale: float = 1.0,
    things: int = 0,
    poses: int = 3,
    grasps: int = 1000,
    seed: int = 0,
    keep: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
    out: JsonFile = None,
) -> None:
    """Tell whether the planner can grasp a target of any shape wherever physics can: a mesh stands alone on the board,
    and either side has its grasps tried, the planner its own, physics random antipodal ones of the mesh's surface.

    Args:
      meshes: mesh files (OBJ, STL or PLY), z up.
      scale: metres per unit of the files.
      things: how many meshes of household things are made beside them, each another kind.
      poses: random ones of each mesh.
      grasps: antipodal ones at each pose, of which the first that succeeds ends the pose.
      seed: of the made things, the poses and the grasps.
      keep: folder for the meshes that are made; they are not kept if left out.
      out: JSON file for the shares and for every pose's row.
    """
    import tempfile

    from rich.console import Console

    from mechsearch_jax.benchmarks.lab.tables import targets_table
    from mechsearch_jax.benchmarks.lab.targets import everyday, graspable
    from mechsearch_jax.benchmarks.store.json_rows import save_rows
    from mechsearch_jax.problem.cache import keep_compilations
    from mechsearch_jax.runtime.files import check_writable

    at_least_one("lab targets", poses=poses, grasps=grasps)
    for name, number in {"things": things, "seed": seed}.items():
        if number < 0:
            raise InputError(f"lab targets: --{name} {number} must not be negative")
    check_files(out)
    if keep is not None:
        check_writable(keep)
    given = _named(meshes, scale)
    keep_compilations()
    console = Console(highlight=False)
    with contextlib.ExitStack() as stack, console.status("making meshes") as status:
        folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        made = everyday.write_things(things, seed, folder) if things else []
        given += [graspable.GivenMesh(file.stem, file) for file in made]
        bench = graspable.TargetsBench(given, poses, grasps, seed)

        def on_progress(rows: list[graspable.TargetRow]) -> None:
            status.update(f"grasping {len(rows)}/{poses * len(given)}")
            if out is not None:
                save_rows(dict(graspable.value(bench, rows)), rows, out)

        rows = bench.run(on_progress)
    console.print(targets_table(rows))


def _named(files: Sequence[Path], scale: float) -> list[GivenMesh]:
    """Mesh files by their names, or, where two are called alike, by their folders'.

    Raises:
      InputError: there is no such file.
    """
    from mechsearch_jax.benchmarks.lab.targets.graspable import GivenMesh

    missing = next((file for file in files if not file.is_file()), None)
    if missing is not None:
        raise InputError(f"lab targets: {missing}: there is no such file")
    count = Counter(file.stem for file in files)
    names = [file.stem if count[file.stem] == 1 else file.resolve().parent.name for file in files]
    return [GivenMesh(name, file, scale) for name, file in zip(names, files, strict=True)]


COMMANDS = {"targets": bench_targets}
