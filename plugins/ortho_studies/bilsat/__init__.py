"""BILSAT-1 frames over Ankara, as Ok and Turker had them."""
