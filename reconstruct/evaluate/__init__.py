"""Errors of a result against a known truth.

Comes in: a run, and a reference mesh or scene.
Goes out: errors of depth, normals and surface, and precision and recall of surfaces.
"""
