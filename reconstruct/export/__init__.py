"""Export of a finished run to files.

Comes in: a run folder and a file name.
Goes out: meshes, pictures, films, light-movable pages, data sets for other programs.
"""
