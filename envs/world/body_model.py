"""The bodies in the MuJoCo model: slots with a geometry of every shape, and compounds with one for each solid."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mechsearch_jax.envs.world.world import BODIES
from mechsearch_jax.shapes import PRIMITIVES, Shape, in_order
from mechsearch_jax.shapes.compound import CONVEX, Compound, Piece, inertial, solids

# Keeps tall cylinders from rolling on their rim for ever [N m s, N s/m]; otherwise negligible.
BODY_DAMPING = 2e-3
# Friction of bodies against turning on the spot and against rolling [m]. Without the latter bottles that were pushed
# roll on, on their sides and on their rims, for many seconds.
BODY_TORSION, BODY_ROLLING = 5e-3, 3e-4
TINY = 1e-3
# Mass of an empty slot [kg], and its moments of inertia [kg m2].
EMPTY_MASS, EMPTY_INERTIA = 1e-3, 1e-6


def text(*numbers: float | np.floating) -> str:
    """Numbers as in MJCF."""
    return " ".join(f"{float(n):.9g}" for n in numbers)


def element(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    """A new element of MJCF; an underscore at the end of an attribute's name is left out."""
    return ElementTree.SubElement(parent, tag, {k.rstrip("_"): v for k, v in attributes.items()})


def add_bodies(
    root: ElementTree.Element, world: ElementTree.Element, compounds: Mapping[int, Compound], skin: float
) -> None:
    """Add the bodies of all slots, which are empty but for compounds.

    Args:
      root: of the MJCF, for meshes.
      world: the element of the world.
      compounds: by their slots.
      skin: how much smaller the geometry of compounds is than their solids [m].
    """
    for i in range(BODIES):
        body = element(world, "body", name=f"body{i}", pos=text(*parking_place(i)), gravcomp="1")
        element(body, "joint", name=f"body{i}", type="free", damping=text(BODY_DAMPING))
        element(body, "inertial", mass=text(EMPTY_MASS), pos="0 0 0", diaginertia=text(*[EMPTY_INERTIA] * 3))
        if i in compounds:
            add_compound(root, body, i, compounds[i], skin)
            continue
        for shape in in_order():
            name = geometry_name(shape, i)
            friction = text(shape.friction, BODY_TORSION, BODY_ROLLING)
            element(body, "geom", class_="object", name=name, type=shape.geometry, friction=friction)


def geometry_name(shape: Shape, slot: int) -> str:
    """The name of the geometry of a shape in a slot."""
    return f"{shape.name}{slot}"


def parking_place(slot: int) -> tuple[float, float, float]:
    """The position of an unused slot: far in front of the shelf, on the free side of all its infinite planes [m]."""
    return (-2.0, 0.02 * slot, 0.6)


def add_compound(
    root: ElementTree.Element, body: ElementTree.Element, slot: int, compound: Compound, skin: float
) -> None:
    """Add a compound's geometry to its body, with its principal axes; masses are set by `model.with_bodies`.

    Args:
      root: of the MJCF, for meshes.
      body: the element of the body, with the inertia of an empty slot.
      slot: of the body.
      compound: what it is made of.
      skin: how much smaller the geometry is than the solids [m].
    """
    axes = Rotation.from_matrix(inertial(compound).rotation).as_quat(scalar_first=True)
    weight = body.find("inertial")
    assert weight is not None
    weight.set("quat", text(*axes))
    for i, solid in enumerate(solids(compound.pieces)):
        attributes = {
            "class": "object",
            "name": f"solid{slot}_{i}",
            "pos": text(*solid.position),
            "quat": text(*solid.quaternion),
            "friction": text(compound.friction, BODY_TORSION, BODY_ROLLING),
        }
        attributes |= _mesh(root, attributes["name"], solid, skin) if solid.shape == CONVEX else _size(solid, skin)
        ElementTree.SubElement(body, "geom", attributes)


def _size(solid: Piece, skin: float) -> dict[str, str]:
    primitive = PRIMITIVES[solid.shape]
    half = np.array(solid.half_size) - skin
    return {"type": primitive.geometry, "size": text(*primitive.geometry_size(half, np))}


def _mesh(root: ElementTree.Element, name: str, solid: Piece, skin: float) -> dict[str, str]:
    assets = root.find("asset")
    if assets is None:
        assets = ElementTree.SubElement(root, "asset")
    vertices = drawn_in(np.array(solid.vertices), skin)
    ElementTree.SubElement(assets, "mesh", {"name": name, "vertex": text(*vertices.reshape(-1)), "inertia": "convex"})
    return {"type": "mesh", "mesh": name}


def drawn_in(vertices: Float[np.ndarray, "n 3"], skin: float) -> Float[np.ndarray, "n 3"]:
    """Vertices about their origin, shrunk so that the bounding box is smaller by about a skin on every side [m]."""
    extent = np.abs(vertices).max(axis=0)
    return vertices * np.maximum(1.0 - skin / extent, 0.5)
