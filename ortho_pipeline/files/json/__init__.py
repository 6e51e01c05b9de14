"""JSON documents: values, and records that check them."""
