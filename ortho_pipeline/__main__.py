"""``python -m ortho_pipeline`` is `ortho`."""

from ortho_pipeline.cli import main

main()
