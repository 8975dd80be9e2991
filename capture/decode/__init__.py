"""Decode photo files.

Comes in: a path.
Goes out: an array in the sensor's frame, decoded in a confined process, or a sentence that states what is wrong with
    the file.
"""
