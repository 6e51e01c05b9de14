"""Additional layers of an ortho, and their inputs."""
