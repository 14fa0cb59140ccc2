"""What several fields are made of."""
