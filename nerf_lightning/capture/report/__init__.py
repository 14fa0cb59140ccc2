"""The pictures that tell how a capture went."""
