"""Parts of panels.

Comes in: a viser server.
Goes out: the context that panels share, pictures, pointers and legends.
"""
