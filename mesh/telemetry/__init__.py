"""What an operator sees of a running role: its figures, its health, its log."""
