"""Which of many models to take: what error each is expected to have, and the recommendation."""
