"""A folder of photos becomes a mesh, maps and a report; the same call continues a run that was stopped.

python examples/photos_to_mesh.py examples/spot runs/spot
"""

import sys

import numpy as np

import shadowgraph


def main(capture: str, out: str, preset: str = "standard") -> None:
    result = shadowgraph.run(capture, out, preset=preset)
    print(result)
    for warning in result.warnings:
        print("careful:", warning)

    calibration = result.calibration
    print(f"camera: {calibration.camera.fx:.0f} px, {calibration.world_from_camera.translation.round()} {result.unit}")
    for light in calibration.lights:
        place = light.direction if light.position is None else light.position
        print(light.photo, light.kind, np.round(place, 1), "used" if light.used else light.reason)

    inside = result.depth[result.mask]  # on the pixels of the photos, as are normals and mask
    print(f"{inside.size} pixels of the object, {inside.min():.0f} to {inside.max():.0f} {result.unit} from the camera")
    up = np.clip(result.normals[result.mask] @ [0.0, 0.0, 1.0], -1, 1)  # world frame: z up
    print(f"half of what is seen leans less than {np.degrees(np.arccos(np.median(up))):.0f} degrees from level")
    result.mesh.export(f"{out}.stl")


if __name__ == "__main__":
    main(*sys.argv[1:])
