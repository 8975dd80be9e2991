"""Triangle meshes of a solved scene.

Comes in: SolvedScene.
Goes out: a closed triangle mesh in the world frame with evidence for each vertex, its textures, and PLY, GLB and USD
    files.
"""
