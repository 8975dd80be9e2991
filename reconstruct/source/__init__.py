"""What a folder holds: its photos and their calibration.

Comes in: a capture folder or a scene, and RunOptions.
Goes out: Source, its Photos in linear light, their Calibration, and what of them fits into memory.
"""
