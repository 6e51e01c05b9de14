"""OrbView-3 scenes over Zonguldak, as Bueyueksalih et al. had them."""
