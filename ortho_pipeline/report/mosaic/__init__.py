"""Mosaics in the report: their document, words and page."""
