"""Files on disk become checked, linear photos."""
