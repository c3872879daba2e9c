"""Write a cloth as a USD layer with the attributes of Isaac Sim's surface deformables (Omni Physics 107 and later).

The layer is written as text, because only Isaac Sim itself has the schemas. PhysX uses Young's modulus E and thickness
h as a membrane of stiffness E h, and multiplies the bending stiffness by h³.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.simulators.mujoco import thickness
from diffcloud.simulators.problem import REST_HEIGHT, Problem


def layer(problem: Problem, head: str, left_out: Iterable[str]) -> str:
    """Return the text of a .usda file.

    Args:
        problem: problem with a Poisson's ratio below 0.5.
        head: description of the file.
        left_out: sentences about what the file lacks.
    """
    notes = " ".join(" ".join([head, *left_out]).split()).replace("\\", "/").replace('"', "'")
    last = len(problem.times) - 1
    parts = [
        "#usda 1.0",
        "(",
        f'    doc = "{notes}"',
        '    defaultPrim = "World"',
        "    metersPerUnit = 1",
        "    kilogramsPerUnit = 1",
        '    upAxis = "Z"',
        f"    timeCodesPerSecond = {problem.rate:.9g}",
        "    startTimeCode = 0",
        f"    endTimeCode = {last}",
        ")",
        "",
        'def Xform "World"',
        "{",
        *_indented(_scene(problem)),
        *_indented(_cloth(problem)),
        *_indented(_material(problem)),
        *_indented(_surroundings(problem)),
        *_indented(_held(problem)),
        "}",
    ]
    return "\n".join(parts) + "\n"


def _scene(problem: Problem) -> list[str]:
    return _prim(
        'PhysicsScene "PhysicsScene"',
        ["PhysxSceneAPI"],
        [
            "vector3f physics:gravityDirection = (0, 0, -1)",
            f"float physics:gravityMagnitude = {problem.gravity:.9g}",
            "bool physxScene:enableGPUDynamics = 1",
            'token physxScene:broadphaseType = "GPU"',
        ],
    )


def _cloth(problem: Problem) -> list[str]:
    mesh = problem.mesh
    return _prim(
        'Mesh "Cloth"',
        [
            "OmniPhysicsDeformableBodyAPI",
            "OmniPhysicsSurfaceDeformableSimAPI",
            "PhysicsCollisionAPI",
            "PhysxCollisionAPI",
            "PhysxSurfaceDeformableBodyAPI",
            "MaterialBindingAPI",
        ],
        [
            f"point3f[] points = {_points(mesh.nodes)}",
            f"int[] faceVertexCounts = {_list([3] * len(mesh.faces))}",
            f"int[] faceVertexIndices = {_list(mesh.faces.ravel().tolist())}",
            'uniform token subdivisionScheme = "none"',
            "bool doubleSided = 1",
            f"point3f[] omniphysics:restShapePoints = {_points(mesh.nodes)}",
            f"int3[] omniphysics:restTriVtxIndices = {_points(mesh.faces)}",
            f"float omniphysics:mass = {problem.node_mass.sum():.9g}",
            f"float physxCollision:contactOffset = {2 * REST_HEIGHT:.9g}",
            f"float physxCollision:restOffset = {REST_HEIGHT:.9g}",
            f"bool physxDeformableBody:selfCollision = {int(problem.self_contact)}",
            "rel material:binding:physics = </World/ClothMaterial>",
        ],
    )


def _material(problem: Problem) -> list[str]:
    sheet, thick = problem.sheet, thickness(problem.sheet, solid=True)
    values = {
        "omniphysics:density": sheet.density / thick,
        "omniphysics:staticFriction": problem.friction,
        "omniphysics:dynamicFriction": problem.friction,
        "omniphysics:youngsModulus": sheet.stretching / thick,
        "omniphysics:poissonsRatio": sheet.poisson,
        "omniphysics:surfaceThickness": thick,
        "omniphysics:surfaceBendStiffness": sheet.bending / thick**3,
        "physxDeformableMaterial:elasticityDamping": sheet.damping,
        "physxDeformableMaterial:bendDamping": sheet.damping,
    }
    return _prim(
        'Material "ClothMaterial"',
        [
            "OmniPhysicsBaseMaterialAPI",
            "OmniPhysicsDeformableMaterialAPI",
            "OmniPhysicsSurfaceDeformableMaterialAPI",
            "PhysxSurfaceDeformableMaterialAPI",
        ],
        [f"float {name} = {value:.9g}" for name, value in values.items()],
    )


def _surroundings(problem: Problem) -> list[str]:
    lines = []
    if problem.table is not None:
        corners = np.array([[-5, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]]) + np.array([0, 0, problem.table])
        lines += _obstacle("Table", SurfaceMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])))
    for number, body in enumerate(problem.bodies):
        lines += _obstacle(f"Body{number}", body)
    return lines


def _obstacle(name: str, surface: SurfaceMesh) -> list[str]:
    return _prim(
        f'Mesh "{name}"',
        ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"],
        [
            f"point3f[] points = {_points(surface.nodes)}",
            f"int[] faceVertexCounts = {_list([3] * len(surface.faces))}",
            f"int[] faceVertexIndices = {_list(surface.faces.ravel().tolist())}",
            'uniform token physics:approximation = "none"',
        ],
    )


def _held(problem: Problem) -> list[str]:
    """Return an animated frame for each held node, and an attachment of the node to it."""
    lines = []
    places = problem.held_at(problem.times)
    for index, node in enumerate(problem.held):
        track = ", ".join(f"{time}: {_tuple(place)}" for time, place in enumerate(places[:, index]))
        lines += _prim(
            f'Xform "Held{node}"',
            [],
            [
                f"double3 xformOp:translate.timeSamples = {{{track}}}",
                'uniform token[] xformOpOrder = ["xformOp:translate"]',
            ],
        )
        lines += _prim(
            f'OmniPhysicsVtxXformAttachment "Attachment{node}"',
            [],
            [
                "rel omniphysics:src0 = </World/Cloth>",
                f"rel omniphysics:src1 = </World/Held{node}>",
                f"int[] omniphysics:vtxIndicesSrc0 = [{node}]",
                "point3f[] omniphysics:localPositionsSrc1 = [(0, 0, 0)]",
                "bool omniphysics:attachmentEnabled = 1",
            ],
        )
    return lines


def _prim(what: str, schemas: Sequence[str], lines: Iterable[str]) -> list[str]:
    applied = ", ".join(f'"{name}"' for name in schemas)
    head = [f"def {what} (", f"    prepend apiSchemas = [{applied}]", ")"] if schemas else [f"def {what}"]
    return [*head, "{", *_indented(lines), "}", ""]


def _indented(lines: Iterable[str]) -> list[str]:
    return [f"    {line}" if line else "" for line in lines]


def _points(rows: Any) -> str:
    return "[" + ", ".join(_tuple(row) for row in rows) + "]"


def _tuple(row: Any) -> str:
    return "(" + ", ".join(f"{number:.9g}" for number in row) + ")"


def _list(numbers: Iterable[int]) -> str:
    return "[" + ", ".join(map(str, numbers)) + "]"
