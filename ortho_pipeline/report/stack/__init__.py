"""The record and the page of a stack."""
