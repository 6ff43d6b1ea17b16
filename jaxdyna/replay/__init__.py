"""What was experienced, kept to learn from again."""
