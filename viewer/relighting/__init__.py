"""Pictures beside the page.

Comes in: a lamp that moves.
Goes out: the relit picture, computed in a thread that always takes the newest request.
"""
