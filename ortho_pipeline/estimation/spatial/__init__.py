"""Errors that points share, with neighbours or with all, and what they do to the parameters of a fit."""
