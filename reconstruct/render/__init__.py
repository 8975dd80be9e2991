"""Pictures of a solved scene.

Comes in: SolvedScene, a camera, lights or an environment.
Goes out: G-buffers, interreflection, relit pictures.
"""
