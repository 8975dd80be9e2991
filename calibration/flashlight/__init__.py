"""Lights that are found.

Comes in: photos of the ground under a moving flashlight, photos by the phone that holds it, shadows of known solids.
Goes out: a Light for each photo, with sigma and a verdict.
"""
