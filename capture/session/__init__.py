"""Read a capture folder as a session.

Comes in: a folder of photos or a clip, and session.toml.
Goes out: Capture: for each place of the tripod a Session, the role of each photo (board, lit, light, dark, side), the
photos that are left out, and the user's declarations.
"""
