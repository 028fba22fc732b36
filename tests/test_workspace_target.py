"""Targets of any shape: their frame, height, symmetry and candidate poses."""

import math

import numpy as np
import pytest
import trimesh

from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes.compound import COMPOUND, Piece
from mechsearch_jax.workspace.scenario import Body
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def turned(angle):
    return (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2))


# A body with a neck; a cup of a barrel and a handle; a T, which lies on its bar.
BOTTLE = (
    Piece("cylinder", (0.03, 0.03, 0.05), (0.0, 0.0, 0.05)),
    Piece("frustum", (0.03, 0.012, 0.012), (0.0, 0.0, 0.112)),
    Piece("cylinder", (0.012, 0.012, 0.013), (0.0, 0.0, 0.137)),
)
CUP = (
    Piece("cylinder", (0.03, 0.03, 0.04), (0.0, 0.0, 0.04)),
    Piece("box", (0.012, 0.005, 0.02), (0.04, 0.0, 0.045)),
)
TEE = (
    Piece("box", (0.015, 0.05, 0.012), (0.0, 0.0, 0.012)),
    Piece("box", (0.015, 0.014, 0.03), (0.0, 0.0, 0.054)),
)


def test_boxes_and_cylinders_stay_what_they_were():
    for target, yaws in ((Target.cylinder(), 1), (Target.box(), 6)):
        assert (target.yaws, target.turn, target.compound) == (yaws, math.pi, None)
        assert target.bottom == target.top == target.half_size[2]
        assert target.height(Shelf()) == Shelf().board + target.half_size[2]
    assert Target().like(Target.of("box", (0.02, 0.03, 0.05))) == Target("box", (0.02, 0.03, 0.05), yaws=6)


@pytest.mark.parametrize(
    ("pieces", "yaws", "turn", "ends"),
    [(BOTTLE, 1, math.pi, 0.15), (CUP, 12, 2 * math.pi, 0.08), (TEE, 6, math.pi, 0.084)],
    ids=["bottle", "cup", "tee"],
)
def test_a_target_of_pieces_stands_on_its_lowest_point(pieces, yaws, turn, ends):
    target = Target.from_parts(pieces)
    assert target.shape == COMPOUND
    assert (target.yaws, target.turn) == (yaws, turn)
    assert target.bottom + target.top == pytest.approx(ends, abs=1e-6)
    assert target.height(Shelf()) - target.bottom == pytest.approx(Shelf().board)
    assert hash(target) == hash(Target.from_parts(pieces))
    poses = target.candidate_poses(Shelf())
    assert len(poses) == np.prod(target.grid) * yaws
    assert poses[:, 2].max() == pytest.approx(turn * (yaws - 1) / yaws, abs=1e-6)
    body = Body(COMPOUND, target.half_size, (0.6, 0.1, 0.5), turned(0.3), target.compound)
    assert Target.of_body(body) == target
    assert Target(grid=(4, 5), inset=0.06).like(target).grid == (4, 5)


def test_a_mesh_is_a_target(tmp_path):
    trimesh.creation.cylinder(radius=20.0, height=100.0, sections=32).export(tmp_path / "can.stl")
    target = Target.from_mesh(tmp_path / "can.stl", scale=0.001)
    assert (target.yaws, target.solid.round) == (1, True)
    assert target.bottom == pytest.approx(0.05, abs=1e-4)
    assert target.solid.radius == pytest.approx(0.02, abs=1e-4)


def test_what_is_no_target_is_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match="at least one"):
        Target.from_parts(())
    with pytest.raises(InputError, match=r"nothing.stl: target.mesh: .*nothing.stl cannot be read"):
        Target.from_mesh(tmp_path / "nothing.stl")
    trimesh.creation.box(extents=(40, 40, 100)).export(tmp_path / "in-mm.stl")
    with pytest.raises(InputError, match=r"in-mm.stl: target.mesh: .* give its unit as scale, such as 0.001"):
        Target.from_mesh(tmp_path / "in-mm.stl")
    for scale in (0.0, -1.0, 1e-9, float("nan"), float("inf")):
        with pytest.raises(InputError, match=r"in-mm.stl: target.scale: .* must be a number from"):
            Target.from_mesh(tmp_path / "in-mm.stl", scale)
    box = Piece("box", (0.02, 0.02, 0.05))
    for pieces, message in (
        ((Piece("sphere", (0.1, 0.1, 0.1)),), r"pieces\[0\].shape: \"sphere\" is unknown"),
        ((Piece("box", (1.5, 0.1, 0.1)),), r"pieces\[0\].half_size: .* must be lengths"),
        ((Piece("box", (-0.02, 0.1, 0.1)),), r"pieces\[0\].half_size: .* must be lengths"),
        ((box, Piece("box", (0.02, 0.02, 0.05), quaternion=(2.0, 0.0, 0.0, 0.0))), r"pieces\[1\].quaternion: its norm"),
        ((box,) * 20, "20 solids are too many"),
    ):
        with pytest.raises(InputError, match=message):
            Target.from_parts(pieces)
    with pytest.raises(InputError, match=r"Target\.density"):
        Target.from_parts((box,), density=-1.0)
    with pytest.raises(InputError, match=r"Target\.friction"):
        Target.from_parts((box,), friction=float("nan"))
    with pytest.raises(InputError, match="tips it, but it stands upright"):
        Target.of_body(
            Body(COMPOUND, (0.1,) * 3, (0.6, 0.1, 0.5), (0.0, 1.0, 0.0, 0.0), Target.from_parts((box,)).compound)
        )
    tall = Target.from_parts((Piece("box", (0.02, 0.02, 0.19)),))
    with pytest.raises(InputError, match=r"0\.380 m tall, but the shelf is 0\.\d+ m high"):
        tall.check_fits(Shelf())
    with pytest.raises(InputError, match=r"Target\.from_parts"):
        Target(COMPOUND)
