"""Meshes.

Comes in: Fields.
Goes out: a closed triangle mesh in the world frame with evidence for each vertex, its texture, PLY, GLB, USD.
"""
