"""Pages in one file.

Comes in: a run folder, a check, a batch.
Goes out: HTML that needs no server and loads nothing.
"""
