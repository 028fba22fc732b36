"""Compounds in the batch simulator: the model's fields against C MuJoCo's own, what does not fit, and how they rest."""

import copy
import dataclasses
import functools

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.scenes.household import body_at, household, standing_height
from mechsearch_jax.envs.simulators.batch_model import (
    ROOM,
    ROWS,
    cells_of,
    check_room,
    compound_fields,
    fitting,
    like_present,
)
from mechsearch_jax.envs.simulators.mjx_simulator import MjxSimulator
from mechsearch_jax.envs.simulators.native import NativeWorld
from mechsearch_jax.envs.world import model
from mechsearch_jax.envs.world.mismatch import ASSUMED_CELL, TrueCell
from mechsearch_jax.envs.world.world import BODIES, TARGET, alike, from_scenario, slots
from mechsearch_jax.runtime.errors import InputError
from mechsearch_jax.shapes import PRIMITIVES
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, centred, half_extents
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.scenario import Body, Scenario
from mechsearch_jax.workspace.shelf import Shelf

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
BOX = Body("box", (0.054, 0.025, 0.054), (0.55, 0.3, 0.4585), UPRIGHT)
TARGET_BODY = Body("cylinder", (0.02, 0.02, 0.05), (0.7, 0.0, 0.4545), UPRIGHT)
CORNERS = tuple(map(tuple, (np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * 0.03).tolist()))


TYPES = {p.geometry: int(getattr(mujoco.mjtGeom, f"mjGEOM_{p.geometry.upper()}")) for p in PRIMITIVES.values()}


def standing(*names, drop=0.0):
    """Household things in a row."""
    bodies = []
    for i, name in enumerate(names):
        compound = household()[name].compound
        height = Shelf().board + standing_height(compound) + drop
        bodies.append(body_at(compound, 0.6, -0.15 + 0.16 * i, height, yaw=0.5 * i))
    return tuple(bodies)


THINGS = Scenario("things", (*standing("mug", "drill", "pear"), BOX), TARGET_BODY)
OTHERS = Scenario("others", standing("banana", "wine-bottle", "drink-can"), TARGET_BODY)
PLAIN = Scenario("plain", (BOX,), Body("box", (0.015, 0.03, 0.05), (0.7, 0.0, 0.4545), UPRIGHT))


def polyhedron():
    compound, _ = centred(Compound((Piece(CONVEX, (0.0,) * 3, vertices=CORNERS),), 500.0, 0.5))
    return Body("compound", half_extents(compound), (0.6, 0.1, 0.45), UPRIGHT, compound)


def stack(scenes):
    worlds = alike([from_scenario(scene) for scene in scenes])
    return jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *worlds)


@functools.cache
def blank():
    return model.compile_model(Shelf(), Camera(), compounds=ROOM)


def test_the_fields_of_every_world_are_those_that_mujoco_computes():
    factors = np.linspace(0.5, 1.5, BODIES)
    other = TrueCell(friction=0.5, mass=2.0, body_friction=factors, body_mass=factors[::-1])
    scenes, cells = [THINGS, OTHERS, PLAIN], [ASSUMED_CELL, other, ASSUMED_CELL]
    fields = jax.jit(functools.partial(compound_fields, blank()))(stack(scenes), cells_of(blank(), cells))
    for w, (scene, cell) in enumerate(zip(scenes, cells, strict=True)):
        native = NativeWorld()
        native.place(slots(scene), cell)
        compiled = native._model
        for name in ("body_mass", "body_subtreemass", "body_invweight0", "body_gravcomp"):
            np.testing.assert_allclose(np.asarray(getattr(fields, name)[w]), getattr(compiled, name), 1e-5, 1e-7, name)
        np.testing.assert_allclose(fields.dof_invweight0[w], compiled.dof_invweight0, 1e-5, 1e-7)
        inertia = [
            _tensors(np.asarray(fields.body_inertia[w]), np.asarray(fields.body_iquat[w])),
            _tensors(compiled.body_inertia, compiled.body_iquat),
        ]
        np.testing.assert_allclose(*inertia, rtol=1e-4, atol=1e-8)
        for slot, body in enumerate(slots(scene)):
            if body is not None and body.compound is not None:
                _check_geometry(fields, w, slot, compiled)


def _tensors(moments, quaternions):
    """Tensors of inertia in the bodies' frames; principal axes may have any order."""
    axes = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    return np.einsum("nik,nk,njk->nij", axes, moments, axes)


def _check_geometry(fields, w, slot, compiled):
    """Every geometry of a compound in C MuJoCo is among those of the batch, and no other is larger than nothing."""
    padded = blank()
    names = [piece.shape for piece in ROOM[0].pieces]
    free = {kind: [k for k, name in enumerate(names) if name == kind] for kind in ROWS}
    for g in np.flatnonzero(compiled.geom_bodyid == compiled.body(f"body{slot}").id):
        own = compiled.geom(g)
        kind = next(n for n, p in PRIMITIVES.items() if TYPES[p.geometry] == int(own.type[0]))
        row = padded.geom(f"solid{slot}_{free[kind].pop(0)}").id
        for name in ("size", "rbound", "aabb", "pos", "friction"):
            computed = np.asarray(getattr(fields, f"geom_{name}")[w, row]).reshape(-1)
            np.testing.assert_allclose(
                computed, np.ravel(getattr(compiled, f"geom_{name}")[g]), 1e-5, 1e-6, f"{kind} {name}"
            )
        turns = [
            Rotation.from_quat(np.asarray(q), scalar_first=True).as_matrix()
            for q in (fields.geom_quat[w, row], own.quat)
        ]
        np.testing.assert_allclose(*turns, atol=1e-5)
    for k in (k for rest in free.values() for k in rest):
        row = padded.geom(f"solid{slot}_{k}").id
        assert float(fields.geom_rbound[w, row]) < 3 * model.TINY
        assert _depth(np.asarray(fields.geom_pos[w, row]), slot, compiled) > 4 * model.TINY


def _depth(point, slot, compiled):
    """How deep a point, the middle of one of the solids of a body, is in that solid [m]."""
    solids = [compiled.geom(g) for g in np.flatnonzero(compiled.geom_bodyid == compiled.body(f"body{slot}").id)]
    at = [s for s in solids if np.allclose(point, s.pos, atol=1e-6)]
    return max(np.asarray(compiled.geom_aabb[s.id]).reshape(2, 3)[1].min() for s in at)


def test_rows_that_are_not_used_touch_nothing():
    things = {
        f"{name}-{factor}": thing.sized(factor) for name, thing in household().items() for factor in (*thing.scale, 1.0)
    }
    heights = {name: Shelf().board + standing_height(compound) for name, compound in things.items()}
    scenes = [
        Scenario(name, (body_at(compound, 0.6, 0.2, heights[name]),), TARGET_BODY) for name, compound in things.items()
    ]
    fields = jax.device_get(jax.jit(functools.partial(compound_fields, blank()))(stack(scenes), _cells(len(scenes))))
    for w, scene in enumerate(scenes):
        native = NativeWorld()
        native.place(slots(scene))
        padded = _with_fields(fields, w)
        rows = [_rows_at_rest(compiled, scene) for compiled in (padded, native._model)]
        assert rows[0] == rows[1], scene.name


def _cells(count):
    return cells_of(blank(), [ASSUMED_CELL] * count)


def _with_fields(fields, w):
    """The model of one of the worlds in C MuJoCo."""
    compiled = copy.copy(blank())
    for name in fields.__dataclass_fields__:
        value = getattr(compiled, name)
        value[:] = np.asarray(getattr(fields, name)[w]).reshape(value.shape)
    # MuJoCo leaves out the poses of geometries that had none when it compiled them.
    compiled.geom_sameframe[:] = compiled.body_sameframe[:] = 0
    return compiled


def _rows_at_rest(compiled, scene):
    """Most constraint rows while bodies come to rest."""
    data, rows = model.initial_state(compiled, slots(scene)), 0
    for _ in range(20):
        mujoco.mj_step(compiled, data)
        rows = max(rows, data.nefc)
    return rows


def test_every_household_thing_has_room():
    for name, thing in household().items():
        check_room(stack([Scenario(name, standing(name), TARGET_BODY)]).compounds)
        assert thing.name == name


def test_what_has_no_room_is_one_line():
    with pytest.raises(InputError, match="meshes and convex polyhedra cannot be simulated here"):
        check_room(stack([Scenario("mesh", (polyhedron(),), TARGET_BODY)]).compounds)
    pieces = tuple(Piece("ellipsoid", (0.02, 0.02, 0.02), (0.04 * i, 0.0, 0.0)) for i in range(3))
    compound, _ = centred(Compound(pieces, 500.0, 0.5))
    three = Body("compound", half_extents(compound), (0.6, 0.1, 0.45), UPRIGHT, compound)
    with pytest.raises(InputError, match="3 solids of kind ellipsoid, more than 2; use the NativeSimulator"):
        check_room(stack([Scenario("three", (three,), TARGET_BODY)]).compounds)


def test_plain_worlds_fit_where_there_is_room_for_compounds():
    plain = stack([PLAIN])
    assert fitting(plain, {}) is plain
    wide = fitting(plain, ROOM)
    assert wide.compounds is not None
    assert wide.compounds.solids.valid.sum(axis=-1).tolist() == [[1, *[0] * (BODIES - 2), 1]]
    with pytest.raises(InputError, match="compounds among plain worlds; run them one set after the other"):
        fitting(stack([THINGS]), {})
    assert like_present(stack([THINGS]), PLAIN).compounds is not None
    with pytest.raises(InputError, match="things has compounds, the scenes before it have none"):
        like_present(plain, THINGS)


@pytest.mark.slow
def test_things_come_to_rest_where_the_native_simulator_has_them():
    scenes = [
        dataclasses.replace(THINGS, objects=standing("mug", "drill", "pear", drop=0.01)),
        dataclasses.replace(OTHERS, objects=standing("banana", "wine-bottle", "drink-can", drop=0.01)),
    ]
    batch = MjxSimulator()
    batch.reset(scenes)
    outcome = batch.settle()
    assert outcome.settled.all()
    assert not outcome.overflow.any()
    for i, scene in enumerate(scenes):
        native = NativeWorld()
        native.reset(scene)
        native.settle()
        count = len(scene.objects)
        apart = np.asarray(batch.world.position[i] - native.world.position)[[*range(count), TARGET]]
        assert np.abs(apart).max() < 2e-3
        cosine = (np.einsum("nij,nij->n", batch.world.rotation[i], native.world.rotation)[:count] - 1) / 2
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 3.0
