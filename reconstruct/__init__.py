"""Calibrated photos become a signed distance field, a mesh and relit pictures."""
