"""Errors against a known truth.

Comes in: a run and a reference mesh or scene.
Goes out: depth, normal and surface distances, and precision and recall of surfaces.
"""
