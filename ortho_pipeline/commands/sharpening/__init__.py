"""Pan-sharpening: weights, registration and quality of a panchromatic and a multispectral image, and their ortho."""
