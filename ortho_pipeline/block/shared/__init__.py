"""What observations or images of a block share: errors of known ground and of heights, parameters of a camera."""
