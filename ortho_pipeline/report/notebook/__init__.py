"""Results as Python users see them: tables in notebooks, plots of matplotlib."""
