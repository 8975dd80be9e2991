"""How much of a mesh was seen, is held by shadows alone, or is a guess; and the part that can be measured.

python examples/mesh_and_evidence.py runs/spot measured.ply
"""

import sys

import numpy as np

import shadowgraph

KINDS = ("unconstrained: a guess", "held by shadows", "seen by the camera")


def main(run: str, out: str, worst: float = 1.0) -> None:
    result = shadowgraph.RunResult(run)
    mesh = result.mesh  # closed, world frame, z up, the ground at z = 0
    evidence, sigma = mesh.vertex_attributes["evidence"], mesh.vertex_attributes["sigma"]
    area = np.zeros(len(mesh.vertices))
    np.add.at(area, mesh.faces, mesh.area_faces[:, None] / 3)  # a third of each triangle to each of its corners
    for kind, text in enumerate(KINDS):
        here = evidence == kind
        typical = f", +-{np.median(sigma[here]):.2f} {result.unit}" if here.any() else ""
        print(f"{text}: {100 * area[here].sum() / area.sum():.0f} % of the surface{typical}")

    known = (sigma[mesh.faces] <= worst).all(1)  # triangles whose corners are all known to that
    print(f"{100 * mesh.area_faces[known].sum() / mesh.area:.0f} % is known to {worst} {result.unit}")
    mesh.update_faces(known)
    mesh.export(out)


if __name__ == "__main__":
    main(*sys.argv[1:])
