"""The first surface.

Comes in: a Scene and its Labels.
Goes out: a signed distance grid: the shadow hull, or a height field from normals and shadows.
"""
