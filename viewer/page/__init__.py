"""The page and its server.

Comes in: a run folder.
Goes out: an address on this machine, guarded by a token, and a page that follows the run.
"""
