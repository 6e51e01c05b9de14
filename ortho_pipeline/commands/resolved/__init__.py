"""What a command is asked, resolved: the request, its files opened once, and the ledger of them."""
