"""A run folder becomes a page: live while it grows, relightable when it is done."""
