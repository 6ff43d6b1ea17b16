"""What studies are put together from: the standard arms, planners as arms, tables of overrides."""
