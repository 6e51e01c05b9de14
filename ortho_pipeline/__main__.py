"""The process of `ortho`, also as ``python -m ortho_pipeline``."""

from ortho_pipeline.cli.program import main

if __name__ == "__main__":
    main()
