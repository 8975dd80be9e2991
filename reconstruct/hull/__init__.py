"""The shadow hull, and what bends it.

Comes in: a Scene and its Labels.
Goes out: a signed distance grid that holds the object, bent to the integral of its normals where the shadows agree.
"""
