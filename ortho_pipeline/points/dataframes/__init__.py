"""Points as tables of other libraries."""
