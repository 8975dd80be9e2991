"""Photo files become pixels.

Comes in: a path.
Goes out: an array in the sensor's frame, decoded in a process that can do nothing else, or a sentence that says what
    is wrong with the file.
"""
