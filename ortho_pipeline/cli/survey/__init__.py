"""First use: what `ortho` alone, `info FOLDER` and `init` show, and the examples of every command."""
