"""The input of a run: the photos of a folder and their calibration.

Comes in: a capture folder or a scene, and RunOptions.
Goes out: Source, its Photos in linear light, their Calibration, and the part of them that fits into memory. Of several
views: read_views and calibrate_source_views; one view is the case of one.
"""
