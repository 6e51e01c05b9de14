"""What lies in a folder, what to do next with it, and the file of a run over its scenes."""
