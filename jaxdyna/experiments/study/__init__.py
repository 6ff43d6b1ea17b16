"""What studies are put together from: the standard arms, tables of overrides."""
