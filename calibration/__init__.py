"""Photos become a camera, a ground plane and one light per photo, each with its uncertainty."""
