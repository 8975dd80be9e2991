"""What the page draws.

Comes in: a run folder, also one that still grows.
Goes out: mesh, photos, lights, camera and ground as nodes of a viser scene.
"""
