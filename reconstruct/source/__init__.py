"""The input of a run: the photos of a folder and their calibration.

Comes in: a capture folder or a scene, and RunOptions.
Goes out: Source, the Photos of each view in linear light, their CalibratedViews, and the part that fits into memory.
"""
