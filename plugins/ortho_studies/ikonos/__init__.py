"""IKONOS Geo images over Tehran, as Amini and Hashemi had them."""
