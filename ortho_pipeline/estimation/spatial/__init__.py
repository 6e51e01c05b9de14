"""Errors that neighbours share, and what they do to the parameters of a fit."""
