"""``python -m ortho_pipeline`` is `ortho`."""

from ortho_pipeline.cli.program import main

main()
