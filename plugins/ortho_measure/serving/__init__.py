"""The server of the page: guard, requests, tiles, and the ortho that is made from the page."""
