"""Commands about this machine: installed parts and cached files."""
