"""What an operator sees of a running role: its metrics, its health, its log."""
