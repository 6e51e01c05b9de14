"""Commands about one scene: its model, its ortho, its bands, the heights under it."""
