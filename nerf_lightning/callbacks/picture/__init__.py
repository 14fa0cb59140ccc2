"""What a 2D run leaves beside its weights."""
