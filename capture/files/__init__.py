"""Files and their names.

Comes in: paths, bytes from strangers.
Goes out: files that are whole or absent, names that stay in their folder, numbers that were checked before anything
    was allocated.
"""
