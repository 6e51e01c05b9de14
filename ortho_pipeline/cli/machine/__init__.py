"""Commands about this machine: what is installed on it, and what is kept on it."""
