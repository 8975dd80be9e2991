"""Files and their names.

Comes in: paths, and bytes from untrusted files.
Goes out: files that are complete or absent, names that stay in their folder, and numbers that are checked before
    memory is allocated for them.
"""
