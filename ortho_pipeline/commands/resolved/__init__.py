"""The resolved request of a command: its options, its files opened once, and the ledger of them."""
