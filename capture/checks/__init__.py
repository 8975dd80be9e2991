"""Photos are compared with each other.

Comes in: a PhotoStack.
Goes out: Findings, one for each fault of a photo: camera moved, blurred, flash off, room light.
"""
