"""Building blocks shared by fields."""
