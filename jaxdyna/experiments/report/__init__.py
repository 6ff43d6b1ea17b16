"""What a result leaves for people: numbers in words, tables, figures, films."""
