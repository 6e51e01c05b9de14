"""The page of a scene: what a reader sees first, and what there is to do about each notice.

`scene` fills the page, `advice` says what to do, `ortho_map` draws the residuals over the ortho, `locator` where in the
world it is, `behaviour` is the script that sorts and highlights (without it nothing is missing).
"""
