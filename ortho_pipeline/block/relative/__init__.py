"""How the images of an adjusted block lie to each other, apart from where all of them lie."""
