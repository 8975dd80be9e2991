"""Judge before the solve if a capture is worth reconstructing.

Comes in: Photos and their Calibration.
Goes out: a verdict before the solve, with reasons, and what to shoot next.
"""
