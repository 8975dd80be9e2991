"""A capture folder becomes a session.

Comes in: a folder of photos or a clip, session.toml.
Goes out: Session, the role of each photo (board, lit, light, dark) and what the user declared.
"""
