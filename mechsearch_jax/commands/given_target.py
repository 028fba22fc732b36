"""Options that say what the target of generated scenes is."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import SHAPES

if TYPE_CHECKING:
    from mechsearch_jax.workspace.target import Target

    TargetShape = str
else:
    TargetShape = Literal[tuple(SHAPES)]


@dataclasses.dataclass(frozen=True)
class GivenTarget:
    """The target of generated scenes.

    Attributes:
      target: its shape; a cylinder, or what the configuration file says, if not given.
      target_file: instead, the file of a target of any shape: a mesh (OBJ, STL or PLY) that stands upright, or a body
        as in a scenario file, without its place.
      target_scale: metres per unit of a mesh; 1 if not given.
    """

    target: Annotated[
        TargetShape | None, tyro.conf.arg(metavar="{" + ",".join(SHAPES) + "}", help_behavior_hint="")
    ] = None
    target_file: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    target_scale: Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")] = None

    @property
    def given(self) -> bool:
        """Whether anything is said about the target."""
        return self != USUAL_TARGET

    def load(self) -> str | Target | None:
        """The name of a shape, the target of the file, or None for what the configuration file says.

        Raises:
          InputError: two of them are given, or the file cannot be used.
        """
        if self.target_file is None:
            if self.target_scale is not None:
                raise InputError("--target-scale: is the unit of the mesh of --target-file; give that, too")
            return self.target
        if self.target is not None:
            raise InputError("give either --target or --target-file, not both")
        from mechsearch_jax.workspace.target import load_target

        return load_target(self.target_file, 1.0 if self.target_scale is None else self.target_scale)


USUAL_TARGET = GivenTarget()
