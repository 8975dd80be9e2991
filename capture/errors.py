"""Errors that are the user's data's fault: one sentence of what, where and what to do; exit code 2, no traceback."""


class UserError(Exception):
    """The input is at fault. The message says what was measured, what was needed, where, and what to do next."""


class CaptureError(UserError):
    """A photo or a capture folder cannot be used."""


class CalibrationError(UserError):
    """Camera, ground or lights cannot be found from these photos."""


class ReconstructionError(UserError):
    """No surface can be reconstructed from these photos."""
