"""CARTOSAT-1 stereo pairs over Hobart, as Willneff et al. had them."""
