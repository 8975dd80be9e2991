"""What a finished run can be saved as.

Comes in: a run folder and a file name.
Goes out: meshes, pictures, films, light-movable pages, data sets for other programs.
"""
